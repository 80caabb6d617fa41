"""Training samples: an input image, and the images to match, with their cameras."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gamba_warp.cameras import Cameras
from gamba_warp.data.dataset import ObjectViews, ViewDataset
from gamba_warp.errors import UserError
from gamba_warp.model.config import GambaConfig
from gamba_warp.model.parts.patches import Foreground, find_foreground
from gamba_warp.model.posing import posed_input, relative_cameras

MAX_GAMMA = 1.5  # colours become value^gamma, gamma between 1 / MAX_GAMMA and this


@dataclass(frozen=True)
class Change:
    """Augmentation of the views of one sample.

    Attributes:
        flip: exchange left and right.
        channels: order of the colour channels.
        gamma: exponent of the colours, > 0.
    """

    flip: bool = False
    channels: tuple[int, int, int] = (0, 1, 2)
    gamma: float = 1.0

    def __call__(self, views: ObjectViews) -> ObjectViews:
        """Return the changed views."""
        if self.flip:
            views = mirrored(views)
        if self.channels == (0, 1, 2) and self.gamma == 1.0:
            return views  # the most frequent case
        images = views.images[..., [*self.channels, 3]]
        images[..., :3].pow_(self.gamma)
        return replace(views, images=images)


def draw_change(rng: np.random.Generator, flip: float, color_jitter: float) -> Change:
    """Draw a change.

    Args:
        rng: random generator.
        flip: probability that the object is mirrored.
        color_jitter: probability that its colours change.
    """
    # Always the same number of draws, so that one option does not affect the other.
    first, second, power = rng.random(3)
    order = rng.permutation(3)
    if second >= color_jitter:
        return Change(bool(first < flip))
    channels = (int(order[0]), int(order[1]), int(order[2]))
    return Change(bool(first < flip), channels, float(MAX_GAMMA ** (2 * power - 1)))


def mirrored(views: ObjectViews) -> ObjectViews:
    """Views of the object's mirror image: x of the world and of every image is flipped.

    A point p at the pixel (x, y) becomes M p at (W - x, y), M = diag(-1, 1, 1): with the viewmat
    M R M, M t and the principal point W - cx. Both R and M R M are rotations.
    """
    cameras = views.cameras
    flip = cameras.viewmats.new_tensor([-1.0, 1.0, 1.0, 1.0]).diag()
    Ks = cameras.Ks.clone()
    Ks[..., 0, 2] = cameras.width - Ks[..., 0, 2]
    flipped = Cameras(flip @ cameras.viewmats @ flip, Ks, cameras.width, cameras.height)
    depths, backs = (None if d is None else d.flip(-1) for d in (views.depths, views.backs))
    return replace(views, images=views.images.flip(-2), cameras=flipped, depths=depths, backs=backs)


@dataclass
class Batch:
    """B objects, each with one input image and V+1 images to match, the input view first.

    Attributes:
        uids: names of the objects, B.
        inputs: ``[B, h, w, 3]`` RGB in [0, 1] on the model's background, or RGBA ``[B, h, w, 4]``
            where the model takes alpha.
        input_cameras: ``[B]``, in the model's world.
        targets: ``[B, V+1, H, W, 4]`` RGBA in [0, 1], straight alpha.
        cameras: ``[B, V+1]``.
        background: ``[B, 1, 3]`` RGB that images are rendered and composited on.
        surfaces: ``[B, 2, h, w]`` depth of the first and of the last surface behind each pixel of
            the inputs, in the model's world, 0 where unknown; None unless requested.
        foreground: of the inputs, for the decoder ``rays``; None if not made yet.
    """

    uids: list[str]
    inputs: Tensor
    input_cameras: Cameras
    targets: Tensor
    cameras: Cameras
    background: Tensor
    surfaces: Tensor | None = None
    foreground: Foreground | None = None

    def to(self, device: torch.device) -> Batch:
        """Return the batch on a device; the copy to a GPU is asynchronous if it is pinned."""
        if device.type == "cpu":
            return self
        return _combined([self], lambda values: values[0].to(device, non_blocking=True))

    def used_on(self, stream: torch.cuda.Stream) -> None:
        """Keep the memory of the batch, once it is freed, until ``stream`` has done its work."""
        _combined([self], lambda values: values[0].record_stream(stream))

    def for_gpu(self) -> Batch:
        """Return the batch with its CPU tensors in page-locked memory.

        Only such memory is copied to a GPU asynchronously.
        """
        return _combined([self], lambda v: v[0].pin_memory() if v[0].device.type == "cpu" else v[0])


def copied(batch: Batch) -> Batch:
    """Return a copy of a batch that shares no tensors."""
    return _combined([batch], lambda values: values[0].clone())


def join(samples: list[Batch], config: GambaConfig) -> Batch:
    """Join samples to one batch, with the foreground that the model needs.

    All must have the same number of views.
    """
    return with_foreground(_combined(samples, torch.cat), config)


def with_foreground(batch: Batch, config: GambaConfig) -> Batch:
    """Return the batch with the padded foreground of its inputs, if the model needs it."""
    if config.decoder != "rays":
        return batch
    foreground = find_foreground(batch.inputs[..., 3].cpu(), config)
    return replace(batch, foreground=foreground.padded(config.ray_cells**2))


def _combined(parts: list[Any], make: Callable[[list[Tensor]], Any]) -> Any:
    """Combine parts of one type: tensors by ``make``, lists by concatenation."""
    first = parts[0]
    if isinstance(first, Tensor):
        return make(parts)
    if isinstance(first, list):
        return [item for part in parts for item in part]
    if not is_dataclass(first):
        return first
    by_name = {f.name: [getattr(part, f.name) for part in parts] for f in fields(first)}
    return type(first)(**{name: _combined(values, make) for name, values in by_name.items()})


def load_sample(
    dataset: ViewDataset,
    index: int,
    views: list[int],
    size: int,
    config: GambaConfig,
    background: Tensor,
    change: Change | None = None,
    surfaces: bool = False,
) -> Batch:
    """Load one object as a batch of one; ``views[0]`` is the input view.

    Poses are relative to the input view, at the model's distance (``model.posing``).

    Args:
        dataset: the dataset.
        index: number of the object.
        views: the input view, then the novel ones.
        size: side of the images to match, pixels.
        config: the model's configuration.
        background: RGB ``[3]``.
        change: augmentation of the views; None: not augmented.
        surfaces: also load them, if the object has depth images.

    Raises:
        UserError: the object cannot be read or its images are not square.
    """
    depths = int(surfaces)  # only of the input view
    target = dataset.load(index, views, size, depths)
    source = None
    if size != config.image_size:
        source = dataset.load(index, views[:1], config.image_size, depths)
    if change is not None:
        target, source = change(target), source and change(source)
    source = source or target
    for cameras in (target.cameras, source.cameras):
        if cameras.width != cameras.height:
            sides = f"{cameras.width}x{cameras.height}"
            raise UserError(f"{target.uid}: images are {sides}, training needs square ones")
    inputs, input_cameras = posed_input(source, config)
    surface_depths = None
    if surfaces:
        empty = torch.zeros(source.images.shape[1:3])
        both = torch.stack([empty if d is None else d[0] for d in (source.depths, source.backs)])
        surface_depths = both[None] * (config.distance / source.cameras.viewmats[0, :3, 3].norm())
    return Batch(
        uids=[target.uid],
        inputs=inputs,
        input_cameras=input_cameras,
        targets=target.images[None],
        cameras=relative_cameras(target.cameras, config.distance)[None],
        background=background.reshape(1, 1, 3),
        surfaces=surface_depths,
    )


def choose_views(
    count: int, novel: int, reference: int | None, rng: np.random.Generator
) -> list[int]:
    """Choose an input view and ``novel`` others, which repeat only if there are too few.

    Args:
        count: number of the object's views.
        novel: number of novel views, V.
        reference: the input view, or None for any.
        rng: random generator.
    """
    order = rng.permutation(count)
    first = int(order[0]) if reference is None else reference
    others = [int(v) for v in order if v != first] or [first]
    return [first, *(others[i % len(others)] for i in range(novel))]
