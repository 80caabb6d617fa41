"""``gamba reconstruct``: pictures to 3D Gaussians, files, turntables and pages."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import torch
import tyro

from ..batch import for_each, report
from ..data.preprocess import SamSegmenter, prepare
from ..errors import UserError
from ..files import output_folder
from ..formats.ply import Frame
from ..surfaces.files import MeshFormat

if TYPE_CHECKING:
    from ..model.gamba import Gamba
from ..batch import unique_names
from ..devices import pick_device
from ..images import find_pictures
from ..model.checkpoint import DEFAULT_CHECKPOINT
from ..model.predict import reconstruct
from ..pages.outputs import Format, Outputs, write_outputs


def reconstruct_command(
    images: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="IMAGE...")],
    /,
    checkpoint: Path | None = None,
    encoder_weights: Path | None = None,
    out: Path = Path("out"),
    formats: tuple[Format, ...] = ("ply",),
    mesh: tuple[MeshFormat, ...] = (),
    turntable: Literal["gif", "mp4", "none"] = "gif",
    size: int = 256,
    frames: int = 48,
    page: bool = True,
    mask: Path | None = None,
    sam: Path | None = None,
    ply_frame: Frame = "opencv",
    min_opacity: float = 0.0,
    device: Literal["auto", "cpu", "cuda"] = "auto",
) -> int:
    """Turns pictures of single objects into 3D Gaussians, one forward pass each.

    Args:
        images: Picture files, or folders of them.
        checkpoint: Trained model (.safetensors); the starter model if not given.
        encoder_weights: The image encoder's weights, where the model has a pretrained one.
        out: Folder for the results.
        formats: Files of Gaussians to write.
        mesh: Also files of a coloured mesh (gamba export has its options).
        turntable: Moving picture of one turn.
        size: Side of the turntable's frames in pixels.
        frames: Number of views in the turntable.
        page: Write an HTML page with the input, the turntable and a 3D viewer.
        mask: Picture that is white where the object is (for a single image).
        sam: Segment Anything checkpoint, for pictures with a busy background.
        ply_frame: Axes of the .ply; opencv (y down) is what viewers assume.
        min_opacity: Leave out Gaussians fainter than this.
        device: Where to compute.
    """
    if size < 16 or frames < 2:
        raise UserError("--size must be at least 16 and --frames at least 2")
    if not images:
        raise UserError("give at least one picture or folder")
    pictures, failures = find_pictures(images)
    if mask is not None and len(pictures) != 1:
        raise UserError(f"--mask goes with one picture, {len(pictures)} are given")
    if not pictures:
        raise UserError("; ".join(f"{path}: {reason}" for path, reason in failures))
    where = pick_device(device)
    checkpoint = checkpoint or DEFAULT_CHECKPOINT
    model = _load(checkpoint, encoder_weights, where)
    segmenter = None if sam is None else SamSegmenter(sam, where)
    outputs = Outputs(
        folder=output_folder(out),
        formats=formats,
        mesh=mesh,
        turntable=turntable,
        size=size,
        frames=frames,
        page=page,
        ply_frame=ply_frame,
        min_opacity=min_opacity,
        checkpoint=checkpoint,
    )

    def one(name: str, path: Path) -> None:
        rgba = prepare(path, mask=mask, segmenter=segmenter)
        started = time.perf_counter()
        gaussians = reconstruct(model, rgba).to("cpu")  # waits for the device
        seconds = time.perf_counter() - started
        write_outputs(name, rgba, gaussians.to(where), outputs, model.config, seconds)

    failures += for_each(unique_names(pictures), one, "reconstruct", "picture")
    return report(len(pictures), "picture", failures, out)


def _load(checkpoint: Path, encoder_weights: Path | None, device: torch.device) -> Gamba:
    from ..model.checkpoint import load_model

    if not checkpoint.exists():
        raise UserError(
            f"{checkpoint}: no such checkpoint; train one with 'gamba train' or 'gamba demo', "
            "or give --checkpoint FILE"
        )
    return load_model(checkpoint, device, encoder_weights)
