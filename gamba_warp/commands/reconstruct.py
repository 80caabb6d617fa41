"""``gamba reconstruct``: pictures to 3D Gaussians, files, turntables and pages."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from ..batch import check_not_read, for_each, plan_outputs, report, say
from ..conventions import Axes, DeviceChoice
from ..devices import pick_device
from ..errors import UserError
from ..files import STARTER, output_folder
from ..formats.names import MeshFormat, SplatFormat
from ..untrusted.ranges import Frames, Opacity, Side, ranged

if TYPE_CHECKING:
    from ..pages.sheet import Sheet


@ranged
def reconstruct_command(
    images: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="IMAGE...")],
    /,
    checkpoint: Path | None = None,
    encoder_weights: Path | None = None,
    out: Path = Path("out"),
    splats: tuple[SplatFormat, ...] = ("ply",),
    mesh: tuple[MeshFormat, ...] = (),
    turntable: Literal["gif", "mp4", "none"] = "gif",
    size: Side = 256,
    frames: Frames = 48,
    page: bool = True,
    sheet: Path | None = None,
    mask: Path | None = None,
    matte_model: Path | None = None,
    sam: Path | None = None,
    save_inputs: bool = False,
    ply_frame: Axes = "opencv",
    min_opacity: Opacity = 0.0,
    device: DeviceChoice = "auto",
) -> int:
    """Turns pictures of single objects into 3D Gaussians, one forward pass each.

    Args:
        images: Picture files, or folders of them.
        checkpoint: Trained model (.safetensors); the starter model if not given.
        encoder_weights: The image encoder's weights, where the model has a pretrained one.
        out: Folder for the results.
        splats: Files of Gaussians to write.
        mesh: Also files of a coloured mesh (gamba export has its options).
        turntable: Moving picture of one turn.
        size: Side of the turntable's frames in pixels.
        frames: Number of views in the turntable.
        page: Write an HTML page with the input, the turntable and a 3D viewer.
        sheet: Also one picture of all results: each input, and five views around it (.png, .webp,
            .jpg).
        mask: Picture that is white where the object is (for a single image).
        matte_model: ONNX file of an ISNet or U2-Net that cuts objects out; if not given, one that
            rembg keeps on this machine, or it is fetched once (179 MB).
        sam: Segment Anything checkpoint, in place of that: sam_vit_b_01ec64.pth of
            github.com/facebookresearch/segment-anything, or mobile_sam.pt of
            github.com/ChaoningZhang/MobileSAM.
        save_inputs: Also write each cut-out as NAME-input.png, to be mended and given again.
        ply_frame: Axes of the .ply; opencv (y down) is what viewers assume.
        min_opacity: Leave out Gaussians fainter than this.
        device: Device that computes; auto is the GPU if there is one.
    """
    from ..model.checkpoint import DEFAULT_CHECKPOINT, load_model
    from ..model.predict import reconstruct
    from ..pages.card import about_model
    from ..pages.outputs import Outputs, write_outputs
    from ..photo.cutout import Ways, cut_out

    pictures, failures = _found(images, mask)
    checkpoint, chosen = checkpoint or DEFAULT_CHECKPOINT, pick_device(device)
    file = _file_of(checkpoint)
    outputs = Outputs(
        folder=out,
        splats=splats,
        mesh=mesh,
        turntable=turntable,
        size=size,
        frames=frames,
        page=page,
        axes=ply_frame,
        min_opacity=min_opacity,
        checkpoint=checkpoint,
        about=about_model(file),
        inputs=save_inputs,
    )
    reads = (mask, matte_model, sam, file, encoder_weights)
    names = plan_outputs(pictures, outputs.suffixes(), out, reads)
    outputs.sheet = _sheet(sheet, [*pictures, *reads])
    model = load_model(checkpoint, chosen, encoder_weights)
    ways = Ways(mask, matte_model, sam, chosen)
    ways.check()
    output_folder(out)

    def one(name: str, path: Path) -> None:
        cut = cut_out(path, ways)
        say(f"{path}: {cut.how}")
        started = time.perf_counter()
        gaussians = reconstruct(model, cut.rgba).to("cpu")  # waits for the device
        seconds = time.perf_counter() - started
        write_outputs(name, cut, gaussians.to(chosen), outputs, model.config, seconds)

    for_each(names, one, "reconstruct", "picture", failures)
    if outputs.sheet is not None:
        outputs.sheet.write()
    return report(len(pictures), "picture", failures, out)


def _found(
    images: tuple[Path, ...], mask: Path | None
) -> tuple[list[Path], list[tuple[Path, str]]]:
    """The picture files, and what gives none with the reason. Raises UserError without a file."""
    from ..images import find_pictures

    if not images:
        example = next(iter(sorted((STARTER / "icons").glob("*.png"))), "photo.png")
        raise UserError(f"give at least one picture or folder, such as {example}")
    pictures, failures = find_pictures(images)
    if mask is not None and len(pictures) != 1:
        raise UserError(f"--mask goes with one picture, {len(pictures)} are given")
    if not pictures:
        raise UserError("; ".join(f"{path}: {reason}" for path, reason in failures))
    return pictures, failures


def _file_of(checkpoint: Path) -> Path:
    """The model's file, also of a folder. Raises UserError, with a remedy, if it is not there."""
    from ..model.checkpoint import FILE_NAME

    if not checkpoint.exists():
        raise UserError(
            f"{checkpoint}: no such checkpoint; train one with 'gamba train', or give "
            "--checkpoint FILE"
        )
    return checkpoint / FILE_NAME if checkpoint.is_dir() else checkpoint


def _sheet(path: Path | None, reads: list[Path | None]) -> Sheet | None:
    """The sheet, if one is asked for, in a folder that is there. Raises UserError."""
    from ..pages.sheet import Sheet

    if path is None:
        return None
    check_not_read([path], reads)
    sheet = Sheet(path)
    output_folder(path.parent)
    return sheet
