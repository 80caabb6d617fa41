"""All that ``gamba reconstruct`` writes of one picture: files, a turntable, a page."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from ..formats.glb import save_glb
from ..formats.ply import Frame, save_ply
from ..formats.splat import save_splat
from ..gaussians import Gaussians
from ..surfaces.extract import SurfaceOptions
from ..surfaces.files import MeshFormat, write_meshes
from .page import Section, reconstruction_page
from .turntable import save_turntable, turntable_frames

if TYPE_CHECKING:
    from ..model.config import GambaConfig


Format = Literal["ply", "splat", "glb"]


@dataclass
class Outputs:
    """What to write for each picture.

    Attributes:
        folder: where.
        formats: Gaussian files.
        mesh: formats of a mesh of the surface.
        turntable: ``gif``, ``mp4`` or ``none``.
        size: side of the turntable's frames, pixels.
        frames: views of one turn.
        page: also a self-contained HTML page.
        ply_frame: axes of the ``.ply``.
        min_opacity: fainter Gaussians are left out of the files.
        checkpoint: named on the page.
    """

    folder: Path
    formats: tuple[Format, ...]
    mesh: tuple[MeshFormat, ...]
    turntable: str
    size: int
    frames: int
    page: bool
    ply_frame: Frame
    min_opacity: float
    checkpoint: Path


def write_outputs(
    name: str,
    rgba: np.ndarray,
    gaussians: Gaussians,
    outputs: Outputs,
    config: GambaConfig,
    seconds: float,
) -> None:
    """Writes everything that was asked for of one reconstruction, as ``NAME.*`` in the folder.

    Args:
        name: stem of the files.
        rgba: ``[S, S, 4]``, what was reconstructed.
        gaussians: ``[N]``, on the device that is to render the turntable.
        outputs: what to write.
        config: of the model, for the camera.
        seconds: how long the model took.

    Raises:
        UserError: a file cannot be written, or no Gaussian can be.
    """
    base = outputs.folder / name
    note = f"from {name} by {outputs.checkpoint.name}"
    for kind in outputs.formats:
        path = base.with_name(f"{name}.{kind}")
        if kind == "ply":
            options = {"frame": outputs.ply_frame, "comments": [note]}
            save_ply(path, gaussians, min_opacity=outputs.min_opacity, **options)
        else:
            {"splat": save_splat, "glb": save_glb}[kind](
                path, gaussians, min_opacity=outputs.min_opacity
            )
    if outputs.mesh:
        visible = gaussians.select(gaussians.opacities >= outputs.min_opacity)
        options, where = SurfaceOptions(colors=True), gaussians.means.device
        write_meshes(base, visible, outputs.mesh, options, outputs.ply_frame, where)
    if outputs.turntable == "none" and not outputs.page:
        return
    frames = turntable_frames(
        gaussians,
        size=outputs.size,
        frames=outputs.frames,
        distance=config.distance,
        fov=config.fov,
    )
    if outputs.turntable != "none":
        save_turntable(base.with_name(f"{name}.{outputs.turntable}"), frames)
    if outputs.page:
        section = Section(
            title=name,
            picture=rgba,
            turntable=frames,
            gaussians=gaussians,
            table=[
                ("Gaussians", f"{gaussians.num:,}"),
                ("Model", outputs.checkpoint.name),
                ("Forward pass", f"{seconds:.2f} s on {gaussians.means.device.type}"),
            ],
            distance=config.distance,
            fov=config.fov,
        )
        reconstruction_page(base.with_name(f"{name}.html"), section)
