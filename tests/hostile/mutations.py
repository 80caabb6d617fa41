"""Mutations of bytes, text and JSON.

A mutation is a function of hypothesis's ``draw`` and of bytes, and returns other bytes. It raises
if it cannot be applied. Hypothesis shrinks failing cases towards the first of a list of choices.
"""

import json
import re
import struct
from collections.abc import Callable
from functools import reduce
from operator import getitem
from typing import Any

from hypothesis import strategies as st

Draw = Callable[[st.SearchStrategy], Any]
BOMB = 300 << 20  # bytes that a bomb unpacks to; it takes a few hundred kB
NUMBERS = (
    "0", "-1", "1", "-60", "2147483647", "2147483648", "-2147483649", "9223372036854775807",
    "9223372036854775808", "18446744073709551616", "1e308", "1e400", "-1e400", "nan", "NaN",
    "Infinity", "inf", "-inf", "1e-320", "1000000", "1000000000", "65536", "0x10", "1_000", "1,5",
    "1e", "--1", "+", "9" * 400, "0." + "3" * 400, "\u0663", "",
)  # fmt: skip
NAMES = (
    "../x", "..", ".", "", "/etc/passwd", "/dev/zero", "/dev/stdin", "/../x",
    "../../canary/kept.txt", "../canary/kept.png", "a" * 300, "a" * 5000, "x/" * 600 + "x",
    "a\0b", "\ud800", "caf\u00e9",
    "CON", "C:\\x.png", "..\\..\\x", "~/x", "$HOME", "-rf", "a\nb", "a\x1b[31mb", "\u202egnp.exe",
    "<script>alert(1)</script>", "' onerror='alert(1)", "%s%n", "file:///etc/passwd",
    "http://127.0.0.1:9/x", "data:image/png;base64,AAAA", "x" + chr(0x10FFFF),
)  # fmt: skip
_PLY = (
    b"char", b"list uchar int", b"double", b"element face 3", b"format ascii 1.0",
    b"property list int int x", b"property float x", b"end_header", b"comment",
)  # fmt: skip
_WHOLE = (0, 1, 0x7F, 0xFF, 0x7FFF, 0xFFFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, 0xFFFFFFC4)
_FLOATS = (float("nan"), float("inf"), -float("inf"), 1e38, 1e-40, -0.0)
_WORDS = dict.fromkeys(
    [
        *(value.to_bytes(8, "little")[:size] for value in _WHOLE for size in (1, 2, 4)),
        *(v.to_bytes(8, "little") for v in (1, 2**31, 2**32, 2**63 - 1, 2**63, 2**64 - 1)),
        *(struct.pack(kind, value) for value in _FLOATS for kind in ("<f", "<d")),
        struct.pack("<d", 1e308),
    ]
)


def choice(draw: Draw, *values: Any) -> Any:
    """One of the values."""
    return draw(st.sampled_from(values))


def chance(draw: Draw, percent: int) -> bool:
    """True with this probability."""
    return draw(st.integers(0, 99)) >= 100 - percent


def position(draw: Draw, most: int) -> int:
    """An offset from 0 to ``most``, often small, where headers are."""
    return draw(st.integers(0, min(most, 128)) | st.integers(0, most))


def encode(text: str) -> bytes:
    """Encode to UTF-8 with lone surrogates, like a careless writer."""
    return text.encode("utf-8", "surrogatepass")


def _span(draw: Draw, data: bytes) -> tuple[int, int]:
    start = position(draw, len(data))
    return start, start + draw(st.integers(1, 8) | st.integers(1, 256))


def cut(draw: Draw, data: bytes) -> bytes:
    """Remove a span, all that follows an offset, or a few bytes at the end."""
    start, end = _span(draw, data)
    return choice(draw, data[:start] + data[end:], data[:start], data[: start - end])


def put(draw: Draw, data: bytes) -> bytes:
    """Insert bytes or overwrite others: any, equal ones, a part of the file, or all of it."""
    start, end = _span(draw, data)
    blocks = data[start:end], b"\0" * (end - start), b"\xff" * (end - start), data
    block = draw(st.sampled_from(blocks) | st.binary(min_size=1, max_size=100))
    at = choice(draw, position(draw, len(data)), len(data))
    return data[:at] + block + data[choice(draw, at, at + len(block)) :]


def flip_bits(draw: Draw, data: bytes) -> bytes:
    """Turn over 1 to 8 bits."""
    out = bytearray(data)
    for _ in range(draw(st.integers(1, 8))):
        out[position(draw, len(out) - 1)] ^= 1 << draw(st.integers(0, 7))
    return bytes(out)


def extreme_word(draw: Draw, data: bytes) -> bytes:
    """Replace 1 to 8 bytes by a number at the end of its range, in either byte order."""
    word = choice(draw, *_WORDS)[:: choice(draw, 1, -1)]
    at = position(draw, len(data) - len(word))
    at -= at % len(word) if draw(st.booleans()) else 0
    return data[:at] + word + data[at + len(word) :]


def add_to_word(draw: Draw, data: bytes) -> bytes:
    """Change a number of 1, 2, 4 or 8 bytes by a little, or double it."""
    size, order = choice(draw, 4, 1, 2, 8), choice(draw, "little", "big")
    at = position(draw, len(data) - size)
    value = int.from_bytes(data[at : at + size], order)
    value += choice(draw, 1, -1, 2, 64, -8, value)
    return data[:at] + (value % 256**size).to_bytes(size, order) + data[at + size :]


BYTES = (
    *(cut, cut, cut, flip_bits, flip_bits, put, put, put, put),
    *(extreme_word, extreme_word, extreme_word, add_to_word),
)


def _replaced(draw: Draw, data: bytes, pattern: bytes, by: Callable[[bytes], bytes]) -> bytes:
    reach = choice(draw, 400, len(data))
    match = choice(draw, *re.finditer(pattern, data[:reach]))
    return data[: match.start()] + by(match[0]) + data[match.end() :]


def extreme_number(draw: Draw, data: bytes) -> bytes:
    """Replace a number by one at or beyond the end of its range, or by other text."""
    by = encode(choice(draw, *NUMBERS))
    return _replaced(draw, data, rb"[-+]?\d+\.?\d*(?:[eE][-+]?\d+)?", lambda _: by)


def near_number(draw: Draw, data: bytes) -> bytes:
    """Change an integer by a little, so that a header is slightly wrong."""
    step = choice(draw, 1, -1, 2, 100)
    return _replaced(draw, data, rb"\d+", lambda old: b"%d" % max(0, int(old[:18]) + step))


def hostile_word(draw: Draw, data: bytes) -> bytes:
    """Replace a word by a hostile name, by a word of the format's own, or by an over-long one."""
    own = _PLY if data.startswith(b"ply") else ()
    word = choice(draw, *map(encode, NAMES), *own * 3, b"\xff\xfe", b"9" * 5000)
    return _replaced(draw, data, rb"[^\s]+", lambda _: word)


def change_lines(draw: Draw, data: bytes) -> bytes:
    """Remove, repeat, move or cut a line; or remove all following lines without numbers."""
    lines = data.split(b"\n")
    last = len(lines) - 1
    at = draw(st.integers(0, min(last, 12)) | st.integers(0, last))
    kind = choice(draw, "delete", "repeat", "swap", "cut", "garbage")
    if kind == "delete":
        del lines[at]
    elif kind == "repeat":
        lines[at:at] = [lines[at]] * choice(draw, 1, 2, 2000)
    elif kind == "swap":
        other = draw(st.integers(0, last))
        lines[at], lines[other] = lines[other], lines[at]
    elif kind == "cut":
        words = draw(st.permutations(lines[at].split(b" ")))
        lines[at] = b" ".join(words[: draw(st.integers(0, len(words)))])
    else:
        word = choice(draw, b"abc def ghi", b"# x", b"nan nan nan", b"1 2", b"", b"1;2;3", b"1,2,3")
        lines[at:] = [word] * (last - at) + [b""]
    return b"\n".join(lines)[: 1 << 20]


def line_ends(draw: Draw, data: bytes) -> bytes:
    """Change the line ends, or the bytes at the start."""
    end = choice(draw, b"\r\n", b"\r", b"\n\n", b"\0\n", b" \n", b"\x0c", b"\x85")
    front = choice(draw, b"", b"\xef\xbb\xbf", b"\xff\xfe", b"\n", b" ")
    return front + data.replace(b"\n", end, choice(draw, -1, 1, 3))


TEXT = (
    *(extreme_number, extreme_number, near_number, near_number, hostile_word, hostile_word),
    *(change_lines, change_lines, line_ends),
)


def _paths(value: Any, here: tuple = ()) -> list[tuple]:
    """Path to every value in nested lists and dictionaries, except the root."""
    found = [here] if here else []
    if isinstance(value, (dict, list)) and len(here) < 30:
        items = value.items() if isinstance(value, dict) else enumerate(value)
        for key, inner in list(items)[:50]:
            found += _paths(inner, (*here, key))
    return found


def _hostile_value(draw: Draw, old: Any) -> Any:
    numbers = [-1, 0, float("nan"), float("inf"), 1e308, 2**31, 2**63, 10**30, 1e-320, 0.5, True]
    others: list[Any] = [None, "", "x", [], {}, [[]], {"": 0}, "1", 3, [1, 2, 3], -0.0]
    kinds = [(*others, *numbers, *NAMES[:6])]
    if isinstance(old, str):
        kinds.append(NAMES)
    elif isinstance(old, (int, float)):
        kinds.append(tuple(numbers))
    elif isinstance(old, list) and old:
        kinds.append((old * 2, old[:-1], old[::-1], old * 1000 if len(old) < 9 else old, [old]))
    return choice(draw, *choice(draw, *kinds))


def dump(tree: Any) -> bytes:
    """JSON of a careless writer, with NaN and lone surrogates."""
    return encode(json.dumps(tree, ensure_ascii=False))


def changed_tree(draw: Draw, tree: Any) -> Any:
    """Replaces, removes, adds or renames 1 to 3 values anywhere in a document, in place."""
    for _ in range(draw(st.integers(1, 3))):
        paths = _paths(tree)
        if not paths or chance(draw, 1):
            return _hostile_value(draw, tree)
        *way, key = choice(draw, *paths)
        holder = reduce(getitem, way, tree)
        kind = choice(draw, "value", "value", "value", "value", "delete", "add")
        if kind == "value":
            holder[key] = _hostile_value(draw, holder[key])
        elif kind == "delete":
            del holder[key]
        elif isinstance(holder, dict):
            holder[choice(draw, *NAMES, "extra", str(key).upper())] = holder[key]
        else:
            holder.insert(key, _hostile_value(draw, None))
    return tree


def change_json(draw: Draw, data: bytes) -> bytes:
    """Change values of a JSON document."""
    return dump(changed_tree(draw, json.loads(data)))


def deep_json(draw: Draw, data: bytes) -> bytes:
    """Replace a value by a hundred or a hundred thousand nested lists or objects."""
    deep = choice(draw, 20, 40, 500, 990, 1100, 100_000)
    opened, closed = choice(draw, ("[", "]"), ('{"a":', "}"))
    inner = (opened * deep + "1" + closed * deep).encode()
    if chance(draw, 20):
        return inner[: choice(draw, len(inner), deep)]
    tree = json.loads(data)
    *way, key = choice(draw, *_paths(tree))
    reduce(getitem, way, tree)[key] = "@deep@"
    return dump(tree).replace(b'"@deep@"', inner, 1)


def repeat_key(draw: Draw, data: bytes) -> bytes:
    """Give a key twice, with another value."""
    value = choice(draw, b"null", b"0", b"-1", b'"x"', b"[]", b"1e999", b"NaN")
    return _replaced(draw, data, rb'"(\w+)":', lambda key: key + value + b"," + key)


JSON = (*(change_json,) * 6, deep_json, repeat_key, extreme_number, near_number, hostile_word)


def any_plain(draw: Draw, data: bytes) -> bytes:
    """One of the mutations that need no format."""
    return choice(draw, *BYTES, *TEXT)(draw, data)
