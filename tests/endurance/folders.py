"""Contents of a folder of results: complete files, and leftovers of killed commands."""

import io
import json
import os
from pathlib import Path

from PIL import Image
from plyfile import PlyData
from safetensors.torch import load

from gamba_warp.files import PART

_ALLOWED = (".lock", ".gamba-library.json")  # of a run; of a library that was unpacked
_TWO_DAYS = 2 * 24 * 3600
_ENDS = {".png": b"IEND\xaeB`\x82", ".gif": b";", ".html": b"</html>\n"}
_ENDS |= dict.fromkeys((".json", ".jsonl", ".md", ".csv"), b"\n")


def contents(folder: Path) -> dict[str, bytes]:
    """Files of a folder by their path in it, without leftovers and TensorBoard's, named by time."""
    files = (path.relative_to(folder) for path in sorted(folder.rglob("*")) if path.is_file())
    kept = (path for path in files if "tfevents" not in path.name)
    kept = (path for path in kept if not any(part.startswith(".") for part in path.parts))
    return {path.as_posix(): (folder / path).read_bytes() for path in kept}


def leftovers(folder: Path) -> list[Path]:
    """Leftovers of killed commands: all names with a dot, except ``_ALLOWED``."""
    found = (path for path in folder.rglob(".*") if path.name not in _ALLOWED)
    return [path for path in found if not any(p.startswith(PART) for p in path.parent.parts)]


def age(folder: Path) -> None:
    """Make the leftovers look two days old, so that the next command may sweep them."""
    for top in leftovers(folder):
        for path in (*top.rglob("*"), top):
            when = path.lstat().st_mtime - _TWO_DAYS
            os.utime(path, (when, when), follow_symlinks=False)


def lost(before: dict[str, bytes], after: dict[str, bytes]) -> list[str]:
    """Names of files that have disappeared, or are neither unchanged nor complete."""
    changed = {name for name in after if after[name] != before.get(name)}
    broken = {name for name in changed if not is_whole(name, after[name])}
    return sorted(broken | (before.keys() - after.keys()))


def is_whole(name: str, data: bytes) -> bool:
    """True if a new file is complete, according to readers of other packages."""
    suffix = Path(name).suffix
    try:
        if suffix in (".png", ".gif", ".webp"):
            with Image.open(io.BytesIO(data)) as image:
                for index in range(getattr(image, "n_frames", 1)):
                    image.seek(index)
                    image.load()
        elif suffix in (".json", ".jsonl"):
            for text in data.splitlines() if suffix == ".jsonl" else [data]:
                json.loads(text)
        elif suffix == ".safetensors":
            load(data)
        elif suffix == ".ply":
            PlyData.read(io.BytesIO(data))
        elif suffix == ".glb":
            return data[:4] == b"glTF" and int.from_bytes(data[8:12], "little") == len(data)
    except Exception:  # each library has its own
        return False
    return bool(data) and data.endswith(_ENDS.get(suffix, b""))
