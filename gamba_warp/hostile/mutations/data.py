"""Mutations that know nothing of a format: cuts, flips, blocks, and numbers in bytes.

A mutation is a function of bytes and a source of chance; it returns other bytes, or raises
``Unfit`` where the bytes give it nothing to do.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from random import Random

Mutation = Callable[[bytes, Random], bytes]
BOMB = 300 << 20  # bytes that a bomb unpacks to; it takes a few hundred kB
MOST_BYTES = 4 << 20  # a mutated file is no larger: what is tested is readers, not their patience


class Unfit(Exception):
    """Raised where a mutation does not apply to the bytes that it is given."""


def _needs(data: bytes, least: int) -> None:
    if len(data) < least:
        raise Unfit


def _span(data: bytes, rng: Random, most: int = 64) -> tuple[int, int]:
    """A start and a length within the bytes; short spans are as likely as long ones."""
    start = rng.randrange(len(data))
    return start, rng.randint(
        1, max(1, min(len(data) - start, 2 ** rng.randint(0, most.bit_length())))
    )


def truncate(data: bytes, rng: Random) -> bytes:
    """Cuts the end off: anywhere, or just a few bytes."""
    _needs(data, 1)
    if rng.random() < 0.3:
        return data[: -rng.randint(1, min(8, len(data)))]
    return data[: rng.randrange(len(data))]


def flip_bits(data: bytes, rng: Random) -> bytes:
    """Turns over 1 to 8 bits, often of the first bytes."""
    _needs(data, 1)
    out = bytearray(data)
    reach = len(out) if rng.random() < 0.6 else min(len(out), 128)
    for _ in range(rng.choice((1, 1, 2, 8))):
        out[rng.randrange(reach)] ^= 1 << rng.randrange(8)
    return bytes(out)


def set_bytes(data: bytes, rng: Random) -> bytes:
    """Fills a span with 0, 255 or random bytes."""
    _needs(data, 1)
    start, length = _span(data, rng)
    fill = rng.choice((b"\0" * length, b"\xff" * length, rng.randbytes(length)))
    return data[:start] + fill + data[start + length :]


def delete_block(data: bytes, rng: Random) -> bytes:
    """Takes a span out."""
    _needs(data, 2)
    start, length = _span(data, rng, 256)
    return data[:start] + data[start + length :]


def insert_bytes(data: bytes, rng: Random) -> bytes:
    """Puts random bytes in."""
    at, length = rng.randint(0, len(data)), rng.choice((1, 2, 4, 16, 100))
    return data[:at] + rng.randbytes(length) + data[at:]


def copy_block(data: bytes, rng: Random) -> bytes:
    """Repeats a span at another place, over what is there or between it."""
    _needs(data, 2)
    start, length = _span(data, rng, 256)
    at = rng.randrange(len(data))
    end = at + length if rng.random() < 0.5 else at
    return data[:at] + data[start : start + length] + data[end:]


def swap_blocks(data: bytes, rng: Random) -> bytes:
    """Exchanges two halves of a span."""
    _needs(data, 4)
    start, end = sorted(rng.sample(range(len(data) + 1), 2))
    middle = (start + end) // 2
    return data[:start] + data[middle:end] + data[start:middle] + data[end:]


def append(data: bytes, rng: Random) -> bytes:
    """Adds bytes after the end: random ones, or the file once more."""
    return data + rng.choice((rng.randbytes(rng.choice((1, 3, 64, 5000))), data))


def _words() -> list[bytes]:
    whole = (0, 1, 0x7F, 0xFF, 0x7FFF, 0xFFFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, 0xFFFFFFC4)
    found = [value.to_bytes(8, "little")[:size] for value in whole for size in (1, 2, 4)]
    found += [b.to_bytes(8, "little") for b in (1, 2**31, 2**32, 2**63 - 1, 2**63, 2**64 - 1)]
    for value in (float("nan"), float("inf"), -float("inf"), 1e38, 1e-40, -0.0):
        found += [struct.pack("<f", value), struct.pack("<d", value)]
    found.append(struct.pack("<d", 1e308))
    return list(dict.fromkeys(found))


_WORDS = _words()


def extreme_word(data: bytes, rng: Random) -> bytes:
    """Replaces 1 to 8 bytes by a number at the end of its range, in either byte order."""
    _needs(data, 1)
    word = rng.choice(_WORDS)
    word = word[::-1] if rng.random() < 0.4 else word
    _needs(data, len(word))
    reach = len(data) - len(word)
    at = rng.randint(0, reach if rng.random() < 0.5 else min(reach, 128))
    at -= at % len(word) if rng.random() < 0.5 else 0
    return data[:at] + word + data[at + len(word) :]


def add_to_word(data: bytes, rng: Random) -> bytes:
    """Counts a number of 1, 2, 4 or 8 bytes up or down by a little, or doubles it."""
    size = rng.choice((1, 2, 4, 4, 8))
    _needs(data, size)
    reach = len(data) - size
    at = rng.randint(0, reach if rng.random() < 0.5 else min(reach, 128))
    order = rng.choice(("little", "big"))
    value = int.from_bytes(data[at : at + size], order)
    value = (
        value * 2 if rng.random() < 0.2 else value + rng.choice((-8, -1, 1, 2, 64))
    ) % 256**size
    return data[:at] + value.to_bytes(size, order) + data[at + size :]


def nothing_left(data: bytes, rng: Random) -> bytes:
    """Leaves no byte."""
    return b""


MUTATIONS: tuple[Mutation, ...] = (
    truncate,
    truncate,
    flip_bits,
    flip_bits,
    set_bytes,
    delete_block,
    insert_bytes,
    copy_block,
    swap_blocks,
    append,
    extreme_word,
    extreme_word,
    extreme_word,
    add_to_word,
    nothing_left,
)
