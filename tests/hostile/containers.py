"""Mutations of containers: the content changes, and the container stays valid."""

import ast
import functools
import gzip
import io
import json
import re
import struct
import zlib
from typing import Any

import numpy as np
import torch
from helpers.images import png_of
from helpers.meshes import glb
from hypothesis import strategies as st

from .mutations import BOMB, Draw, any_plain, chance, change_json, changed_tree, choice, dump
from .seeds import npy


def safetensors_header(draw: Draw, data: bytes) -> bytes:
    """Change the JSON header of a safetensors file, or its metadata's JSON."""
    size = struct.unpack("<Q", data[:8])[0]
    header = json.loads(data[8 : 8 + size])
    if "__metadata__" in header and chance(draw, 60):
        inner = header["__metadata__"]
        inner["config"] = change_json(draw, inner["config"].encode()).decode("utf-8", "replace")
    else:
        header = changed_tree(draw, header)
    text = dump(header)
    return struct.pack("<Q", len(text)) + text + data[8 + size :]


def safetensors_values(draw: Draw, data: bytes) -> bytes:
    """Put non-finite or huge numbers among the weights; the header stays valid."""
    start, out = 8 + struct.unpack("<Q", data[:8])[0], bytearray(data)
    for _ in range(choice(draw, 1, 1, 30)):
        at = start + 4 * draw(st.integers(0, (len(data) - start) // 4 - 1))
        out[at : at + 4] = struct.pack("<f", choice(draw, float("nan"), float("inf"), 3e38, -1e30))
    return bytes(out)


def glb_tree(draw: Draw, data: bytes) -> bytes:
    """Change the tree or the binary part of a .glb, whose lengths then fit."""
    size = struct.unpack("<I", data[12:16])[0]
    tree, binary = json.loads(data[20 : 20 + size]), data[28 + size :]
    if chance(draw, 30):
        return glb(dump(tree), any_plain(draw, binary))
    return glb(dump(changed_tree(draw, tree)), binary)


def npy_header(draw: Draw, data: bytes) -> bytes:
    """Change shape, type or order in a ``.npy`` header, or make another kind of array of it."""
    if chance(draw, 40):
        content = io.BytesIO()
        np.savez(content, a=np.ones((3, 4)))
        arrays = (
            np.array(3.0), np.zeros((3, 4), "M8[s]"), np.zeros((3, 4), "S8"), np.zeros((0, 4)),
            np.full((3, 4), np.nan), np.zeros((3, 4), complex), np.zeros((3, 4), ">i2"),
            np.zeros((3, 2), "f4,i4"), np.full((3, 2), 1e308), np.zeros((3, 2), bool),
        )  # fmt: skip
        return choice(draw, *map(npy, arrays), content.getvalue())
    match = re.match(rb"\x93NUMPY\x01\x00..(\{.*?\}) *\n", data, re.DOTALL)
    fields = ast.literal_eval(match[1].decode())
    sides = ((3, 4), (2**31, 2**31), (3, -4), (10**9,), (), (3, 4, 1), (2**62,))
    fields["shape"] = choice(draw, *sides)
    kinds = ("<f8", "|O", ">f4", "<U1000000", "|V9", "<f2", "f8, f8", "<M8[s]", "|S0")
    fields["descr"] = choice(draw, fields["descr"], *kinds)
    text = (repr(fields) + " " * choice(draw, 0, 7, 70_000)).encode() + b"\n"
    return b"\x93NUMPY\x02\x00" + struct.pack("<I", len(text)) + text + data[match.end() :]


@functools.cache
def _bomb(size: int) -> bytes:
    return zlib.compress(bytes(size), 9)


def png_chunks(draw: Draw, data: bytes) -> bytes:
    """Change sizes, depth or chunks of a PNG, whose checksums then fit."""
    chunks, at = [], 8
    while at + 12 <= len(data):
        size = struct.unpack(">I", data[at : at + 4])[0]
        chunks.append((data[at + 4 : at + 8], data[at + 8 : at + 8 + size]))
        at += 12 + size
    at = draw(st.integers(0, len(chunks) - 1))
    kind = choice(draw, *["header"] * 4, "plain", "plain", "copy", "delete", "bomb", "frames")
    if kind == "header":
        width, height, *rest = struct.unpack(">IIBBBBB", chunks[0][1])
        sides = (width, 0, 1, 65535, 100_000, 2**31 - 1, 2**31)
        width, height = choice(draw, *sides), choice(draw, height, *sides)
        if chance(draw, 40):
            rest[draw(st.integers(0, 4))] = choice(draw, 0, 1, 2, 3, 4, 6, 8, 16, 255)
        chunks[0] = (b"IHDR", struct.pack(">IIBBBBB", width, height, *rest))
    elif kind == "plain":
        chunks[at] = (chunks[at][0], any_plain(draw, chunks[at][1]))
    elif kind == "copy":
        chunks.insert(at, choice(draw, *chunks))
    elif kind == "delete":
        del chunks[at]
    elif kind == "bomb":
        name = choice(draw, b"zTXt", b"iCCP", b"iTXt")
        start = b"k\0\0" if name != b"iTXt" else b"k\0\x01\0\0\0"
        chunks.insert(1, (name, start + _bomb(BOMB // 16)))
    else:
        chunks.insert(1, (b"acTL", struct.pack(">II", choice(draw, 2, 2**31 - 1), 0)))
    return png_of(*chunks)


def torch_values(draw: Draw, data: bytes) -> bytes:
    """Change values, types and shapes in a file of ``torch.save``, and write it again."""
    tree = torch.load(io.BytesIO(data), map_location="cpu", weights_only=True)
    for _ in range(draw(st.integers(1, 2))):
        holder, key, node = None, None, tree
        while isinstance(node, (dict, list)) and node and (holder is None or chance(draw, 75)):
            holder, keys = node, list(node) if isinstance(node, dict) else range(len(node))
            key = choice(draw, *keys)
            node = node[key]
        others: list[Any] = [None, "x", -1, 2**63, float("nan"), [], {}, True, torch.zeros(0)]
        others += [1e308, torch.full((2,), float("nan")), torch.zeros(3, 3, dtype=torch.int8)]
        if isinstance(node, torch.Tensor):
            others += [node * float("nan")] * 3 + [node[:0] if node.dim() else node, node[None]]
            others += [node.abs().double(), node.to(torch.complex64), node.clone().fill_(100)]
        if holder is None:
            tree = choice(draw, *others)
        elif isinstance(holder, dict) and chance(draw, 20):
            del holder[key]
        else:
            holder[key] = choice(draw, *others)
    content = io.BytesIO()
    torch.save(tree, content)
    return content.getvalue()


def gzip_inside(draw: Draw, data: bytes) -> bytes:
    """Change the content of a gzip stream, or enlarge it; its checksum then matches."""
    inner = gzip.decompress(data)
    kind = choice(draw, "plain", "plain", "header", "bomb")
    if kind == "bomb":
        return gzip.compress(inner + bytes(BOMB // 4), 9)
    if kind == "plain":
        return gzip.compress(any_plain(draw, inner))
    return gzip.compress(
        _packed(
            draw,
            inner,
            *(("<I", 4, (0, 1, 2, 3, 4, 2**32 - 1)), ("B", 12, (0, 1, 2, 3, 4, 255))),
            ("<I", 8, (0, 1, 11, 13, 10**7, 10**7 + 1, 2**32 - 1)),
            *(("B", 13, (0, 12, 24, 31, 255)), ("B", 14, (0, 1, 2, 3, 255))),
        )
    )


def _packed(draw: Draw, data: bytes, *fields: tuple) -> bytes:
    """Change one of the fields, each a ``struct`` format, an offset and values."""
    kind, at, values = choice(draw, *fields)
    out = bytearray(data)
    struct.pack_into(kind, out, at, choice(draw, *values))
    return bytes(out)


def spz_table(draw: Draw, data: bytes) -> bytes:
    """Change a number of the plain header or the table of contents of an .spz of version 4."""
    table = struct.unpack_from("<I", data, 16)[0] if data.startswith(b"NGSP") else len(data)
    entry = min(table + 8 * draw(st.integers(0, 11)), len(data) - 8)
    return _packed(
        draw,
        data,
        ("<I", 4, (0, 3, 5, 2**32 - 1)),
        ("<I", 8, (0, 1, 11, 13, 10**7, 10**7 + 1, 2**32 - 1)),
        ("<H", 12, (0, 1, 2, 3, 4, 255, 0x1E01, 0xFF01)),  # degree, and bits
        ("<H", 14, (0x0500, 0x0600, 0x0602, 0x0502, 0xFF00)),  # flags, and streams
        ("<I", 16, (0, 31, 32, table + 1, len(data) - 1, len(data), 2**32 - 1)),
        ("<I", 36, (0, 5, 12, 2**32 - 1)),  # bytes of the extension
        ("<I", 40, (0, 1, 6, 2**32 - 1)),  # the axes
        *[("<Q", entry, (0, 1, 36, 108, 109, 2**31, 2**32, 2**63, 2**64 - 1))] * 4,
    )


def spz_frame(draw: Draw, data: bytes) -> bytes:
    """Put another ZSTD frame in place of one of an .spz of version 4: a bomb, or two frames."""
    streams, table = data[15], struct.unpack_from("<I", data, 16)[0]
    sizes = [list(struct.unpack_from("<QQ", data, table + 16 * k)) for k in range(streams)]
    at, frames = table + 16 * streams, []
    for packed, _ in sizes:
        frames.append(data[at : at + packed])
        at += packed
    which = draw(st.integers(0, streams - 1))
    blocks = choice(draw, 1, 40, BOMB >> 17)  # of 128 kB, of one byte that repeats
    repeat = struct.pack("<I", 1 << 20 | 2)[:3] + b"\0"
    bomb, old = b"\x28\xb5\x2f\xfd\x00\x58" + repeat * blocks + b"\x01\0\0", frames[which]
    kinds = (old * 2, bomb, old + bomb, any_plain(draw, old), frames[which - 1])
    frames[which] = choice(draw, *kinds)
    sizes[which][0] = len(frames[which])
    packed_table = b"".join(struct.pack("<QQ", *entry) for entry in sizes)
    return data[:table] + packed_table + b"".join(frames)


BY_SUFFIX = {
    ".spz": (gzip_inside, spz_table, spz_frame),
    ".safetensors": (safetensors_header, safetensors_header, safetensors_values),
    ".glb": (glb_tree,),
    ".npy": (npy_header,),
    ".png": (png_chunks,),
    ".pt": (torch_values,),
    ".pth": (torch_values,),
}
