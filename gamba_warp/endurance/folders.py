"""What is in a folder of results: whole files, and what is left over of killed commands."""

from __future__ import annotations

import json
import os
from pathlib import Path

from ..files import PART

_KEPT = (".lock", ".gamba-library.json")  # of a run; of a library that was unpacked
_TWO_DAYS = 2 * 24 * 3600


def contents(folder: Path) -> dict[str, bytes]:
    """The files of a folder by their path in it; what is left over is not among them."""
    found = sorted(path for path in folder.rglob("*") if path.is_file())
    named = ((path.relative_to(folder), path) for path in found)
    return {
        relative.as_posix(): path.read_bytes()
        for relative, path in named
        if not any(part.startswith(".") for part in relative.parts)
    }


def leftovers(folder: Path) -> list[Path]:
    """What killed commands left behind: all names with a dot, but for ``_KEPT``."""
    found = (path for path in folder.rglob(".*") if path.name not in _KEPT)
    return [path for path in found if not any(p.startswith(PART) for p in path.parent.parts)]


def age(folder: Path) -> None:
    """Makes the leftovers look two days old, so that the next command may sweep them."""
    for top in leftovers(folder):
        for path in (*top.rglob("*"), top):
            when = path.lstat().st_mtime - _TWO_DAYS
            os.utime(path, (when, when), follow_symlinks=False)


def lost(before: dict[str, bytes], after: dict[str, bytes]) -> list[str]:
    """Names of files that were there and are not, or are neither what they were nor whole."""
    return [
        name
        for name in sorted(before.keys() | after.keys())
        if name not in after
        or (after[name] != before.get(name) and not is_whole(name, after[name]))
    ]


def is_whole(name: str, data: bytes) -> bool:
    """Whether a new file is one that a command finished, by the marks of its kind."""
    suffix = Path(name).suffix
    if suffix in (".json", ".jsonl"):
        try:
            for text in data.decode().splitlines() if suffix == ".jsonl" else [data.decode()]:
                json.loads(text)
        except ValueError:
            return False
        return data.endswith(b"\n")
    if suffix == ".html":
        return data.endswith(b"</html>\n")
    if suffix in (".png", ".gif", ".webp"):
        return _is_picture(data)
    if suffix == ".glb":
        return data[:4] == b"glTF" and int.from_bytes(data[8:12], "little") == len(data)
    if suffix == ".safetensors":
        return _safetensors_size(data) == len(data)
    if suffix == ".ply":
        return b"end_header\n" in data and _ply_size(data) == len(data)
    return data.endswith(b"\n") if suffix in (".md", ".csv") else bool(data)


def _is_picture(data: bytes) -> bool:
    import io

    from PIL import Image

    ends = {b"\x89PNG": b"IEND\xaeB`\x82", b"GIF8": b";"}
    if not data.endswith(ends.get(data[:4], b"")):
        return False
    try:
        with Image.open(io.BytesIO(data)) as picture:
            for index in range(getattr(picture, "n_frames", 1)):
                picture.seek(index)
                picture.load()
    except (OSError, ValueError, SyntaxError):
        return False
    return True


def _safetensors_size(data: bytes) -> int:
    """The size that a safetensors header promises, bytes; -1 where the header is not whole."""
    start = 8 + int.from_bytes(data[:8], "little")
    try:
        entries = json.loads(data[8:start])
    except ValueError:
        return -1
    ends = (entry["data_offsets"][1] for name, entry in entries.items() if name != "__metadata__")
    return start + max(ends, default=0)


def _ply_size(data: bytes) -> int:
    """The size that the header of one of our binary .ply files promises, bytes."""
    end = data.index(b"end_header\n") + len(b"end_header\n")
    total, count, width = end, 0, 0
    sizes = {"float": 4, "int": 4, "uint": 4, "uchar": 1, "double": 8}
    for line in data[:end].decode("ascii", "replace").splitlines():
        words = line.split()
        if words[:1] == ["element"]:
            total, count, width = total + count * width, int(words[2]), 0
        elif words[:2] == ["property", "list"]:
            width += 1 + 3 * 4  # triangles
        elif words[:1] == ["property"]:
            width += sizes[words[1]]
    return total + count * width
