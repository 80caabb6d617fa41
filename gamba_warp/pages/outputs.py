"""All that ``gamba reconstruct`` writes of one picture: files, a turntable, a page."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from PIL import Image
from tqdm import tqdm

from ..batch import STAGES, say
from ..conventions import Axes
from ..data.preprocess import composite
from ..formats.gaussians.files import to_be_written, write_gaussians
from ..formats.names import MeshFormat, SplatFormat, splat_suffix
from ..gaussians import Gaussians
from ..images import save_image, to_uint8
from ..model.config import GambaConfig
from ..photo.cutout import CutOut
from ..surfaces.files import write_meshes
from ..surfaces.options import BROWSER_FACES, SurfaceOptions
from ..trajectories.movies import require_movie
from ..trajectories.paths import Viewpoint, set_up
from .page import Section, index_page, reconstruction_page
from .sheet import Sheet
from .turntable import save_turntable, turntable_frames

INDEX = "index.html"  # leads to the pages of several results
_SMALL = (320, 160)  # size there of an input and its result together, pixels
_SURFACE = SurfaceOptions(colors=True, faces=BROWSER_FACES)


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
        axes: axes of the meshes, but of .glb.
        min_opacity: fainter Gaussians are left out; None: those that are never drawn.
        checkpoint: the model's file, named in the ``.ply``.
        about: labels and texts for the page, of the model.
        sheet: gets a row of each picture, or None.
        camera: elevation of the input's camera above the object, degrees (what is written stands
            upright); distance and field of view, degrees, of the camera of turntable, sheet and
            viewer, of which None is the model's.
        inputs: whether each cut-out is written, too, as ``NAME-input.png``.
        made: by name a small picture of each result that has a page.
    """

    folder: Path
    splats: tuple[SplatFormat, ...]
    mesh: tuple[MeshFormat, ...]
    turntable: str
    size: int
    frames: int
    page: bool
    axes: Axes
    min_opacity: float | None
    checkpoint: Path
    about: Sequence[tuple[str, str]] = ()
    sheet: Sheet | None = None
    camera: tuple[float, float | None, float | None] = (0.0, None, None)
    inputs: bool = False
    made: dict[str, np.ndarray] = field(default_factory=dict, init=False)

    def suffixes(self) -> list[str]:
        """What follows the name of a picture in each of its files."""
        found = [splat_suffix(kind) for kind in self.splats]
        found += [f"-mesh.{kind}" for kind in self.mesh]
        found += [f".{self.turntable}"] if self.turntable != "none" else []
        found += ["-input.png"] if self.inputs else []
        return found + ([".html"] if self.page else [])

    def require(self) -> None:
        """Refuses what needs a library that is not installed (ModuleNotFoundError)."""
        require_movie(self.turntable)
        if self.mesh:
            _SURFACE.require()

    def own(self, count: int) -> list[str]:
        """Names of files that are of no one of so many pictures."""
        return [INDEX] if self.page and count > 1 else []

    def write_index(self) -> None:
        """Writes the page that leads to the results, where there are several."""
        if len(self.made) > 1:
            title = f"{len(self.made):,} reconstructions"
            index_page(self.folder / INDEX, title, self.made)

    def view(self, config: GambaConfig) -> Viewpoint:
        """From where turntable, sheet and viewer look; that of the input, but for the options."""
        return Viewpoint(0.0, config.distance, config.fov).changed(*self.camera)


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
    base, view = outputs.folder / name, outputs.view(config)
    gaussians, count = to_be_written(gaussians, outputs.min_opacity)
    say(f"{name}: {count}")
    gaussians = set_up(gaussians, view.elevation)
    if outputs.inputs:
        save_image(base.with_name(f"{name}-input.png"), cut.editable)
    STAGES.begin("Gaussians")
    _write_gaussians(base, gaussians, outputs)
    if outputs.sheet is not None:
        outputs.sheet.add(name, cut.rgba, gaussians, view)
    section = None
    if outputs.turntable != "none" or outputs.page:
        about = [("Forward pass", f"{seconds:.2f} s on {gaussians.means.device.type}")]
        section = _write_pictures(base, cut, gaussians, outputs, view, about)
    if outputs.mesh:  # what takes longest comes last: all else is there to look at
        STAGES.begin("mesh")
        device = gaussians.means.device
        mesh = write_meshes(base, gaussians, outputs.mesh, _SURFACE, outputs.axes, device)
        if section is not None:  # the page again, with the mesh in its viewer
            section.mesh, section.files = mesh, _files(name, outputs.suffixes())
            reconstruction_page(base.with_name(f"{name}.html"), section)
    STAGES.begin("rest")


def _write_pictures(
    base: Path,
    cut: CutOut,
    gaussians: Gaussians,
    outputs: Outputs,
    view: Viewpoint,
    about: Sequence[tuple[str, str]],
) -> Section | None:
    """The turntable, and the page with it, whose content is returned."""
    name = base.name
    STAGES.begin("turntable")
    turn = turntable_frames(
        gaussians, size=outputs.size, frames=outputs.frames, **dataclasses.asdict(view)
    )
    if outputs.turntable != "none":
        STAGES.begin(f"{outputs.turntable} file")
        save_turntable(base.with_name(f"{name}.{outputs.turntable}"), turn)
    if not outputs.page:
        return None
    STAGES.begin("page")
    table = [("Gaussians", f"{gaussians.num:,}"), *about, *outputs.about]
    section = Section(
        name,
        text=cut.note,
        picture=cut.rgba,
        turntable=turn,
        gaussians=gaussians,
        table=table,
        files=_files(name, [end for end in outputs.suffixes() if not end.startswith("-mesh.")]),
        **dataclasses.asdict(view),
    )
    reconstruction_page(base.with_name(f"{name}.html"), section)
    flat = to_uint8(composite(cut.rgba, turn.shape[1]).numpy())
    small = Image.fromarray(np.hstack([flat, turn[len(turn) // 8]]))  # turned a little
    small.thumbnail(_SMALL)
    outputs.made[name] = np.asarray(small)
    return section


def _files(name: str, suffixes: Sequence[str]) -> list[str]:
    """Names of the files beside the page."""
    return [name + end for end in suffixes if end != ".html"]


def _write_gaussians(base: Path, gaussians: Gaussians, outputs: Outputs) -> None:
    comments = [f"from {base.name} by {outputs.checkpoint.name}"]
    for kind in outputs.splats:
        path = base.with_name(base.name + splat_suffix(kind))
        lost = write_gaussians(path, gaussians, kind, comments=comments)
        if lost is not None:
            tqdm.write(lost)
