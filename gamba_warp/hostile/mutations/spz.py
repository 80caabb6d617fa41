"""Mutations of .spz: inside its gzip stream, or of version 4's table of contents and frames."""

from __future__ import annotations

import gzip
import struct
import zlib
from random import Random

from .data import BOMB, Unfit
from .text import any_plain


def gzip_inside(data: bytes, rng: Random) -> bytes:
    """Changes what a gzip stream holds, or makes it hold far more; its checksum then fits."""
    try:
        inner = gzip.decompress(data)
    except (OSError, EOFError, zlib.error) as error:
        raise Unfit from error
    if rng.random() < 0.1:
        return gzip.compress(inner + bytes(BOMB // 4), 9)
    if rng.random() < 0.3 and len(inner) >= 16:  # an .spz's version, count, degree, bits, flags
        kind, at, values = rng.choice(
            (
                ("<I", 4, (0, 1, 2, 3, 4, 2**32 - 1)),
                ("<I", 8, (0, 1, 11, 13, 10**7, 10**7 + 1, 2**32 - 1)),
                ("B", 12, (0, 1, 2, 3, 4, 255)),
                ("B", 13, (0, 12, 24, 31, 255)),
                ("B", 14, (0, 1, 2, 3, 255)),
            )
        )
        out = bytearray(inner)
        struct.pack_into(kind, out, at, rng.choice(values))
        return gzip.compress(bytes(out))
    return gzip.compress(any_plain(inner, rng))


def spz_table(data: bytes, rng: Random) -> bytes:
    """Changes a number of the plain header or the table of contents of an .spz of version 4."""
    if not data.startswith(b"NGSP") or len(data) < 60:
        raise Unfit
    out, table = bytearray(data), struct.unpack_from("<I", data, 16)[0]
    entry = min(table + 8 * rng.randrange(12), len(data) - 8)
    kind, at, values = rng.choice(
        (
            ("<I", 4, (0, 3, 5, 2**32 - 1)),
            ("<I", 8, (0, 1, 11, 13, 10**7, 10**7 + 1, 2**32 - 1)),
            ("<H", 12, (0, 1, 2, 3, 4, 255, 0x1E01, 0xFF01)),  # degree, and bits
            ("<H", 14, (0x0500, 0x0600, 0x0602, 0x0502, 0xFF00)),  # flags, and streams
            ("<I", 16, (0, 31, 32, table + 1, len(data) - 1, len(data), 2**32 - 1)),
            ("<I", 36, (0, 5, 12, 2**32 - 1)),  # bytes of the extension
            ("<I", 40, (0, 1, 6, 2**32 - 1)),  # the axes
            *[("<Q", entry, (0, 1, 36, 108, 109, 2**31, 2**32, 2**63, 2**64 - 1))] * 4,
        )
    )
    struct.pack_into(kind, out, at, rng.choice(values))
    return bytes(out)


def spz_frame(data: bytes, rng: Random) -> bytes:
    """Puts another ZSTD frame in place of one of an .spz of version 4: a bomb, or two frames."""
    try:
        streams, table = data[15], struct.unpack_from("<I", data, 16)[0]
        sizes = [list(struct.unpack_from("<QQ", data, table + 16 * k)) for k in range(streams)]
    except (struct.error, IndexError) as error:
        raise Unfit from error
    at = table + 16 * streams
    if not data.startswith(b"NGSP") or at + sum(packed for packed, _ in sizes) != len(data):
        raise Unfit
    frames = []
    for packed, _ in sizes:
        frames.append(data[at : at + packed])
        at += packed
    which = rng.randrange(streams)
    blocks = rng.choice((1, 40, BOMB >> 17))  # of 128 kB, of one byte that repeats
    repeat = struct.pack("<I", 1 << 20 | 2)[:3] + b"\0"
    bomb = b"\x28\xb5\x2f\xfd\x00\x58" + repeat * blocks + b"\x01\0\0"
    frames[which] = rng.choice(
        (
            bomb,
            frames[which] * 2,
            frames[which] + bomb,
            any_plain(frames[which], rng),
            frames[which - 1],
        )
    )
    sizes[which][0] = len(frames[which])
    packed_table = b"".join(struct.pack("<QQ", *entry) for entry in sizes)
    return data[:table] + packed_table + b"".join(frames)
