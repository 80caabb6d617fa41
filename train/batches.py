"""What a run trains on: its objects, and batches of their views.

A sample is a function of the seed and of its number in the run alone. So the order of the data
needs no saved state, and a resumed run goes on with the very same batches.
"""

from __future__ import annotations

import hashlib
import os
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch

from gamba_warp.batch import EXPECTED
from gamba_warp.data.dataset import ViewDataset, evenly, open_dataset
from gamba_warp.data.prefetch import Prefetcher
from gamba_warp.data.resident import ResidentViews
from gamba_warp.errors import UserError, first_line
from gamba_warp.model.config import GambaConfig

from .config import DataConfig, TrainConfig
from .data.poses import front_views
from .data.samples import Batch, choose_views, draw_change, join, load_sample
from .ddp import World

_TRIES = 100  # objects tried one after the other until one can be read
# With --overfit all views share the network's one pass, and rendering them is cheap beside it.
_OVERFIT_VIEWS = 9


@dataclass(frozen=True)
class Prepared:
    """A batch as threads make it, before its failures count.

    Attributes:
        batch: the batch, or None where too many objects in a row cannot be read.
        failures: uids of objects that could not be read, each with its reason, in their order.
    """

    batch: Batch | None
    failures: list[tuple[str, str]]


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
        self._order: tuple[int, np.ndarray] = (-1, np.empty(0, int))  # an epoch's number and order

    def _object(self, number: int) -> int:
        """Returns the object of the ``number``-th sample; each epoch has its own permutation."""
        epoch, position = divmod(number, len(self.objects))
        known, order = self._order  # both at once, for other threads replace them
        if known != epoch:
            order = np.random.default_rng([self.seed, 1, epoch]).permutation(len(self.objects))
            self._order = epoch, order
        return self.objects[order[position]]

    def sample(self, number: int, novel: int) -> Batch:
        """Loads the ``number``-th sample with ``novel`` novel views.

        An object that cannot be read is recorded in ``failures``, and the next one is taken.

        Raises:
            UserError: more than half of the objects, or 100 in a row, cannot be read.
        """
        return self.counted(self.prepare(number, novel))

    def prepare(self, number: int, novel: int) -> Prepared:
        """As ``sample``, but what fails is only told: threads may prepare samples in any order."""
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
        failed: list[tuple[str, str]] = []
        for attempt in range(_TRIES):
            index = self._object(number + attempt)
            try:
                count = self.dataset.num_views(index)
                if front:
                    found = front_views(self.dataset.files(index).camera_to_world)
                    reference = found[pick % len(found)]
                views = choose_views(count, novel, reference, rng)
                first = (self.dataset, index, views, self.size, self.config, background)
                return Prepared(load_sample(*first, change, self.surfaces), failed)
            except EXPECTED as error:
                failed.append((self.dataset.uids[index], first_line(error)))
        return Prepared(None, failed)

    def counted(self, prepared: Prepared) -> Batch:
        """Records what failed, in the order of the run, and returns the batch.

        Raises:
            UserError: as ``sample``.
        """
        for uid, reason in prepared.failures:
            self.failures[uid] = reason
            bad, known = len(self.failures), len(set(self.objects))
            if bad > known / 2:
                raise UserError(f"{bad} of {known} objects cannot be read; the last: {reason}")
        if prepared.batch is None:
            reason = prepared.failures[-1][1]
            raise UserError(f"{_TRIES} objects in a row cannot be read; the last: {reason}")
        return prepared.batch

    def numbers(self, number: int, rank: int = 0, size: int = 1) -> list[int]:
        """The samples of the ``number``-th batch that process ``rank`` of ``size`` works on."""
        share = self.batch_size // size
        first = number * self.batch_size + rank * share
        return list(range(first, first + share))

    def batch(self, number: int, novel: int, rank: int = 0, size: int = 1) -> Batch:
        """Loads the part of the ``number``-th batch that process ``rank`` of ``size`` works on."""
        return join([self.sample(n, novel) for n in self.numbers(number, rank, size)])


class BatchQueue:
    """The batches of a run in their order; as many as there are threads are prepared ahead.

    A batch is the same for any number of threads, and so is the step at which an error is raised:
    what fails on a thread counts only when its batch is taken.
    """

    def __init__(
        self,
        source: BatchSource,
        workers: int,
        novel: Callable[[int], int],
        world: World,
        last: int | None = None,
    ) -> None:
        """Prepares nothing yet.

        Args:
            source: draws the batches.
            workers: number of threads, and of batches ahead of the one that is taken.
            novel: number of novel views by the number of a batch; it is asked when the batch is
                begun, so where it goes by the clock, it is that of ``workers`` batches before.
            world: this process, whose part of each batch is taken to its device.
            last: number of batches of the run; None: no end.
        """
        self.source, self.workers, self.novel = source, workers, novel
        self.world, self.last = world, last
        self.waited = 0.0  # seconds in ``take``, until it is set to 0
        self._threads: Prefetcher[Prepared, Prepared] = Prefetcher(workers)

    def take(self, number: int) -> Batch:
        """Waits for the ``number``-th batch, on the device, and starts those that follow it.

        Raises:
            UserError: as ``BatchSource.sample``.
        """
        began, end = time.perf_counter(), number + self.workers + 1
        for following in range(number, end if self.last is None else min(end, self.last)):
            if following not in self._threads:
                numbers = self.source.numbers(following, self.world.rank, self.world.size)
                novel = self.novel(following)
                parts = [partial(self.source.prepare, n, novel) for n in numbers]
                self._threads.submit(following, parts, self._joined)
        batch = self.source.counted(self._threads.take(number)).to(self.world.device)
        self.waited += time.perf_counter() - began
        return batch

    def close(self) -> None:
        """Drops what has not begun; what has begun ends with a sample of each thread."""
        self._threads.close()

    def _joined(self, samples: list[Prepared]) -> Prepared:
        failures = [failure for sample in samples for failure in sample.failures]
        good = [sample.batch for sample in samples if sample.batch is not None]
        if len(good) < len(samples):
            return Prepared(None, failures)
        batch = join(good)
        return Prepared(batch.pinned() if self.world.device.type == "cuda" else batch, failures)


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
            others = evenly(range(1, count), count if novel is None else novel)
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
    one = config.views.overfit
    data = _open_all(config) if one is None else _open_one(config, one)
    sizes = {config.views.size, config.model_config().image_size}
    packed = data.train.packed_size
    if packed is not None and max(sizes) > packed:
        data.notes.append(
            f"{config.data} is packed at {packed} pixels; its pictures are enlarged to {max(sizes)}"
        )
    return data


def kept_on(device: torch.device, config: TrainConfig, data: TrainingData) -> TrainingData:
    """The data with the pictures to train on kept on a device, if ``--cache-device`` asks for it.

    Raises:
        UserError: the device has no room for them.
    """
    if not config.views.cache_device:
        return data
    sizes = sorted({config.views.size, config.model_config().image_size})
    objects, workers = sorted(set(data.objects)), config.views.workers
    return replace(data, train=ResidentViews(data.train, objects, sizes, device, workers))


def _open_all(config: TrainConfig) -> TrainingData:
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
        held_out = evenly(good, run.val_objects)
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
