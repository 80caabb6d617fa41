"""Predictions under test: a checkpoint, a folder of ``.ply`` Gaussians, or one of images."""

from __future__ import annotations

from pathlib import Path
from typing import TypeAlias

import torch

from gamba_warp.conventions import Detail
from gamba_warp.data.dataset import ViewDataset
from gamba_warp.devices import network_precision, pick_precision
from gamba_warp.errors import UserError
from gamba_warp.files import sha256, sha256_of_all, visible
from gamba_warp.formats.ply import load_ply
from gamba_warp.gaussians import Gaussians
from gamba_warp.model.checkpoint import FILE_NAME, load_model
from gamba_warp.model.detail import checked_detail, split_front
from gamba_warp.model.posing import posed_input
from gamba_warp.untrusted.ranges import option

from .images import ImagePredictions, holds_images
from .options import ViewsOptions


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

    def __init__(self, options: ViewsOptions, device: str, size: int | None = None) -> None:
        path = options.checkpoint
        self.model, self.device = load_model(path, device, options.encoder_weights), device
        self.margin, self.size = options.background_margin, size
        self.detail: Detail | None = options.detail
        config = self.model.config
        checked_detail(self.detail, config, 0)
        self.precision = pick_precision(options.precision, torch.device(device), config.width)
        self.distance = config.distance
        file = path / FILE_NAME if path.is_dir() else path
        self.source = {"kind": "checkpoint", "path": path.name, "sha256": sha256(file)}
        if config.decoder == "rays":
            self.source["detail"] = str(self.detail or "as the image has pixels")
        if self.margin is not None:
            self.source["background_margin"] = str(self.margin)
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


def open_predictions(options: ViewsOptions, device: str, size: int | None = None) -> Predictions:
    """Open a folder with ``.ply`` files or with images, else a checkpoint.

    Args:
        options: with the folder or the checkpoint, and what it takes.
        device: torch device.
        size: height of the compared images; None: the files' height.

    Raises:
        UserError: it is missing or cannot be read, or a margin, a precision or a detail is given
            without a model that takes it.
    """
    path = options.checkpoint
    if not path.exists():
        raise UserError(f"{path}: no such checkpoint, folder of .ply files or of images")
    if path.is_dir() and next(visible(path, "*.ply"), None) is not None:
        predictions = PlyPredictions(path, options.distance, device)
    elif path.is_dir() and next(path.glob("*.safetensors"), None) is None:
        if not holds_images(path):
            raise UserError(
                f"{path}: holds neither .ply files nor folders of images nor a checkpoint"
            )
        predictions = ImagePredictions(path, options.distance, device, options.resize_images)
    else:
        return ModelPredictions(options, device, size)
    for name in ("background_margin", "precision", "detail"):
        if getattr(options, name) != getattr(ViewsOptions, name):
            raise UserError(f"{option(name)}: {path} holds no model")
    return predictions
