"""Batches of views. What a batch holds is a function of (seed, step, place in it) alone.

So the order of the data needs no saved state: a resumed run goes on with the very same batches.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from gamba_warp.cameras import Cameras, relative_to_reference
from gamba_warp.data.dataset import ViewDataset, open_dataset
from gamba_warp.data.vgg_weights import lpips_available
from gamba_warp.errors import UserError
from gamba_warp.images import over_background
from gamba_warp.model.config import GambaConfig
from gamba_warp.model.lpips import LPIPS, load_lpips

from .config import TrainConfig

_TRIES = 8  # objects tried in place of one that cannot be read


@dataclass
class Batch:
    """B objects, each with one input picture and V+1 pictures to match, the input view first.

    Attributes:
        uids: B names.
        inputs: ``[B, h, w, 3]`` RGB in [0, 1] on the model's background.
        input_cameras: ``[B]``, in the model's world.
        targets: ``[B, V+1, H, W, 4]`` RGBA in [0, 1], straight alpha.
        cameras: ``[B, V+1]``.
        background: ``[B, 1, 3]`` RGB to render and composite on.
    """

    uids: list[str]
    inputs: Tensor
    input_cameras: Cameras
    targets: Tensor
    cameras: Cameras
    background: Tensor

    def to(self, device: torch.device) -> Batch:
        """The same batch on a device."""
        if device.type == "cpu":
            return self
        return Batch(
            self.uids,
            *(
                value.to(device, non_blocking=True)
                for value in (
                    self.inputs,
                    self.input_cameras,
                    self.targets,
                    self.cameras,
                    self.background,
                )
            ),
        )


def load_sample(
    dataset: ViewDataset,
    index: int,
    views: list[int],
    size: int,
    config: GambaConfig,
    background: Tensor,
) -> Batch:
    """One object as a batch of one; ``views[0]`` is the input view.

    Poses are relative to the input view, at the model's distance (``relative_to_reference``).

    Args:
        dataset: where from.
        index: of the object.
        views: the input view, then the novel ones.
        size: side of the pictures to match, pixels.
        config: the model's.
        background: RGB ``[3]``.

    Raises:
        UserError: the object cannot be read or its pictures are not square.
    """
    target = dataset.load(index, views, size)
    source = target
    if size != config.image_size:
        source = dataset.load(index, views[:1], config.image_size)
    for cameras in (target.cameras, source.cameras):
        if cameras.width != cameras.height:
            size = f"{cameras.width}x{cameras.height}"
            raise UserError(f"{target.uid}: pictures are {size}, training needs square ones")
    viewmats, _ = relative_to_reference(
        target.cameras.viewmats, target.cameras.viewmats[0], config.distance
    )
    return Batch(
        uids=[target.uid],
        inputs=over_background(source.images[:1], config.background_color),
        input_cameras=Cameras(
            viewmats[:1], source.cameras.Ks[:1], source.cameras.width, source.cameras.height
        ),
        targets=target.images[None],
        cameras=Cameras(
            viewmats[None], target.cameras.Ks[None], target.cameras.width, target.cameras.height
        ),
        background=background.reshape(1, 1, 3),
    )


def join(samples: list[Batch]) -> Batch:
    """One batch of all; every sample must have as many views."""
    return Batch(
        uids=[uid for s in samples for uid in s.uids],
        inputs=torch.cat([s.inputs for s in samples]),
        input_cameras=_join_cameras([s.input_cameras for s in samples]),
        targets=torch.cat([s.targets for s in samples]),
        cameras=_join_cameras([s.cameras for s in samples]),
        background=torch.cat([s.background for s in samples]),
    )


def _join_cameras(cameras: list[Cameras]) -> Cameras:
    return Cameras(
        torch.cat([c.viewmats for c in cameras]),
        torch.cat([c.Ks for c in cameras]),
        cameras[0].width,
        cameras[0].height,
    )


def choose_views(
    count: int, novel: int, reference: int | None, rng: np.random.Generator
) -> list[int]:
    """An input view and ``novel`` others, without repeats while there are enough.

    Args:
        count: views of the object.
        novel: V.
        reference: the input view, or None for any.
        rng: source of chance.
    """
    order = rng.permutation(count)
    first = int(order[0]) if reference is None else reference
    others = [int(v) for v in order if v != first] or [first]
    return [first, *(others[i % len(others)] for i in range(novel))]


class BatchSource:
    """Draws batches by number; see the module's docstring."""

    def __init__(
        self,
        dataset: ViewDataset,
        config: GambaConfig,
        *,
        objects: list[int],
        batch_size: int,
        size: int,
        reference: int | None,
        background: str,
        seed: int,
    ) -> None:
        """``batch_size`` counts all processes; ``objects`` may repeat an index."""
        self.dataset, self.config = dataset, config
        self.objects, self.batch_size, self.size = objects, batch_size, size
        self.reference, self.background, self.seed = reference, background, seed
        self.failures: dict[str, str] = {}

    def _object(self, number: int) -> int:
        """The object of the ``number``-th sample: a new permutation in each epoch."""
        epoch, place = divmod(number, len(self.objects))
        order = np.random.default_rng([self.seed, 1, epoch]).permutation(len(self.objects))
        return self.objects[order[place]]

    def sample(self, number: int, novel: int) -> Batch:
        """The ``number``-th sample with ``novel`` novel views.

        An object that cannot be read is noted in ``failures`` and another takes its place.

        Raises:
            UserError: several objects on end cannot be read.
        """
        rng = np.random.default_rng([self.seed, 2, number])
        background = torch.ones(3) if self.background == "white" else torch.zeros(3)
        if self.background == "random":
            background = torch.from_numpy(rng.random(3, dtype=np.float32))
        for attempt in range(_TRIES):
            index = self._object(number + attempt)
            try:
                count = self.dataset.num_views(index)
                views = choose_views(count, novel, self.reference, rng)
                return load_sample(self.dataset, index, views, self.size, self.config, background)
            except UserError as error:
                self.failures[self.dataset.uids[index]] = reason = str(error)
        raise UserError(f"{_TRIES} objects on end cannot be read; the last: {reason}")

    def batch(self, number: int, novel: int, rank: int = 0, size: int = 1) -> Batch:
        """This process's part of the ``number``-th batch."""
        share = self.batch_size // size
        first = number * self.batch_size + rank * share
        return join([self.sample(first + i, novel) for i in range(share)])


class Prefetcher:
    """Prepares the next batches on threads while the current one is used."""

    def __init__(self, threads: int) -> None:
        self._pool = ThreadPoolExecutor(threads, thread_name_prefix="batches")
        self._waiting: dict[object, Future] = {}

    def submit(self, key: object, function, *arguments) -> None:
        """Starts ``function(*arguments)``, unless that key is under way."""
        if key not in self._waiting:
            self._waiting[key] = self._pool.submit(function, *arguments)

    def take(self, key: object) -> Batch:
        """Waits for a submitted result. Raises what the function raised."""
        return self._waiting.pop(key).result()

    def close(self) -> None:
        """Drops what has not begun, waits for the rest."""
        self._pool.shutdown(cancel_futures=True)


def fixed_batches(
    dataset: ViewDataset,
    config: GambaConfig,
    objects: list[int],
    novel: int | None,
    size: int,
) -> Iterator[Batch]:
    """For validation: view 0 as the input and ``novel`` evenly spaced others (None: all), on white.

    Raises:
        UserError: an object cannot be read.
    """
    for index in objects:
        count = dataset.num_views(index)
        others = list(range(1, count))
        if novel is not None and novel < len(others):
            others = [others[i * len(others) // novel] for i in range(novel)]
        yield load_sample(dataset, index, [0, *others], size, config, torch.ones(3))


# For one object the network's pass is shared by all views, and drawing them is cheap beside it.
_OVERFIT_VIEWS = 9


@dataclass(frozen=True)
class TrainingData:
    """What to train and to validate on.

    Attributes:
        train: objects to train on.
        objects: indices into ``train``; one pass over the list is an epoch.
        reference: the input view, or None for any.
        batch_size: objects per batch and process.
        novel: novel views of each at every step; None means as many as the schedule says.
        validation: objects to validate on.
        held_out: indices into ``validation``; may be empty.
        val_views: novel views of each; None means all.
        notes: lines for the user.
    """

    train: ViewDataset
    objects: list[int]
    reference: int | None
    batch_size: int
    novel: int | None
    validation: ViewDataset
    held_out: list[int]
    val_views: int | None
    notes: list[str]

    @property
    def fingerprint(self) -> str:
        """Of the names of the objects in their order: another list would be another run."""
        names = "\n".join(self.train.uids[i] for i in self.objects)
        return hashlib.sha256(names.encode()).hexdigest()[:16]


def open_data(config: TrainConfig) -> TrainingData:
    """Opens the dataset as the options say.

    Raises:
        UserError: no such folder, no objects, no such object, or none of them can be read.
    """
    if config.views.overfit is not None:
        return _open_one(config)
    views, run, notes = config.views, config.run, []
    train = open_dataset(config.data, "train", cache=views.cache)
    bad = train.check()
    objects = [i for i, uid in enumerate(train.uids) if uid not in bad]
    notes += [f"{uid} is left out: {reason}" for uid, reason in bad.items()]
    if not objects:
        raise UserError(f"{config.data}: none of its {len(bad)} objects can be read: {notes[0]}")
    validation, held_out = train, []
    try:
        validation = open_dataset(config.data, "val")
        bad = validation.check()
        good = [i for i, uid in enumerate(validation.uids) if uid not in bad]
        share = min(run.val_objects, len(good))
        held_out = [good[k * len(good) // share] for k in range(share)]
    except UserError as error:
        notes.append(f"no validation: {error}")
    return TrainingData(
        train=train,
        objects=objects,
        reference=0 if views.reference == "first" else None,
        batch_size=views.batch_size or 8,
        novel=views.views_per_object,
        validation=validation,
        held_out=held_out,
        val_views=run.val_views,
        notes=notes,
    )


def _open_one(config: TrainConfig) -> TrainingData:
    views = config.views
    dataset = open_dataset(config.data, "all", cache=True)
    name = views.overfit
    if name in dataset.uids:
        index = dataset.uids.index(name)
    elif name.isdigit() and int(name) < len(dataset):
        index = int(name)
    else:
        raise UserError(f"--overfit {name}: no such uid, nor a number under {len(dataset)}")
    return TrainingData(
        train=dataset,
        objects=[index] * dataset.num_views(index),
        reference=None if views.reference == "random" else 0,
        batch_size=views.batch_size or 1,
        novel=_OVERFIT_VIEWS if views.views_per_object is None else views.views_per_object,
        validation=dataset,
        held_out=[index],
        val_views=None,
        notes=[],
    )


def open_lpips(config: TrainConfig) -> tuple[LPIPS | None, str | None]:
    """LPIPS as ``--lpips`` says, and a line for the user where it is missing.

    Raises:
        UserError: "on", and its weights are not there.
    """
    loss = config.loss
    if loss.lpips == "off" or loss.lpips_weight == 0:
        return None, None
    if loss.lpips == "auto" and not lpips_available():
        return None, "no LPIPS weights: training without (gamba weights lpips fetches them)"
    return load_lpips(), None
