"""All that ``gamba reconstruct`` writes of one picture: files, a turntable, a page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
from PIL import Image
from tqdm import tqdm

from ..batch import say
from ..data.preprocess import composite
from ..formats.gaussians.files import to_be_written
from ..gaussians import Gaussians
from ..images import save_image, to_uint8
from ..model.config import GambaConfig
from ..photo.cutout import CutOut
from ..surfaces.options import BROWSER_FACES, SurfaceOptions
from ..trajectories.paths import Viewpoint, set_up
from .export import ObjectFiles
from .page import Section, index_page
from .sheet import Sheet

INDEX = "index.html"  # leads to the pages of several results
_SMALL = (320, 160)  # size there of an input and its result together, pixels
_SURFACE = SurfaceOptions(colors=True, faces=BROWSER_FACES)


@dataclass(kw_only=True)
class Outputs(ObjectFiles):
    """What to write for each picture.

    Attributes:
        checkpoint: the model's file, named in the ``.ply``.
        about: labels and texts for the page, of the model.
        sheet: gets a row of each picture, or None.
        camera: elevation of the input's camera above the object, degrees (what is written stands
            upright); distance and field of view, degrees, of the camera of turntable, sheet and
            viewer, of which None is the model's.
        inputs: whether each cut-out is written, too, as ``NAME-input.png``.
        made: by name a small picture of each result that has a page.
    """

    surface: SurfaceOptions = _SURFACE
    checkpoint: Path
    about: Sequence[tuple[str, str]] = ()
    sheet: Sheet | None = None
    camera: tuple[float, float | None, float | None] = (0.0, None, None)
    inputs: bool = False
    made: dict[str, np.ndarray] = field(default_factory=dict, init=False)

    def suffixes(self, meshes: bool = True) -> list[str]:
        """What follows the name of a picture in each of its files."""
        return super().suffixes(meshes) + (["-input.png"] if self.inputs else [])

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
    view = outputs.view(config)
    gaussians, count = to_be_written(gaussians, outputs.min_opacity)
    say(f"{name}: {count}")
    gaussians = set_up(gaussians, view.elevation)
    if outputs.inputs:
        save_image(outputs.folder / f"{name}-input.png", cut.editable)
    device = gaussians.means.device
    took = ("Forward pass", f"{seconds:.2f} s on {device.type}")
    table = [("Gaussians", f"{gaussians.num:,}"), took, *outputs.about]
    section = Section(name, cut.note, cut.rgba, table=table, **asdict(view))
    comments = [f"from {name} by {outputs.checkpoint.name}"]
    lost, turn = outputs.write(gaussians, None, view, section, device, comments)
    for line in lost:
        tqdm.write(line)
    if outputs.sheet is not None:
        outputs.sheet.add(name, cut.rgba, gaussians, view)
    if outputs.page and turn is not None:
        flat = to_uint8(composite(cut.rgba, turn.shape[1]).numpy())
        small = Image.fromarray(np.hstack([flat, turn[len(turn) // 8]]))  # turned a little
        small.thumbnail(_SMALL)
        outputs.made[name] = np.asarray(small)
