"""All that ``gamba reconstruct`` writes of one picture: files, a turntable, a page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ..conventions import Axes
from ..formats.gaussians.files import write_gaussians
from ..formats.names import MeshFormat, SplatFormat, splat_suffix
from ..gaussians import Gaussians
from ..images import save_image
from ..model.config import GambaConfig
from ..photo.cutout import CutOut
from ..surfaces.files import write_meshes
from ..surfaces.options import BROWSER_FACES, SurfaceOptions
from .page import Section, reconstruction_page
from .sheet import Sheet
from .turntable import save_turntable, turntable_frames


@dataclass
class Outputs:
    """What to write for each picture.

    Attributes:
        folder: folder of the results.
        splats: formats of the Gaussians.
        mesh: formats of a mesh of the surface.
        turntable: ``gif``, ``mp4`` or ``none``.
        size: side of the turntable's frames, pixels.
        frames: views of one turn.
        page: whether a self-contained HTML page is written, too.
        axes: axes of the ``.ply`` and of meshes.
        min_opacity: fainter Gaussians are left out of the files.
        checkpoint: the model's file, named in the ``.ply``.
        about: labels and texts for the page, of the model.
        sheet: gets a row of each picture, or None.
        inputs: whether each cut-out is written, too, as ``NAME-input.png``.
    """

    folder: Path
    splats: tuple[SplatFormat, ...]
    mesh: tuple[MeshFormat, ...]
    turntable: str
    size: int
    frames: int
    page: bool
    axes: Axes
    min_opacity: float
    checkpoint: Path
    about: Sequence[tuple[str, str]] = ()
    sheet: Sheet | None = None
    inputs: bool = False

    def suffixes(self) -> list[str]:
        """What follows the name of a picture in each of its files."""
        found = [splat_suffix(kind) for kind in self.splats]
        found += [f"-mesh.{kind}" for kind in self.mesh]
        found += [f".{self.turntable}"] if self.turntable != "none" else []
        found += ["-input.png"] if self.inputs else []
        return found + ([".html"] if self.page else [])


def write_outputs(
    name: str,
    cut: CutOut,
    gaussians: Gaussians,
    outputs: Outputs,
    config: GambaConfig,
    seconds: float,
) -> None:
    """Writes everything that was asked for of one reconstruction, as ``NAME.*`` in the folder.

    Args:
        name: stem of the files.
        cut: what was reconstructed, and how it was cut out.
        gaussians: ``[N]``, on the device that is to render the turntable.
        outputs: what to write.
        config: of the model, for the camera.
        seconds: how long the model took.

    Raises:
        UserError: a file cannot be written, or no Gaussian can be.
    """
    base = outputs.folder / name
    if outputs.inputs:
        save_image(base.with_name(f"{name}-input.png"), cut.editable)
    _write_gaussians(base, gaussians, outputs)
    if outputs.mesh:
        visible = gaussians.select(gaussians.opacities >= outputs.min_opacity)
        options, device = SurfaceOptions(colors=True, faces=BROWSER_FACES), gaussians.means.device
        write_meshes(base, visible, outputs.mesh, options, outputs.axes, device)
    if outputs.sheet is not None:
        outputs.sheet.add(name, cut.rgba, gaussians, config)
    if outputs.turntable == "none" and not outputs.page:
        return
    distance, fov = config.distance, config.fov
    turn = turntable_frames(
        gaussians, size=outputs.size, frames=outputs.frames, distance=distance, fov=fov
    )
    if outputs.turntable != "none":
        save_turntable(base.with_name(f"{name}.{outputs.turntable}"), turn)
    if outputs.page:
        table = [
            ("Gaussians", f"{gaussians.num:,}"),
            ("Forward pass", f"{seconds:.2f} s on {gaussians.means.device.type}"),
            *outputs.about,
        ]
        section = Section(
            name,
            text=cut.note,
            picture=cut.rgba,
            turntable=turn,
            gaussians=gaussians,
            table=table,
            distance=distance,
            fov=fov,
        )
        reconstruction_page(base.with_name(f"{name}.html"), section)


def _write_gaussians(base: Path, gaussians: Gaussians, outputs: Outputs) -> None:
    comments = [f"from {base.name} by {outputs.checkpoint.name}"]
    for kind in outputs.splats:
        path, least = base.with_name(base.name + splat_suffix(kind)), outputs.min_opacity
        write_gaussians(
            path, gaussians, kind, axes=outputs.axes, min_opacity=least, comments=comments
        )
