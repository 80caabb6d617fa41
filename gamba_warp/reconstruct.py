"""``gamba reconstruct``: pictures to 3D Gaussians, files, turntables and pages."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
import torch
import tyro

from .batch import for_each, report
from .cameras import reference_cameras
from .errors import UserError
from .files import output_folder
from .gaussians import Gaussians
from .gltf import save_glb
from .mesh_files import MeshFormat, write_meshes
from .page import Section, reconstruction_page
from .ply import Frame, save_ply
from .preprocess import SamSegmenter, composite, prepare
from .splat import save_splat
from .surfaces import SurfaceOptions
from .turntable import save_turntable, turntable_frames

if TYPE_CHECKING:
    from .config import GambaConfig
    from .model import Gamba

DEFAULT_CHECKPOINT = Path(__file__).resolve().parent.parent / "starter" / "tiny.safetensors"
PICTURE_SUFFIXES = {".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tif", ".tiff", ".gif"}

Format = Literal["ply", "splat", "glb"]


@torch.inference_mode()
def reconstruct(model: Gamba, rgba: np.ndarray) -> Gaussians:
    """One forward pass on one picture, seen by the reference camera.

    Args:
        model: on any device, in evaluation mode.
        rgba: ``[S, S, 4]`` in [0, 1], object centred, as ``preprocess.prepare`` returns.

    Returns:
        Gaussians ``[N]`` on the model's device, in the reference camera's frame.
    """
    config = model.config
    size = config.image_size
    device = next(model.parameters()).device
    images = composite(rgba, size, config.background_color)[None].to(device)
    cameras = reference_cameras(1, size, config.fov, config.distance)
    return model(images, cameras.to(device))[0]


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


def find_pictures(images: Sequence[Path]) -> tuple[list[Path], list[tuple[Path, str]]]:
    """Resolves files and folders to picture files.

    Args:
        images: files are taken as they are; of a folder, the files in it that have a picture's
            suffix, sorted, without sub-folders.

    Returns:
        The files, each once, and the folders that hold none with the reason.
    """
    pictures: dict[Path, None] = {}
    failures = []
    for path in images:
        if not path.is_dir():
            pictures[path] = None
            continue
        try:
            inside = sorted(p for p in path.iterdir() if p.suffix.lower() in PICTURE_SUFFIXES)
        except OSError as error:
            failures.append((path, error.strerror))
            continue
        pictures.update(dict.fromkeys(inside))
        if not inside:
            failures.append((path, "the folder holds no pictures"))
    return list(pictures), failures


def unique_names(paths: Sequence[Path]) -> dict[str, Path]:
    """A distinct output name for each path: its stem, with a number where stems meet."""
    names: dict[str, Path] = {}
    for path in paths:
        name, number = path.stem, 1
        while name in names:
            number += 1
            name = f"{path.stem}-{number}"
        names[name] = path
    return names


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


def pick_device(name: str) -> torch.device:
    """``auto`` is CUDA where there is a device, else the CPU.

    Raises:
        UserError: CUDA is asked for and is not there.
    """
    if name == "cuda" and not torch.cuda.is_available():
        raise UserError("--device cuda: no CUDA device is available")
    return torch.device("cuda" if name != "cpu" and torch.cuda.is_available() else "cpu")


def _load(checkpoint: Path, encoder_weights: Path | None, device: torch.device) -> Gamba:
    from .model import load_model

    if not checkpoint.exists():
        raise UserError(
            f"{checkpoint}: no such checkpoint; train one with 'gamba train' or 'gamba demo', "
            "or give --checkpoint FILE"
        )
    return load_model(checkpoint, device, encoder_weights)
