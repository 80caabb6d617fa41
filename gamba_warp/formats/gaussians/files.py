"""Gaussians in any format: read by what the file holds, written by the format's name."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from ...errors import UserError
from ...files import atomic_path
from ...gaussians import Gaussians
from ..headers import open_shape
from ..names import SPLAT_FORMATS, SPLAT_SUFFIXES, SplatFormat
from ..ply import MAX_FILE, TURNED, ended_header, header_lines, load_ply, save_ply
from ..ply_header import read_ply_header
from .arrays import export_arrays
from .compressed import WORDS, is_compressed, packed
from .glb import save_glb
from .glb_reader import holds_gaussians, load_glb
from .splat import load_splat, save_splat
from .spz import load_spz, save_spz
from .spz_container import GZIP, MAGIC

# One is enough, so that a file that lacks the others is not taken for a point cloud.
_OF_GAUSSIANS = {"opacity", "scale_0", "rot_0", "f_dc_0", *WORDS}


def splat_kind(path: str | Path) -> SplatFormat | None:
    """Which format of Gaussians a file is in, by its content; None for a mesh, a cloud or another.

    Of a file that is damaged, the kind that it seems to be; ``.splat`` goes by its name, because it
    has no header.

    Raises:
        UserError: the file is missing, empty or cannot be read, or is a ``.ply`` with a header that
            is not understood.
    """
    path = Path(path)
    with open_shape(path, MAX_FILE) as (file, size):
        start = file.read(4)
        file.seek(0)
        if start.startswith(b"ply"):
            header = read_ply_header(path, file)
            if any(element.name == "face" and element.count for element in header.elements):
                return None
            names = {item.name for element in header.elements for item in element.properties}
            if not _OF_GAUSSIANS & names:
                return None
            return "compressed-ply" if is_compressed(header) else "ply"
        if start == b"glTF":
            return "glb" if holds_gaussians(path, file, size) else None
    if start.startswith(GZIP) or start == MAGIC:
        return "spz"
    return {".splat": "splat", ".spz": "spz"}.get(path.suffix.lower())  # type: ignore[return-value]


def read_gaussians(path: str | Path, left_out: list[str] | None = None) -> Gaussians:
    """Reads one object's Gaussians by what the file holds, and then by its name.

    ``.ply`` (binary, text or compressed), ``.splat``, ``.spz`` and ``.glb`` with
    ``KHR_gaussian_splatting`` are read, from this or another program.

    Args:
        path: the file.
        left_out: gets a line of how many Gaussians are left out because they cannot be drawn (a row
            of NaN, a rotation of length zero); None: a file that has one is refused.

    Returns:
        Float32 Gaussians on the CPU in OpenCV's axes (y down), ``quats`` normalised; without
        harmonics colours are in [0, 1].

    Raises:
        UserError: missing, of another kind, truncated, longer than it says, or values that are not
            those of Gaussians.
    """
    path = Path(path)
    with open_shape(path, MAX_FILE) as (file, _):
        start = file.read(4)
    magics = {b"ply": load_ply, b"glTF": load_glb, GZIP: load_spz, MAGIC: load_spz}
    by_name = {".ply": load_ply, ".splat": load_splat, ".spz": load_spz, ".glb": load_glb}
    readers = [reader for magic, reader in magics.items() if start.startswith(magic)]
    reader = readers[0] if readers else by_name.get(path.suffix.lower())  # says what is wrong
    if reader is None:
        raise UserError(f"{path}: not Gaussians ({', '.join(SPLAT_SUFFIXES)})")
    return reader(path, left_out)


def comments_of(path: str | Path) -> list[str]:
    """What the comments of a ``.ply`` say, such as from what it was made; none in other formats.

    At most 32 lines of 200 characters, so that a file with all of them is read again.

    Raises:
        UserError: as for ``splat_kind``.
    """
    path = Path(path)
    with open_shape(path, MAX_FILE) as (file, _):
        if file.read(3) != b"ply":
            return []
        file.seek(0)
        found = read_ply_header(path, file).comments
    return [line[:200] for line in found if line != TURNED][:32]


def to_be_written(gaussians: Gaussians, least: float | None = None) -> tuple[Gaussians, str]:
    """What a command writes of one object: what is never drawn is left out, and counted.

    Args:
        gaussians: one object, no batch dimension.
        least: as for ``Gaussians.drawn``.

    Returns:
        The Gaussians, and a sentence that says how many those are, and how many are left out.

    Raises:
        UserError: none is left.
    """
    kept = gaussians.drawn(least)
    limit = "1/255" if least is None else f"{least:g}"
    if kept.num == 0:
        raise UserError(f"no Gaussian has an opacity of {limit} or more")
    lost = gaussians.num - kept.num
    why = f"opacity under {limit}" + (", never drawn" if least is None else "")
    return kept, f"{kept.num:,} Gaussians" + (f", {lost:,} left out ({why})." if lost else ".")


def write_gaussians(
    path: str | Path,
    gaussians: Gaussians,
    kind: SplatFormat,
    *,
    comments: Iterable[str] = (),
) -> str | None:
    """Writes one object's Gaussians, atomically, in OpenCV's axes or those that the format has.

    Args:
        path: file to write.
        gaussians: one object, no batch dimension, OpenCV's axes.
        kind: the format.
        comments: lines for the header of a ``.ply``, compressed or not.

    Returns:
        A sentence about what the format cannot hold, or None.

    Raises:
        UserError: a value is not finite, there is no Gaussian, or the file cannot be written.
        ValueError: there is a batch dimension, or the format is not known.
    """
    if kind not in SPLAT_FORMATS:
        raise ValueError(f"the format is {kind!r}, expected one of {', '.join(SPLAT_FORMATS)}")
    if kind == "ply":
        save_ply(path, gaussians, comments=comments)
        return None
    if kind == "compressed-ply":
        lines, body, clipped = packed(export_arrays(path, gaussians))
        with atomic_path(path) as temporary:
            temporary.write_bytes(ended_header([*header_lines(comments), *lines]) + body)
        return f"{path}: the format clips harmonics to ±4." if clipped else None
    if kind == "glb":
        save_glb(path, gaussians)
        return None
    return {"splat": save_splat, "spz": save_spz}[kind](path, gaussians)
