"""Draws fuzzing cases: valid files, then one to four mutations."""

import re
import struct
import tarfile
import zipfile
import zlib
from collections.abc import Sequence
from pathlib import PurePosixPath

from hypothesis import strategies as st
from msgspec.structs import replace

from .case import Case, Entry
from .containers import BY_SUFFIX
from .mutations import BYTES, JSON, NAMES, TEXT, Draw, choice, encode, position

MOST_BYTES = 4 << 20  # largest mutated file; this tests readers, not their speed
UNFIT = (
    *(ValueError, KeyError, IndexError, TypeError, AttributeError, RecursionError, struct.error),
    *(OSError, EOFError, zlib.error, zipfile.BadZipFile, tarfile.TarError, NotImplementedError),
)
_JSON_SUFFIXES = (".json", ".gltf")
_TEXT_SUFFIXES = (".obj", ".mtl", ".ply", ".off", ".xyz", ".stl", ".txt", ".gltf")


def _kinds(name: str, whole: bool) -> list[tuple]:
    """Mutations for a file, with those of its format more frequent."""
    suffix = PurePosixPath(name).suffix.lower()
    kinds = [BYTES]
    if whole and suffix in BY_SUFFIX:
        kinds += [BY_SUFFIX[suffix]] * 2
    kinds += [JSON] * 4 if suffix in _JSON_SUFFIXES else []
    return kinds + ([TEXT] * 2 if suffix in _TEXT_SUFFIXES else [])


def _changed(draw: Draw, case: Case, others: list[bytes]) -> Case:
    """A case with one file changed, of another kind, renamed, or missing."""
    names = list(case.files)
    name = choice(draw, names[0], choice(draw, *names))
    entry, what = case.files[name], choice(draw, *["bytes"] * 20, "splice", "kind", "name")
    if what == "kind":
        return _other_kind(draw, case, name)
    if what == "name":
        return _renamed(draw, case, name)
    if entry.kind != "file":
        return case
    if what == "splice":
        other = choice(draw, *others)
        at, start = position(draw, len(entry.data)), position(draw, len(other))
        joined = entry.data[:at] + other[start:]
        data = choice(draw, other, joined, entry.data + other)
    else:
        # This process only unpacks valid files: changed bytes may harm it, too.
        whole = not any(text.startswith(f"{name}: ") for text in case.mutations)
        mutation = choice(draw, *choice(draw, *_kinds(name, whole)))
        what = mutation.__name__
        try:
            data = mutation(draw, entry.data)
        except UNFIT:
            return case
    return _with(case, name, Entry(data[:MOST_BYTES]), what)


def _with(case: Case, name: str, entry: Entry | None, what: str) -> Case:
    files = {other: item for other, item in case.files.items() if other != name or entry}
    files |= {name: entry} if entry else {}
    return replace(case, files=files, mutations=(*case.mutations, f"{name}: {what}"))


def _other_kind(draw: Draw, case: Case, name: str) -> Case:
    """A folder, a pipe, a link or nothing where a file should be."""
    kind = choice(draw, "missing", "folder", "pipe", "link", "link", "locked")
    entry = Entry(case.files[name].data, kind)
    if kind == "link":
        deep = "../" * (name.count("/") + 2)
        targets = (f"{deep}canary/kept.txt", "/dev/zero", "/etc/passwd", "nothing", name)
        entry = Entry(encode(choice(draw, *targets)), kind)
    return _with(case, name, None if kind == "missing" else entry, kind)


def _renamed(draw: Draw, case: Case, name: str) -> Case:
    """Another name or suffix for a file; the reader gets the new name."""
    path = PurePosixPath(name)
    suffixes = (".png", ".ply", ".obj", ".gltf", ".PLY", "", ".json", ".eps", ".npy")
    odd = [n for n in NAMES if 2 < len(n) < 100 and not re.search(r"[/\\\0]", n)]
    odd = [n for n in odd if n.isprintable()]
    names = [path.stem + choice(draw, *suffixes), choice(draw, *odd) + path.suffix]
    names.append("..." + path.suffix)
    new = (path.parent / choice(draw, *names)).as_posix()
    if any(part == new or part.startswith(new + "/") for part in case.files):
        return case
    files = {new if other == name else other: entry for other, entry in case.files.items()}
    main, done = new if case.main == name else case.main, f"{name}: named {new}"
    return replace(case, main=main, files=files, mutations=(*case.mutations, done))


@st.composite
def cases(draw: Draw, valid: Sequence[Case]) -> Case:
    """A valid case of a reader, preferably the first, with one to four mutations."""
    case = valid[choice(draw, *range(len(valid)))]
    others = [entry.data for made in valid for entry in made.files.values()]
    for _ in range(choice(draw, 1, 1, 1, 2, 2, 3, 4)):
        case = _changed(draw, case, others) if case.files else case
    return case
