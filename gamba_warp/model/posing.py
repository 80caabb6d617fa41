"""Posed input: images and their cameras in the world of the model.

This world has its origin at the object's centre and the axes of the reference camera, which is the
camera of the input image at the model's distance (``GambaConfig.distance``).
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from torch import Tensor

from ..cameras import Cameras, intrinsics, reference_viewmat, relative_to_reference
from ..conventions import over_background
from .config import GambaConfig

if TYPE_CHECKING:
    from ..data.dataset import ObjectViews


def reference_cameras(config: GambaConfig, count: int) -> Cameras:
    """Reference camera of a model, repeated ``count`` times, for images without a pose.

    Args:
        config: of the model; gives the size of the square images, the field of view and the
            distance.
        count: number of input images.

    Returns:
        Cameras ``[count]``, float32 on the CPU.
    """
    size = config.image_size
    viewmats = reference_viewmat(config.distance).repeat(count, 1, 1)
    return Cameras(viewmats, intrinsics(size, size, config.fov).repeat(count, 1, 1), size, size)


def relative_cameras(cameras: Cameras, distance: float) -> Cameras:
    """Transform cameras of a dataset to the model's world of the first one.

    Args:
        cameras: ``[V]`` of one object, V > 0; the first becomes the reference camera.
        distance: distance of the reference camera from the object's centre in the new world.

    Returns:
        Cameras ``[V]`` with new poses; see ``relative_to_reference``.
    """
    viewmats, _ = relative_to_reference(cameras.viewmats, cameras.viewmats[0], distance)
    return replace(cameras, viewmats=viewmats)


def posed_input(views: ObjectViews, config: GambaConfig) -> tuple[Tensor, Cameras]:
    """Convert the first view of an object to a model's input.

    Args:
        views: of one object; images of the model's ``image_size``.
        config: of the model; gives the background and the distance.

    Returns:
        Images ``[1, S, S, 3]`` RGB in [0, 1], or RGBA if the model takes it, and the reference
        camera ``[1]``, on the device of ``views``.
    """
    images = views.images[:1]
    if config.input_channels == 3:
        images = over_background(images, config.background_color)
    return images, relative_cameras(views.cameras[:1], config.distance)
