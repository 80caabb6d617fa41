"""Predictions under test: a checkpoint, a folder of ``.ply`` Gaussians, or one of images."""

from __future__ import annotations

from pathlib import Path
from typing import TypeAlias

import torch

from gamba_warp.conventions import Detail, Precision
from gamba_warp.data.dataset import ViewDataset
from gamba_warp.devices import network_precision, pick_precision
from gamba_warp.errors import UserError
from gamba_warp.files import sha256, sha256_of_all, visible
from gamba_warp.formats.ply import load_ply
from gamba_warp.gaussians import Gaussians
from gamba_warp.model.checkpoint import FILE_NAME, load_model
from gamba_warp.model.detail import checked_detail, split_front
from gamba_warp.model.posing import posed_input

from .images import ImagePredictions, holds_images


class PlyPredictions:
    """Gaussians in files ``<folder>/<uid>.ply``, 3DGS layout, in the reference camera's world.

    Attributes:
        distance: of the reference camera from the origin of that world, object units.
        source: for the report: kind, name, and the SHA-256 of the names and SHA-256s of the files.
    """

    def __init__(self, folder: Path, distance: float, device: str) -> None:
        self.folder, self.distance, self.device = folder, distance, device
        content = sha256_of_all(visible(folder, "*.ply"), folder)
        self.source = {"kind": "ply", "path": folder.name, "sha256": content}

    def gaussians(self, dataset: ViewDataset, uid: str, reference: int) -> Gaussians:
        """Return one object's Gaussians (no batch dimension).

        Args:
            dataset: that the object belongs to.
            uid: the object.
            reference: index of the input view.

        Raises:
            UserError: the file is missing or cannot be read.
        """
        return load_ply(self.folder / f"{uid}.ply").to(self.device)


class ModelPredictions:
    """A checkpoint, given only the reference view; attributes as in ``PlyPredictions``.

    Its Gaussians are as from ``gamba reconstruct`` for that view, see ``model.predict``; but where
    they do not split they are the network's, since views of its size have no gaps.
    """

    def __init__(
        self,
        path: Path,
        device: str,
        encoder_weights: Path | None,
        margin: int | None = None,
        precision: Precision = "float32",
        detail: Detail | None = None,
        size: int | None = None,
    ) -> None:
        self.model, self.device = load_model(path, device, encoder_weights), device
        self.margin, self.size = margin, size
        self.detail: Detail | None = detail
        checked_detail(detail, self.model.config, 0)
        kind = torch.device(device)
        self.precision = pick_precision(precision, kind, self.model.config.width)
        self.distance = self.model.config.distance
        file = path / FILE_NAME if path.is_dir() else path
        self.source = {"kind": "checkpoint", "path": path.name, "sha256": sha256(file)}
        if self.model.config.decoder == "rays":
            self.source["detail"] = "as the image has pixels" if detail is None else str(detail)
        if margin is not None:
            self.source["background_margin"] = str(margin)
        if self.precision != torch.float32:
            self.source["precision"] = str(self.precision).removeprefix("torch.")

    @torch.no_grad()
    def gaussians(self, dataset: ViewDataset, uid: str, reference: int) -> Gaussians:
        """Run the model on the reference view, on the model's own background.

        Arguments and result as in ``PlyPredictions.gaussians``. The front splits by the
        image at the compared size.
        """
        config = self.model.config
        views = dataset.load(uid, views=[reference], size=config.image_size)
        images, cameras = posed_input(views, config)
        images, cameras = images.to(self.device), cameras.to(self.device)
        with network_precision(images.device, self.precision):
            gaussians = self.model(images, cameras, background_margin=self.margin)[0]
        rgba = dataset.load(uid, views=[reference], size=self.size).images[0]
        detail = checked_detail(self.detail, config, len(rgba))
        return split_front(gaussians, images[0], rgba.cpu().numpy(), config, detail, cameras)


Predictions: TypeAlias = PlyPredictions | ModelPredictions | ImagePredictions


def open_predictions(
    path: Path,
    distance: float,
    device: str,
    encoder_weights: Path | None = None,
    resize: bool = False,
    margin: int | None = None,
    precision: Precision = "float32",
    detail: Detail | None = None,
    size: int | None = None,
) -> Predictions:
    """Open a folder with ``.ply`` files or with images, else a checkpoint.

    Args:
        path: the folder or the checkpoint.
        distance: of the reference camera, for ``.ply`` files; a checkpoint states its own.
        device: torch device.
        encoder_weights: as for ``load_model``.
        resize: resize images of another size.
        margin: ``background_margin`` of a model, see ``Gamba.forward``.
        precision: of a model's matrix products, see ``devices.pick_precision``.
        detail: of a model's front, see ``model.predict.reconstruct``.
        size: height of the compared images; None: the files' height.

    Raises:
        UserError: ``path`` is missing, the checkpoint cannot be read, or a margin, a precision or a
            detail is given without a model that takes it.
    """
    if not path.exists():
        raise UserError(f"{path}: no such checkpoint, folder of .ply files or of images")
    if path.is_dir() and next(visible(path, "*.ply"), None) is not None:
        found = PlyPredictions(path, distance, device)
    elif path.is_dir() and next(path.glob("*.safetensors"), None) is None:
        if not holds_images(path):
            raise UserError(
                f"{path}: holds neither .ply files nor folders of images nor a checkpoint"
            )
        found = ImagePredictions(path, distance, device, resize)
    else:
        return ModelPredictions(path, device, encoder_weights, margin, precision, detail, size)
    for name, given in (
        ("--background-margin", margin is not None),
        ("--precision", precision != "float32"),
        ("--detail", detail is not None),
    ):
        if given:
            raise UserError(f"{name}: {path} holds no model")
    return found
