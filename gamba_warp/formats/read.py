"""Files and folders of shapes that a command is given."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ..batch import warn
from ..errors import UserError
from ..files import warn_of_others
from ..gaussians import Gaussians
from .gaussians.files import read_gaussians, splat_kind
from .names import SPLAT_SUFFIXES


def find_gaussians(inputs: Sequence[Path]) -> tuple[list[Path], list[tuple[Path, str]]]:
    """Resolve files and folders to files of Gaussians, each once; files of a folder are sorted.

    In folders a .glb with a mesh is skipped, because commands write them next to the Gaussians. So
    are names that begin with a dot: hidden files, and unfinished ones of killed commands.

    Returns:
        The files, and the inputs that are missing or hold none, with the reason.

    Raises:
        UserError: without inputs.
    """
    files: dict[Path, None] = {}
    failures = []
    if not inputs:
        raise UserError("give at least one file of Gaussians (.ply, .splat, .spz, .glb) or folder")
    for path in inputs:
        if not path.is_dir():
            if path.exists():
                files[path] = None
            else:
                failures.append((path, "no such file"))
            continue
        inside = sorted(p for p in path.glob("[!.]*") if p.is_file())
        warn_of_others(path, inside, (*SPLAT_SUFFIXES, ".html", ".gif", ".mp4"))
        inside = [p for p in inside if p.suffix.lower() in SPLAT_SUFFIXES]
        inside = [p for p in inside if p.suffix.lower() != ".glb" or holds_gaussians(p)]
        files.update(dict.fromkeys(inside))
        if not inside:
            failures.append((path, "the folder holds no .ply, .splat, .spz or .glb files"))
    return list(files), failures


def holds_gaussians(path: Path) -> bool:
    """Return True if a .glb holds Gaussians or is unreadable, False for a mesh."""
    try:
        return splat_kind(path) is not None
    except UserError:  # reading it gives this error
        return True


def read_with_warning(path: Path, drop_bad: bool) -> Gaussians:
    """Read a file of Gaussians for a command; print the number of dropped ones on stderr.

    Args:
        path: the file.
        drop_bad: leave out invalid Gaussians; else the file is refused.

    Raises:
        UserError: as ``read_gaussians``.
    """
    left_out: list[str] = []
    gaussians = read_gaussians(path, left_out if drop_bad else None)
    warn(path, left_out)
    return gaussians
