"""Gaussians in any format: read by the file's content, written by the format's name."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Literal

from ...batch import STAGES
from ...errors import UserError
from ...files import atomic_path
from ...gaussians import Gaussians
from ..headers import open_shape
from ..names import SPLAT_FORMATS, SPLAT_SUFFIXES, SplatFormat
from ..ply import TURNED, header_bytes, load_ply, marked, save_ply
from ..ply_data import MAX_SPLATS, read_ply_header
from .arrays import export_arrays
from .compressed import packed
from .glb import holds_gaussians, load_glb
from .splat import load_splat, save_splat
from .spz import load_spz, save_spz
from .spz_container import GZIP, MAGIC

_CONVERTED = (".sog", ".ksplat", ".rad")  # Gaussians in formats of single programs


def splat_kind(path: str | Path) -> SplatFormat | Literal["glb"] | None:
    """Return the format of a file of Gaussians by its content; None for other files.

    A damaged file has the format that it seems to be in; ``.splat`` goes by its name, because it
    has no header.

    Raises:
        UserError: the file is missing, empty or cannot be read, or is a ``.ply`` with a malformed
            header.
    """
    path = Path(path)
    with open_shape(path, MAX_SPLATS) as (file, size):
        start = file.read(4)
        file.seek(0)
        if start.startswith(b"ply"):
            header = read_ply_header(path, file)
            if not header.has_gaussians:
                return None
            return "compressed-ply" if header.is_packed else "ply"
        if start == b"glTF":
            return "glb" if holds_gaussians(path, file, size) else None
    if start.startswith(GZIP) or start == MAGIC:
        return "spz"
    return {".splat": "splat", ".spz": "spz"}.get(path.suffix.lower())  # type: ignore[return-value]


def read_gaussians(path: str | Path, left_out: list[str] | None = None) -> Gaussians:
    """Read one object's Gaussians by the file's content, and then by its name.

    The formats are ``.ply`` (binary, text or compressed), ``.splat``, ``.spz`` and ``.glb`` with
    ``KHR_gaussian_splatting``, from this or another program.

    Args:
        path: the file.
        left_out: receives a line that counts the Gaussians left out because they cannot be drawn
            (a row of NaN, a rotation of length zero); None: a file with such Gaussians is refused.

    Returns:
        Float32 Gaussians on the CPU in OpenCV's axes (y down), ``quats`` normalised; colours may
        lie outside of [0, 1].

    Raises:
        UserError: the file is missing, of another kind, truncated or longer than it states, or its
            values are invalid.
    """
    path = Path(path)
    with open_shape(path, MAX_SPLATS) as (file, _):
        start = file.read(4)
    magics = {b"ply": load_ply, b"glTF": load_glb, GZIP: load_spz, MAGIC: load_spz}
    by_name = {".ply": load_ply, ".splat": load_splat, ".spz": load_spz, ".glb": load_glb}
    readers = [reader for magic, reader in magics.items() if start.startswith(magic)]
    reader = readers[0] if readers else by_name.get(path.suffix.lower())  # which names the error
    if path.suffix.lower() in _CONVERTED:
        tool = "SuperSplat (superspl.at/editor) and splat-transform convert it to .ply"
        raise UserError(f"{path}: the format {path.suffix.lower()} is not supported; {tool}")
    if reader is None:
        raise UserError(f"{path}: not Gaussians ({', '.join(SPLAT_SUFFIXES)})")
    return reader(path, left_out)


def comments_of(path: str | Path) -> list[str]:
    """Return the comments of a ``.ply``, such as its origin; empty for other formats.

    At most 32 lines of 200 characters, so that a file with all of them can be read again.

    Raises:
        UserError: as for ``splat_kind``.
    """
    path = Path(path)
    with open_shape(path, MAX_SPLATS) as (file, _):
        if file.read(3) != b"ply":
            return []
        file.seek(0)
        found = read_ply_header(path, file).comments
    return [line[:200] for line in found if line != TURNED][:32]


def to_be_written(gaussians: Gaussians, least: float | None = None) -> tuple[Gaussians, str]:
    """Select the Gaussians of one object that a command writes, without those that are never drawn.

    Args:
        gaussians: one object, no batch dimension.
        least: as for ``Gaussians.drawn``.

    Returns:
        The Gaussians, and a sentence with their number and, if they could be seen or with
        --verbose, the number left out.

    Raises:
        UserError: none is left.
    """
    kept = gaussians.drawn(least)
    limit = "1/255" if least is None else f"{least:g}"
    if kept.num == 0:
        raise UserError(f"no Gaussian has an opacity of {limit} or more")
    lost = gaussians.num - kept.num
    why = f"opacity under {limit}" + (", never drawn" if least is None else "")
    said = f", {lost:,} left out ({why})" if lost and (least or STAGES.verbose) else ""
    return kept, f"{kept.num:,} Gaussians{said}."


def write_gaussians(
    path: str | Path, gaussians: Gaussians, kind: SplatFormat, *, comments: Iterable[str] = ()
) -> str | None:
    """Write one object's Gaussians, atomically, in the axes of the format.

    Args:
        path: file to write.
        gaussians: one object, no batch dimension, OpenCV's axes.
        kind: the format.
        comments: lines for the header of a ``.ply``, compressed or not.

    Returns:
        A sentence about losses beyond the format's precision, or None.

    Raises:
        UserError: a value is not finite, there is no Gaussian, or the file cannot be written.
        ValueError: there is a batch dimension, or the format is unknown.
    """
    if kind not in SPLAT_FORMATS:
        raise ValueError(f"the format is {kind!r}, expected one of {', '.join(SPLAT_FORMATS)}")
    if kind == "ply":
        return save_ply(path, gaussians, comments=comments)
    if kind == "compressed-ply":
        lines, body, clipped = packed(export_arrays(path, gaussians))
        with atomic_path(path) as temporary:
            temporary.write_bytes(header_bytes(marked(gaussians, comments), lines) + body)
        return f"{path}: the format clips harmonics to ±4." if clipped else None
    return (save_splat if kind == "splat" else save_spz)(path, gaussians)
