"""``gamba reconstruct``: images to 3D Gaussians, files, turntables and pages."""

from __future__ import annotations

import atexit
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from ..batch import STAGES, check_not_read, counted, for_each, plan_outputs, say, warn
from ..conventions import Cutout, Detail, DeviceChoice, Precision
from ..devices import pick_device
from ..errors import UserError
from ..files import STARTER, output_folder
from ..pages.options import RECONSTRUCTED, FileOptions
from ..untrusted.ranges import Distance, Elevation, Fov, ranged
from .results import Results, reported

MAX_STDIN = 1 << 28  # bytes of an image from the standard input
_PIPED = "gamba-stdin-"  # start of the name of its folder


@dataclass(frozen=True)
class CameraOptions:
    """Camera of the image, and of its results.

    Attributes:
        elevation: Elevation of the image's camera above the object, degrees; all results are
            rotated so that the object is upright. By default it is estimated from the Gaussians.
        fov: Field of view of turntable, sheet and 3D viewer, degrees; by default that of the
            model, 49.1. Without --distance the object keeps its size in the image.
        distance: Distance of their camera, object units; by default the model's (1.5).
    """

    elevation: Elevation | None = None
    fov: Fov | None = None
    distance: Distance | None = None


@reported
@ranged
def reconstruct_command(
    images: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="IMAGE...")],
    /,
    checkpoint: Path | None = None,
    encoder_weights: Path | None = None,
    files: Annotated[FileOptions, tyro.conf.OmitArgPrefixes] = RECONSTRUCTED,
    camera: Annotated[CameraOptions, tyro.conf.OmitArgPrefixes] = CameraOptions(),
    sheet: Path | None = None,
    mask: Path | None = None,
    matte_model: Annotated[str | None, tyro.conf.arg(metavar="FILE|URL")] = None,
    sam: Path | None = None,
    cutout: Cutout = "auto",
    keep_holes: bool = False,
    recursive: bool = False,
    recenter: bool = True,
    detail: Detail | None = None,
    save_inputs: bool = False,
    device: DeviceChoice = "auto",
    precision: Precision = "float32",
) -> Results:
    """Turn images of single objects into 3D Gaussians, in one forward pass each.

    Args:
        images: Image files, or folders of them; - is an image from the standard input.
        checkpoint: Trained model (.safetensors); the shipped model by default.
        encoder_weights: The image encoder's weights, if the model has a pretrained one.
        files: Outputs to write.
        camera: Camera of the image, and of its results.
        sheet: Also one image of all inputs and five views around each (.png, .webp, .jpg).
        mask: Image that is brighter, or opaque, on the object (for a single image).
        matte_model: ISNet or U2-Net (.onnx) that cuts objects out, or a URL of one of rembg's.
        sam: Segment Anything's sam_vit_b_01ec64.pth (github.com/facebookresearch/segment-anything).
        cutout: How the object is cut out; auto is the first that finds one. none takes the whole
            image.
        keep_holes: Keep areas of a plain background's colour that the object encloses.
        recursive: Also take the images in the folders of a folder.
        recenter: Centre the object, at the size of training; else it keeps its position and size in
            a square image.
        detail: Number of Gaussians per side that each of the front may split into, for the
            image's sharpness; by default the most that the cut-out's pixels allow.
        save_inputs: Also write each cut-out as NAME-input.png, which may be edited and used again.
        device: Device that computes; auto is the GPU if there is one.
        precision: Precision of the network's matrix products; auto is bfloat16 if that is faster.
    """
    from ..model.checkpoint import DEFAULT_CHECKPOINT, FILE_NAME, load_model
    from ..model.detail import checked_detail
    from ..pages.card import about_model
    from ..pages.sheet import Sheet
    from ..photo.cutout import CutoutOptions, cut_out
    from ..pipeline import ReconstructionFiles, reconstruct_object

    paths, failures = _find_images(images, mask, recursive)
    checkpoint, chosen = checkpoint or DEFAULT_CHECKPOINT, pick_device(device)
    if not checkpoint.exists():
        raise UserError(
            f"{checkpoint}: no such checkpoint; train one with 'gamba train', or give "
            "--checkpoint FILE"
        )
    file = checkpoint / FILE_NAME if checkpoint.is_dir() else checkpoint
    outputs = ReconstructionFiles(
        options=files,
        device=chosen,
        checkpoint=checkpoint,
        about=about_model(file),
        inputs=save_inputs,
    )
    outputs.require()
    reads = (mask, Path(matte_model) if matte_model else None, sam, file, encoder_weights)
    names = plan_outputs(paths, outputs.suffixes(), files.out, reads, outputs.own(len(paths)))
    if sheet is not None:
        check_not_read([sheet], [*paths, *reads])
        outputs.sheet = Sheet(sheet)
        output_folder(sheet.parent)
    STAGES.begin("model")
    model = load_model(checkpoint, chosen, encoder_weights)
    checked_detail(detail, model.config, 0)  # before any cut-out
    options = CutoutOptions(
        mask, matte_model, sam, recenter, chosen, cutout=cutout, keep_holes=keep_holes
    )
    options.checked()
    output_folder(files.out)
    targets = [files.out / (name + suffix) for name in names for suffix in outputs.suffixes()]
    if older := sum(target.exists() for target in targets):
        say(f"{files.out}: {counted(older, 'file')} of an earlier run will be replaced")
    results = Results("image", len(paths), files.out, failures)
    places = {name: f"[{n}/{len(names)}] " for n, name in enumerate(names, 1)}

    def one(name: str, path: Path) -> None:
        STAGES.begin("cutting out")
        cut, original = cut_out(path, options), _given(path)
        say(f"{places[name] if len(names) > 1 else ''}{original}: {cut.how}")
        if cut.warning:
            warn(original, [f"{cut.warning} --save-inputs writes the cut-out for an image editor."])
        STAGES.begin("network")
        result = reconstruct_object(model, name, cut.rgba, camera.elevation, precision, detail)
        estimate, between = result.estimate, None
        if camera.elevation is None:
            between = estimate[1:] if estimate.doubtful else None
            say(f"{name}: the camera's elevation is about {estimate}; --elevation states it.")
        elevation = result.view.elevation
        result.view = result.view.changed(None, camera.distance, camera.fov)
        count, figures = outputs.write_result(result, cut)
        for line in (f"{name}: {count}", *figures["notes"]):
            say(line)
        source = {"input": str(original), "name": name, "cutout": cut.how, "warning": cut.warning}
        results.figures.append(
            source | {"elevation": elevation, "elevation_doubt": between} | figures
        )

    for_each(names, one, "reconstruct", "image", failures)
    failures[:] = [(_given(path), reason) for path, reason in failures]
    outputs.finish()
    return results


def _find_images(
    images: tuple[Path, ...], mask: Path | None, recursive: bool
) -> tuple[list[Path], list[tuple[Path, str]]]:
    """Return image files, and failures with reasons. Raises UserError without a file."""
    from ..images import find_images, left_out

    example = next(iter(sorted((STARTER / "icons").glob("*.png"))), None)
    if not images:
        raise UserError(f"give at least one image or folder, such as {example or 'photo.png'}")
    if example and images == (Path("photo.png"),) and not images[0].exists():  # the pages' example
        raise UserError(f"photo.png: no such file; give an image of yours, or {example}")
    sources = [_standard_input() if str(path) == "-" else path for path in dict.fromkeys(images)]
    paths, failures = find_images(sources, recursive)
    if mask is not None and len(paths) != 1:
        raise UserError(f"--mask goes with one image, {len(paths)} are given")
    if not paths:
        raise UserError("; ".join(f"{path}: {reason}" for path, reason in failures))
    for folder in images:
        if line := left_out(folder, recursive):
            say(f"{folder}: {line}")
    return paths, failures


def _given(path: Path) -> Path:
    """Return a file as it was given: the copy of the standard input is ``-``."""
    return Path("-") if path.parent.name.startswith(_PIPED) else path


def _standard_input() -> Path:
    """Return a copy of the standard input, which is removed at the end."""
    folder = tempfile.TemporaryDirectory(prefix=_PIPED)
    atexit.register(folder.cleanup)
    path = Path(folder.name) / "stdin"
    content = sys.stdin.buffer.read(MAX_STDIN + 1)
    if len(content) > MAX_STDIN:
        raise UserError(f"-: over {MAX_STDIN >> 20} MB on the standard input")
    path.write_bytes(content)
    return path
