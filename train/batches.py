"""What a run trains on: its objects, and batches of their views.

A sample is a function of the seed and of its number in the run alone. So the order of the data
needs no saved state, and a resumed run goes on with the very same batches.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from gamba_warp.batch import EXPECTED
from gamba_warp.cameras import Cameras
from gamba_warp.data.dataset import ObjectViews, ViewDataset, open_dataset
from gamba_warp.errors import UserError, first_line
from gamba_warp.model.config import GambaConfig
from gamba_warp.model.posing import posed_input, relative_cameras

from .config import DataConfig, TrainConfig
from .data.augment import Change, draw_change
from .data.poses import front_views

_TRIES = 100  # objects tried one after the other until one can be read
# With --overfit all views share the network's one pass, and rendering them is cheap beside it.
_OVERFIT_VIEWS = 9


@dataclass
class Batch:
    """B objects, each with one input picture and V+1 pictures to match, the input view first.

    Attributes:
        uids: names of the objects, B.
        inputs: ``[B, h, w, 3]`` RGB in [0, 1] on the model's background, or RGBA ``[B, h, w, 4]``
            where the model takes alpha.
        input_cameras: ``[B]``, in the model's world.
        targets: ``[B, V+1, H, W, 4]`` RGBA in [0, 1], straight alpha.
        cameras: ``[B, V+1]``.
        background: ``[B, 1, 3]`` RGB that pictures are rendered and composited on.
        surfaces: ``[B, 2, h, w]`` depth of the first and of the last surface behind each pixel of
            the inputs, in the model's world, 0 where none is known; None: nobody asked for them.
    """

    uids: list[str]
    inputs: Tensor
    input_cameras: Cameras
    targets: Tensor
    cameras: Cameras
    background: Tensor
    surfaces: Tensor | None = None

    def to(self, device: torch.device) -> Batch:
        """Returns the same batch on a device."""
        if device.type == "cpu":
            return self
        return Batch(
            uids=self.uids,
            inputs=self.inputs.to(device, non_blocking=True),
            input_cameras=self.input_cameras.to(device, non_blocking=True),
            targets=self.targets.to(device, non_blocking=True),
            cameras=self.cameras.to(device, non_blocking=True),
            background=self.background.to(device, non_blocking=True),
            surfaces=None if self.surfaces is None else self.surfaces.to(device, non_blocking=True),
        )


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
    """Loads one object as a batch of one; ``views[0]`` is the input view.

    Poses are relative to the input view, at the model's distance (``model.posing``).

    Args:
        dataset: the dataset.
        index: number of the object.
        views: the input view, then the novel ones.
        size: side of the pictures to match, pixels.
        config: the model's configuration.
        background: RGB ``[3]``.
        change: what is done with the views first; None: nothing.
        surfaces: whether those are loaded too, where the object has depth pictures.

    Raises:
        UserError: the object cannot be read or its pictures are not square.
    """
    depths = int(surfaces)  # of the input view alone
    target = dataset.load(index, views, size, depths)
    source = target
    if size != config.image_size:
        source = dataset.load(index, views[:1], config.image_size, depths)
    if change is not None:
        target, source = change(target), change(source)
    for cameras in (target.cameras, source.cameras):
        if cameras.width != cameras.height:
            sides = f"{cameras.width}x{cameras.height}"
            raise UserError(f"{target.uid}: pictures are {sides}, training needs square ones")
    inputs, input_cameras = posed_input(source, config)
    return Batch(
        uids=[target.uid],
        inputs=inputs,
        input_cameras=input_cameras,
        targets=target.images[None],
        cameras=relative_cameras(target.cameras, config.distance)[None],
        background=background.reshape(1, 1, 3),
        surfaces=_surfaces(source, config.distance) if surfaces else None,
    )


def _surfaces(views: ObjectViews, distance: float) -> Tensor:
    """Those of ``Batch``, of the first view: ``[1, 2, h, w]``."""
    empty = torch.zeros(views.images.shape[1:3])
    found = [empty if d is None else d[0] for d in (views.depths, views.backs)]
    return torch.stack(found)[None] * (distance / views.cameras.viewmats[0, :3, 3].norm())


def join(samples: list[Batch]) -> Batch:
    """Joins samples to one batch; all must have the same number of views."""
    surfaces = [s.surfaces for s in samples if s.surfaces is not None]
    return Batch(
        uids=[uid for s in samples for uid in s.uids],
        inputs=torch.cat([s.inputs for s in samples]),
        input_cameras=_join_cameras([s.input_cameras for s in samples]),
        targets=torch.cat([s.targets for s in samples]),
        cameras=_join_cameras([s.cameras for s in samples]),
        background=torch.cat([s.background for s in samples]),
        surfaces=torch.cat(surfaces) if surfaces else None,
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
    """Chooses an input view and ``novel`` others, which repeat only if there are too few.

    Args:
        count: number of the object's views.
        novel: number of novel views, V.
        reference: the input view, or None for any.
        rng: source of chance.
    """
    order = rng.permutation(count)
    first = int(order[0]) if reference is None else reference
    others = [int(v) for v in order if v != first] or [first]
    return [first, *(others[i % len(others)] for i in range(novel))]


class BatchSource:
    """Draws batches by their number (see the module's docstring)."""

    def __init__(
        self,
        dataset: ViewDataset,
        config: GambaConfig,
        *,
        objects: list[int],
        batch_size: int,
        reference: int | None,
        views: DataConfig,
        seed: int,
        surfaces: bool = False,
    ) -> None:
        """``batch_size`` is that of all processes together; ``objects`` may repeat an index."""
        self.dataset, self.config, self.views = dataset, config, views
        self.objects, self.batch_size, self.size = objects, batch_size, views.size
        self.reference, self.background, self.seed = reference, views.background, seed
        self.surfaces = surfaces
        self.failures: dict[str, str] = {}

    def _object(self, number: int) -> int:
        """Returns the object of the ``number``-th sample; each epoch has its own permutation."""
        epoch, position = divmod(number, len(self.objects))
        order = np.random.default_rng([self.seed, 1, epoch]).permutation(len(self.objects))
        return self.objects[order[position]]

    def sample(self, number: int, novel: int) -> Batch:
        """Loads the ``number``-th sample with ``novel`` novel views.

        An object that cannot be read is recorded in ``failures``, and the next one is taken.

        Raises:
            UserError: more than half of the objects, or 100 in a row, cannot be read.
        """
        rng = np.random.default_rng([self.seed, 2, number])
        background = torch.ones(3) if self.background == "white" else torch.zeros(3)
        if self.background == "random":
            background = torch.from_numpy(rng.random(3, dtype=np.float32))
        # From a source of its own, so that runs without changes stay what they were.
        chance = np.random.default_rng([self.seed, 3, number])
        reference = self.reference
        front = reference is None and chance.random() < self.views.front_share
        pick = int(chance.integers(2**32))
        change = None
        if self.views.mirror or self.views.recolor:
            change = draw_change(chance, self.views.mirror, self.views.recolor)
        for attempt in range(_TRIES):
            index = self._object(number + attempt)
            try:
                count = self.dataset.num_views(index)
                if front:
                    found = front_views(self.dataset.files(index).camera_to_world)
                    reference = found[pick % len(found)]
                views = choose_views(count, novel, reference, rng)
                first = (self.dataset, index, views, self.size, self.config, background)
                return load_sample(*first, change, self.surfaces)
            except EXPECTED as error:
                reason = self._note(index, error)
        raise UserError(f"{_TRIES} objects in a row cannot be read; the last: {reason}")

    def _note(self, index: int, error: Exception) -> str:
        """Records a failure; raises UserError where too many objects have failed."""
        reason = first_line(error)
        self.failures[self.dataset.uids[index]] = reason
        bad, all_objects = len(self.failures), len(set(self.objects))
        if bad > all_objects / 2:
            raise UserError(f"{bad} of {all_objects} objects cannot be read; the last: {reason}")
        return reason

    def batch(self, number: int, novel: int, rank: int = 0, size: int = 1) -> Batch:
        """Loads the part of the ``number``-th batch that process ``rank`` of ``size`` works on."""
        share = self.batch_size // size
        first = number * self.batch_size + rank * share
        return join([self.sample(first + i, novel) for i in range(share)])


class Prefetcher:
    """Prepares the next batches on threads while the current one is used."""

    def __init__(self, threads: int) -> None:
        self._pool = ThreadPoolExecutor(threads, thread_name_prefix="batches")
        self._waiting: dict[object, Future] = {}

    def submit(self, key: object, function, *arguments) -> None:
        """Starts ``function(*arguments)``, unless it was started with this key before."""
        if key not in self._waiting:
            self._waiting[key] = self._pool.submit(function, *arguments)

    def take(self, key: object) -> Batch:
        """Waits for the result of a key; an error of its function is raised here."""
        return self._waiting.pop(key).result()

    def close(self) -> None:
        """Drops what has not begun and waits for the rest."""
        self._pool.shutdown(cancel_futures=True)


def fixed_batches(
    dataset: ViewDataset,
    config: GambaConfig,
    objects: list[int],
    novel: int | None,
    size: int,
    failures: dict[str, str],
) -> Iterator[Batch]:
    """Yields the batches of a validation, one object each, always the same views, on white.

    View 0 is the input; ``novel`` others follow, evenly spaced in the list (None: all). An object
    that cannot be read is passed over, with its reason in ``failures``.
    """
    for index in objects:
        try:
            count = dataset.num_views(index)
            others = list(range(1, count))
            if novel is not None and novel < len(others):
                others = [others[i * len(others) // novel] for i in range(novel)]
            batch = load_sample(dataset, index, [0, *others], size, config, torch.ones(3))
        except EXPECTED as error:
            failures[dataset.uids[index]] = first_line(error)
            continue
        yield batch


@dataclass(frozen=True)
class TrainingData:
    """What a run trains and validates on.

    Attributes:
        train: dataset with the objects to train on.
        objects: indices into ``train``; one pass over the list is an epoch.
        reference: the input view, or None for any.
        batch_size: objects per batch and process.
        novel: novel views per object at every step; None means as many as the schedule says.
        validation: dataset with the objects to validate on.
        held_out: indices into ``validation``; may be empty.
        val_views: novel views per object in a validation; None means all.
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
        """A hash of the objects' names in their order; a run with another list is another run."""
        names = "\n".join(self.train.uids[i] for i in self.objects)
        return hashlib.sha256(os.fsencode(names)).hexdigest()[:16]


def open_data(config: TrainConfig) -> TrainingData:
    """Opens the dataset as the options say.

    Raises:
        UserError: the folder or the object of ``--overfit`` does not exist, or no object can be
            read.
    """
    if config.views.overfit is not None:
        return _open_one(config, config.views.overfit)
    views, run, notes = config.views, config.run, []
    train = open_dataset(config.data, "train", cache=views.cache)
    for folder in views.extra:
        train = train.joined(folder.resolve().name, open_dataset(folder, "train"))
    bad = train.check()
    objects = [i for i, uid in enumerate(train.uids) if uid not in bad]
    notes += [f"{uid} is left out: {reason}" for uid, reason in bad.items()]
    if not objects:
        raise UserError(f"{config.data}: none of its {len(bad)} objects can be read: {notes[0]}")
    if config.loss.depth_weight and all(train.files(i).depths is None for i in objects):
        raise UserError(f"--depth-weight: {config.data} has no depth pictures, see data render")
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


def _open_one(config: TrainConfig, name: str) -> TrainingData:
    """Opens the one object that ``--overfit`` names; an epoch is a pass over its views."""
    views = config.views
    dataset = open_dataset(config.data, "all", cache=True)
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
