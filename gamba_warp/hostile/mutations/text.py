"""Mutations of text files and of JSON: numbers, words, lines, kinds, depth, names."""

from __future__ import annotations

import json
import re
from random import Random
from typing import Any

from .data import MUTATIONS, Mutation, Unfit

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
_NUMBER = re.compile(rb"[-+]?\d+\.?\d*(?:[eE][-+]?\d+)?")
_WORD = re.compile(rb"[^\s]+")
_TOKENS = {
    b"ply": (b"char", b"list uchar int", b"double", b"element face 3", b"format ascii 1.0",
             b"property list int int x", b"property float x", b"end_header", b"comment"),
    b"# .PCD": (b"ascii", b"binary", b"binary_compressed", b"normal_x", b"rgb", b"F", b"U", b"8",
                b"FIELDS", b"COUNT", b"_", b"x"),
}  # fmt: skip


def encode(text: str) -> bytes:
    """UTF-8, with lone surrogates as they are: what a careless writer gives."""
    return text.encode("utf-8", "surrogatepass")


def _replaced(data: bytes, pattern: re.Pattern, rng: Random, by: bytes, head: bool) -> bytes:
    reach = len(data) if not head or rng.random() < 0.4 else 400
    found = list(pattern.finditer(data[:reach]))
    if not found:
        raise Unfit
    match = rng.choice(found)
    return data[: match.start()] + by + data[match.end() :]


def extreme_number(data: bytes, rng: Random) -> bytes:
    """Replaces a number by one at or beyond the end of its range, or by what is no number."""
    return _replaced(data, _NUMBER, rng, encode(rng.choice(NUMBERS)), True)


def near_number(data: bytes, rng: Random) -> bytes:
    """Counts a whole number up or down by a little, so that a header lies by a little."""
    found = list(re.finditer(rb"\d+", data[: rng.choice((400, len(data)))]))
    if not found:
        raise Unfit
    match = rng.choice(found)
    value = max(0, int(match[0][:18]) + rng.choice((-1, 1, 1, 2, 100)))
    return data[: match.start()] + b"%d" % value + data[match.end() :]


def hostile_word(data: bytes, rng: Random) -> bytes:
    """Replaces a word by a hostile name, by a word of the format's own, or by an over-long one."""
    own = next((words for head, words in _TOKENS.items() if data.startswith(head)), ())
    word = rng.choice([*map(encode, NAMES), *own * 3, b"\xff\xfe", b"9" * 5000])
    return _replaced(data, _WORD, rng, word, True)


def _lines(data: bytes) -> list[bytes]:
    lines = data.split(b"\n")
    if len(lines) < 3:
        raise Unfit
    return lines


def delete_line(data: bytes, rng: Random) -> bytes:
    """Takes a line out, often one of the first."""
    lines = _lines(data)
    del lines[rng.randrange(len(lines) if rng.random() < 0.5 else min(len(lines), 12))]
    return b"\n".join(lines)


def repeat_line(data: bytes, rng: Random) -> bytes:
    """Gives a line twice, or very often."""
    lines = _lines(data)
    at = rng.randrange(len(lines) if rng.random() < 0.5 else min(len(lines), 12))
    lines[at:at] = [lines[at]] * rng.choice((1, 1, 2, 2000))
    return b"\n".join(lines)[: 1 << 20]


def swap_lines(data: bytes, rng: Random) -> bytes:
    """Exchanges two lines."""
    lines = _lines(data)
    a, b = rng.randrange(len(lines)), rng.randrange(min(len(lines), 12))
    lines[a], lines[b] = lines[b], lines[a]
    return b"\n".join(lines)


def cut_line(data: bytes, rng: Random) -> bytes:
    """Leaves a part of a line, or words of it in another order."""
    lines = _lines(data)
    at = rng.randrange(len(lines))
    words = lines[at].split(b" ")
    rng.shuffle(words)
    lines[at] = b" ".join(words[: rng.randint(0, len(words))])
    return b"\n".join(lines)


def garbage_lines(data: bytes, rng: Random) -> bytes:
    """Makes every line from one on no number: what a broken writer leaves."""
    lines = _lines(data)
    at = rng.randrange(len(lines))
    word = rng.choice((b"abc def ghi", b"# x", b"nan nan nan", b"1 2", b"", b"1;2;3", b"1,2,3"))
    return b"\n".join([*lines[:at], *[word] * (len(lines) - at), b""])


def line_ends(data: bytes, rng: Random) -> bytes:
    """Other ends of lines, or other bytes in front."""
    end = rng.choice((b"\r\n", b"\r", b"\n\n", b"\0\n", b" \n", b"\x0c", b"\x85"))
    front = rng.choice((b"", b"", b"\xef\xbb\xbf", b"\xff\xfe", b"\n", b" "))
    return front + data.replace(b"\n", end, rng.choice((-1, 1, 3)))


TEXT: tuple[Mutation, ...] = (
    extreme_number,
    extreme_number,
    extreme_number,
    near_number,
    near_number,
    hostile_word,
    hostile_word,
    delete_line,
    repeat_line,
    swap_lines,
    cut_line,
    garbage_lines,
    line_ends,
)


def paths(value: Any, here: tuple = ()) -> list[tuple]:
    """The way to every value in nested lists and dictionaries, the whole first."""
    found = [here]
    if isinstance(value, (dict, list)) and len(here) < 30:
        items = value.items() if isinstance(value, dict) else enumerate(value)
        for key, inner in list(items)[:50]:
            found += paths(inner, (*here, key))
    return found


def _holder(value: Any, path: tuple) -> Any:
    for key in path[:-1]:
        value = value[key]
    return value


def _hostile_value(old: Any, rng: Random) -> Any:
    numbers = [float("nan"), float("inf"), 1e308, -1, 0, 2**31, 2**63, 10**30, 1e-320, 0.5, True]
    others: list[Any] = [None, True, "", "x", [], {}, [[]], {"": 0}, "1", 3, [1, 2, 3], -0.0]
    if isinstance(old, str) and rng.random() < 0.6:
        return rng.choice(NAMES)
    if isinstance(old, (int, float)) and rng.random() < 0.6:
        return rng.choice(numbers)
    if isinstance(old, list) and old and rng.random() < 0.5:
        return rng.choice(
            (old * 2, old[:-1], old[::-1], old * 1000 if len(old) < 9 else old, [old])
        )
    return rng.choice((*numbers, *others, *NAMES[:6]))


def change_json(data: bytes, rng: Random) -> bytes:
    """Replaces, removes, adds or renames 1 to 3 values anywhere in a JSON document."""
    return dump(changed_tree(tree_of(data), rng))


def tree_of(data: bytes) -> Any:
    """The document. Raises ``Unfit`` where it is not JSON, or too deep."""
    try:
        return json.loads(data)
    except (ValueError, RecursionError) as error:
        raise Unfit from error


def dump(tree: Any) -> bytes:
    """JSON as a careless writer gives it, with NaN and lone surrogates."""
    return encode(json.dumps(tree, ensure_ascii=False))


def changed_tree(tree: Any, rng: Random) -> Any:
    """As ``change_json``, of the document itself, which is changed in place."""
    for _ in range(rng.choice((1, 1, 2, 3))):
        path = rng.choice(paths(tree))
        if not path:
            if rng.random() < 0.1:
                return _hostile_value(tree, rng)
            continue
        holder, key = _holder(tree, path), path[-1]
        choice = rng.random()
        if choice < 0.7:
            holder[key] = _hostile_value(holder[key], rng)
        elif choice < 0.85:
            del holder[key]
        elif isinstance(holder, dict):
            holder[rng.choice((*NAMES, "extra", str(key).upper()))] = holder[key]
        else:
            holder.insert(rng.randint(0, len(holder)), _hostile_value(None, rng))
    return tree


def deep_json(data: bytes, rng: Random) -> bytes:
    """Nests lists or objects by the hundred or the hundred thousand, in place of a value."""
    deep = rng.choice((20, 40, 500, 990, 1100, 100_000))
    opened, closed = rng.choice((("[", "]"), ('{"a":', "}")))
    inner = opened * deep + "1" + closed * deep
    if rng.random() < 0.2:
        return inner[: rng.choice((len(inner), deep))].encode()
    tree = tree_of(data)
    path = rng.choice(paths(tree))
    if not path:
        return inner.encode()
    _holder(tree, path)[path[-1]] = "@deep@"
    return dump(tree).replace(b'"@deep@"', inner.encode(), 1)


def repeat_key(data: bytes, rng: Random) -> bytes:
    """Gives a key twice, with another value."""
    found = list(re.finditer(rb'"(\w+)":', data))
    if not found:
        raise Unfit
    match = rng.choice(found)
    value = rng.choice((b"null", b"0", b"-1", b'"x"', b"[]", b"1e999", b"NaN"))
    return data[: match.start()] + match[0] + value + b"," + data[match.start() :]


JSON: tuple[Mutation, ...] = (
    *(change_json,) * 8,
    deep_json,
    repeat_key,
    extreme_number,
    near_number,
    hostile_word,
)


def any_plain(data: bytes, rng: Random) -> bytes:
    """One of the plain mutations that fits."""
    for _ in range(20):
        try:
            return rng.choice((*MUTATIONS, *TEXT))(data, rng)
        except Unfit:
            continue
    return data
