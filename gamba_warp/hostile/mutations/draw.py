"""Draws hostile cases: sound files, then one to four mutations."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from pathlib import PurePosixPath
from random import Random

from ..case import Case, Entry, sound_case
from .containers import BY_SUFFIX
from .data import MOST_BYTES, MUTATIONS, Unfit
from .text import JSON, NAMES, TEXT, encode

JSON_SUFFIXES = (".json", ".gltf")
TEXT_SUFFIXES = (".obj", ".mtl", ".ply", ".off", ".xyz", ".pts", ".pcd", ".stl", ".txt", ".gltf")
_TRIES = 30
# A file that other mutations have broken already gives a mutation of its format nothing to do.
_BROKEN = (
    RecursionError,
    ValueError,
    KeyError,
    IndexError,
    TypeError,
    AttributeError,
    struct.error,
)
_NOTHING_TO_DO = (Unfit, *_BROKEN)


def draw_case(
    reader: str, seed: str, main: str, files: Mapping[str, bytes], others: list[bytes], rng: Random
) -> Case:
    """Makes a hostile case of sound files.

    Args:
        reader: name of the reader.
        seed: name of the sound files.
        main: name of the file that the reader is pointed at, or "" for the folder.
        files: the sound files; the first is the most important one.
        others: files of other cases, for splices.
        rng: source of chance.
    """
    case = sound_case(reader, seed, main, files)
    for _ in range(rng.choice((1, 1, 1, 2, 2, 3, 4))):
        case = _mutated(case, others, rng)
    return case


def _mutated(case: Case, others: list[bytes], rng: Random) -> Case:
    choice = rng.random()
    if not case.files:
        return case
    if choice < 0.05:
        return _other_kind(case, rng)
    if choice < 0.08:
        return _renamed(case, rng)
    names = [name for name, entry in case.files.items() if entry.kind == "file"]
    if not names:
        return case
    name = names[0] if rng.random() < 0.6 else rng.choice(names)
    data = case.files[name].data
    if choice < 0.12:
        other = rng.choice(others)
        at, start = rng.randint(0, len(data)), rng.randint(0, len(other))
        spliced = rng.choice((other, data[:at] + other[start:], data + other))
        return _with(case, name, Entry(data=spliced[:MOST_BYTES]), f"{name}: splice")
    # This process unpacks only what is whole: a file with bytes changed may be a trap for it too.
    whole = not any(text.startswith(f"{name}: ") for text in case.mutations)
    for _ in range(_TRIES):
        mutation = rng.choice(_mutations(name, whole, rng))
        try:
            changed = mutation(data, rng)[:MOST_BYTES]
        except _NOTHING_TO_DO:
            continue
        if changed != data:
            return _with(case, name, Entry(data=changed), f"{name}: {mutation.__name__}")
    return case


def _mutations(name: str, whole: bool, rng: Random) -> tuple:
    suffix = PurePosixPath(name).suffix.lower()
    kinds = [MUTATIONS]
    if whole and suffix in BY_SUFFIX:
        kinds += [BY_SUFFIX[suffix]] * 2
    if suffix in JSON_SUFFIXES:
        kinds += [JSON] * 4
    if suffix in TEXT_SUFFIXES:
        kinds += [TEXT] * 2
    return rng.choice(kinds)


def _with(case: Case, name: str, entry: Entry, text: str) -> Case:
    files = {**case.files, name: entry}
    return Case(case.reader, case.seed, case.main, files, (*case.mutations, text))


def _other_kind(case: Case, rng: Random) -> Case:
    """A folder, a pipe, a link or nothing where a file should be."""
    name = rng.choice(list(case.files))
    kind = rng.choice(("folder", "pipe", "link", "link", "locked", "none"))
    if kind == "none":
        files = {other: entry for other, entry in case.files.items() if other != name}
        text = f"{name}: missing"
        return Case(case.reader, case.seed, case.main, files, (*case.mutations, text))
    entry = Entry(kind=kind, data=case.files[name].data)
    if kind == "link":
        deep = "../" * (name.count("/") + 2)
        target = rng.choice((f"{deep}canary/kept.txt", "/dev/zero", "/etc/passwd", "nothing", name))
        entry = Entry(kind="link", data=encode(target))
    return _with(case, name, entry, f"{name}: {kind}")


def _renamed(case: Case, rng: Random) -> Case:
    """Another name, or another suffix, for a file; the reader is pointed at the new name."""
    name = rng.choice(list(case.files))
    path = PurePosixPath(name)
    suffixes = (
        ".png",
        ".ply",
        ".obj",
        ".gltf",
        ".pcd",
        ".PLY",
        "",
        ".json",
        ".eps",
        ".npy",
        ".xyz",
    )
    odd = [n for n in NAMES if 0 < len(n) < 100 and "/" not in n and "\0" not in n]
    odd = [n for n in odd if n not in ("..", ".") and "\\" not in n and n.isprintable()]
    new = rng.choice(
        (path.stem + rng.choice(suffixes), rng.choice(odd) + path.suffix, "..." + path.suffix)
    )
    if path.suffix == ".sh3f" and rng.random() < 0.7:
        new = rng.choice(("...sh3f", "icons.sh3f", "catalogue.json.sh3f", ".sh3f", "a b.sh3f"))
    new = (path.parent / new).as_posix()
    if new in case.files or any(part.startswith(new + "/") for part in case.files):
        return case
    files = {new if other == name else other: entry for other, entry in case.files.items()}
    main = new if case.main == name else case.main
    return Case(case.reader, case.seed, main, files, (*case.mutations, f"{name}: named {new}"))
