"""Evaluation ``gso``: its 60 Google Scanned Objects, poses and image size.

The paper (§4.1) evaluates 60 objects of the set at 512² and does not name them. These 60 are
another choice, fixed by name: ten of each of six groups, chosen for variety by their names only,
before any of them was rendered or reconstructed here. The names are from the 1,030 models that the
set's owner GoogleResearch publishes on the Fuel server. The list never changes; with another one
(``--objects``) a report states so, with its SHA-256.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Iterable, Sequence
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal

from ..conventions import DEFAULT_FOV
from ..errors import UserError
from ..untrusted.documents import read_bytes
from ..untrusted.names import plain_name

_MAX_LIST = 1 << 20  # bytes of a list of names

SIZE = 512  # pixels, §4.1: "at a spatial resolution of 512 × 512"
FOV = DEFAULT_FOV  # degrees; not stated, so the reference camera's
# The first view is the input: §4.1 "a default camera pose with both zero elevation and azimuth".
# Number and poses of the other views are not stated.
ELEVATIONS = (0.0, 20.0, 40.0)  # degrees
AZIMUTHS = tuple(45.0 * number for number in range(8))  # degrees; at 0 the camera stands at -y
VIEWS = len(ELEVATIONS) * len(AZIMUTHS)
UP: Literal["z"] = "z"  # of the set's files


def _listed(name: str) -> frozenset[str]:
    """Return the names in a text file of this package, one a line, without its comments."""
    text = (files(__package__ or "gamba_warp.data") / name).read_text(encoding="utf-8")
    return frozenset(line for line in text.split("\n") if line and not line.startswith("#"))


NAMES = tuple(sorted(_listed("gso_evaluated.txt")))


@cache
def all_names() -> frozenset[str]:
    """Names of all models of the set, 1,033 with the few that its owner has withdrawn.

    Source: the table of names in MOVi (Kubric, ``challenges/movi/movi_e.py``), which includes all
    names of the evaluation.
    """
    return _listed("gso_names.txt")


def scanned(uids: Iterable[str]) -> list[str]:
    """Uids named as models of the set, ignoring parent folders, sorted."""
    return sorted(uid for uid in uids if uid.rpartition("/")[2] in all_names())


def names_of(path: Path | None) -> tuple[str, ...]:
    """Return the objects of the evaluation: ``NAMES``, or the names in a file, one a line.

    Raises:
        UserError: the file cannot be read, has no names, or one of them is invalid or repeated.
    """
    if path is None:
        return NAMES
    try:
        lines = read_bytes(path, _MAX_LIST).decode().split("\n")
    except UnicodeDecodeError as error:
        raise UserError(f"{path}: not UTF-8 text") from error
    names = [plain_name(line.strip(), str(path)) for line in lines if line.strip()]
    if not names:
        raise UserError(f"{path}: contains no names")
    if twice := [name for name, count in Counter(names).items() if count > 1]:
        raise UserError(f"{path}: {twice[0]} occurs twice")
    return tuple(sorted(names))


def protocol_of(there: Iterable[str], names: Sequence[str] = NAMES) -> dict[str, Any]:
    """Description of this evaluation for a report.

    Args:
        there: names of the evaluated objects.
        names: names of all its objects.

    Returns:
        The size, the poses, the missing objects of the list, and the evaluated ones outside it.
    """
    evaluated = set(there)
    return {
        "name": "gso",
        "size": SIZE,
        "input": "view 0: elevation 0, azimuth 0 (the camera at -y, z up)",
        "views": f"{VIEWS}: azimuths 0, 45, ... 315 at elevations 0, 20 and 40 degrees",
        "list": "the 60 of the protocol" if names == NAMES else "given by --objects",
        "list_sha256": hashlib.sha256("\n".join(names).encode()).hexdigest(),
        "objects": len(names),
        "evaluated": len(evaluated & set(names)),
        "missing": [name for name in names if name not in evaluated],
        "others": sorted(evaluated - set(names)),
    }
