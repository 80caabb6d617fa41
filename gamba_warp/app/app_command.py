"""``gamba app``: one picture to a 3D object, in the browser, on this machine alone."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro
from msgspec import Meta

from ..conventions import DeviceChoice
from ..untrusted.ranges import ranged


@ranged
def app_command(
    *,
    checkpoint: Path | None = None,
    encoder_weights: Path | None = None,
    matte_model: Annotated[str | None, tyro.conf.arg(metavar="FILE|URL")] = None,
    port: Annotated[int, Meta(ge=0, le=65535)] = 7860,
    open_browser: bool = True,
    max_upload_mb: Annotated[int, Meta(ge=1, le=1024)] = 30,
    device: DeviceChoice = "auto",
) -> None:
    """Serves a page that makes 3D objects of pictures, for this machine alone, until Ctrl-C.

    Args:
        checkpoint: Trained model (.safetensors); the shipped model if not given.
        encoder_weights: The image encoder's weights, where the model has a pretrained one.
        matte_model: ONNX file of an ISNet or U2-Net that cuts objects out, or the address of a copy
            of one of rembg's; if not given, one that rembg keeps on this machine, or it is fetched
            once (179 MB).
        port: Port of 127.0.0.1; 0 picks a free one.
        open_browser: Open the browser; the address is printed in any case.
        max_upload_mb: Largest picture file, MB.
        device: Device that computes; auto is the GPU if there is one.
    """
    from ..devices import pick_device
    from ..model.checkpoint import load_model
    from ..photo.cutout import Ways
    from .server import free_port, quiet, serve, work_folder

    chosen, port = pick_device(device), free_port(port)
    ways = Ways(matte_model=matte_model, device=chosen).checked()
    model = load_model(checkpoint, chosen, encoder_weights)
    with work_folder() as folder:
        quiet(folder)
        from .actions import Actions
        from .interface import build
        from .shelf import Shelf
        from .turns import MainThread

        turns, shelf = MainThread(), Shelf(folder)
        page = build(Actions(model, ways, shelf, str(chosen), turns))
        serve(page, shelf, port, max_upload_mb, open_browser, turns)
