"""What a run trains on: its objects, and batches of their views.

A sample is a function of the seed and of its number in the run alone. So the order of the data
needs no saved state, and a resumed run goes on with the very same batches.
"""

from __future__ import annotations

import hashlib
import math
import os
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import torch

from gamba_warp.batch import EXPECTED
from gamba_warp.data.dataset import ViewDataset, evenly, open_dataset
from gamba_warp.errors import UserError, first_line
from gamba_warp.model.config import GambaConfig

from .config import TrainConfig
from .data.pool import Pool, PoolOptions
from .data.poses import front_views
from .data.samples import Batch, choose_views, draw_change, join, load_sample
from .data.settings import VARIED_CAMERAS, Settings
from .ddp import World

_TRIES = 100  # objects tried one after the other until one can be read
# With --overfit all views share the network's one pass, and rendering them is cheap beside it.
_OVERFIT_VIEWS = 9


@dataclass(frozen=True)
class TrainingData:
    """What a run trains and validates on.

    Attributes:
        train: dataset with the objects to train on.
        objects: indices into ``train``, which may repeat; one pass over the list is an epoch.
        reference: the input view, or None for any.
        batch_size: objects per batch and process.
        novel: novel views per object at every step; None means as many as the schedule says.
        validation: dataset with the objects to validate on; None: that of the training.
        held_out: indices into ``validation``; may be empty.
        val_views: novel views per object in a validation; None means all.
        notes: lines for the user.
    """

    train: ViewDataset
    objects: list[int]
    reference: int | None = None
    batch_size: int = 8
    novel: int | None = None
    validation: ViewDataset | None = None
    held_out: list[int] = field(default_factory=list)
    val_views: int | None = None
    notes: list[str] = field(default_factory=list)

    @property
    def fingerprint(self) -> str:
        """A hash of the objects' names in their order; a run with another list is another run."""
        names = "\n".join(self.train.uids[i] for i in self.objects)
        return hashlib.sha256(os.fsencode(names)).hexdigest()[:16]


def open_data(config: TrainConfig, device: torch.device | None = None) -> TrainingData:
    """Opens the dataset as the options say.

    Args:
        config: options of the run.
        device: where ``--cache-device`` keeps the pictures to train on; None: nowhere.

    Raises:
        UserError: the folder or the object of ``--overfit`` does not exist, no object can be read,
            or the device has no room for the pictures.
    """
    one = config.views.overfit
    data = _open_all(config) if one is None else _open_one(config, one)
    sizes = sorted({config.views.size, config.model_config().image_size})
    packed = data.train.packed_size
    if packed is not None and sizes[-1] > packed:
        data.notes.append(
            f"{config.data} is packed at {packed} pixels; its pictures are enlarged to {sizes[-1]}"
        )
    if config.views.cache_device and device is not None:
        data.train.keep(sorted(set(data.objects)), sizes, device, config.views.workers)
    return data


def _open_all(config: TrainConfig) -> TrainingData:
    views = config.views
    train = open_dataset(config.data, "train", cache=views.cache)
    for folder in views.extra:
        train = train.joined(folder.resolve().name, open_dataset(folder, "train"))
    bad = train.check()
    objects = [i for i, uid in enumerate(train.uids) if uid not in bad]
    notes = [f"{uid} is left out: {reason}" for uid, reason in bad.items()]
    if not objects:
        raise UserError(f"{config.data}: none of its {len(bad)} objects can be read: {notes[0]}")
    if config.loss.depth_weight and all(train.files(i).depths is None for i in objects):
        raise UserError(f"--depth-weight: {config.data} has no depth pictures, see data render")
    validation, held_out = None, []
    try:
        validation = open_dataset(config.data, "val")
        bad = validation.check()
        good = [i for i, uid in enumerate(validation.uids) if uid not in bad]
        held_out = evenly(good, config.run.val_objects)
    except UserError as error:
        notes.append(f"no validation: {error}")
    return TrainingData(
        train,
        objects,
        reference=0 if views.reference == "first" else None,
        batch_size=views.batch_size or 8,
        novel=views.views_per_object,
        validation=validation,
        held_out=held_out,
        val_views=config.run.val_views,
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
        dataset,
        objects=[index] * dataset.num_views(index),
        reference=None if views.reference == "random" else 0,
        batch_size=views.batch_size or 1,
        novel=_OVERFIT_VIEWS if views.views_per_object is None else views.views_per_object,
        held_out=[index],
    )


class Prepared(NamedTuple):
    """A batch as threads make it, before its failures count.

    Attributes:
        batch: the batch, or None where too many objects in a row cannot be read.
        failures: uids of objects that could not be read, each with its reason, in their order.
    """

    batch: Batch | None
    failures: list[tuple[str, str]]


class Batches:
    """The batches of a run, by their number (see the module's docstring).

    As many as there are threads are prepared ahead. A batch is the same for any number of threads,
    and so is the step at which an error is raised: what fails on a thread counts only when its
    batch is taken.

    Attributes:
        failures: reasons by uid, of the objects that could not be read so far.
        waited: seconds in ``take``, until it is set to 0.
        model: configuration of the model that the samples are for.
    """

    def __init__(
        self,
        data: TrainingData,
        config: TrainConfig,
        world: World,
        novel: Callable[[int], int] = lambda number: 0,
        last: int | None = None,
    ) -> None:
        """Prepares nothing yet.

        Args:
            data: what is trained on.
            config: options of the run.
            world: this process, whose part of each batch is taken to its device.
            novel: number of novel views by the number of a batch; it is asked when the batch is
                begun, so where it goes by the clock, it is that of ``workers`` batches before.
            last: number of batches of the run; None: no end.
        """
        self.data, self.config, self.model = data, config, config.model_config()
        self.world, self.novel, self.last = world, novel, last
        self.failures: dict[str, str] = {}
        self.waited = 0.0
        self._made: Pool | None = None  # it begins with the first batch that is taken
        self._order: tuple[int, np.ndarray] = (-1, np.empty(0, int))  # an epoch's number and order
        self._pool = ThreadPoolExecutor(config.views.workers, thread_name_prefix="batches")
        self._waiting: dict[int, Future[Prepared]] = {}

    def take(self, number: int) -> Batch:
        """Waits for the ``number``-th batch, on the device, and starts those that follow it.

        Raises:
            UserError: more than half of the objects, or 100 in a row, cannot be read.
        """
        began, end = time.perf_counter(), number + self.config.views.workers + 1
        self._begin_made(number)
        for following in range(number, end if self.last is None else min(end, self.last)):
            if following not in self._waiting:
                # The threads take their work in this order: when one comes to the joining, others
                # have begun all samples, and it waits for no thread that waits for it.
                novel = self.novel(following)
                parts = [
                    self._pool.submit(self.prepare, n, novel) for n in self._numbers(following)
                ]
                self._waiting[following] = self._pool.submit(self._joined, parts)
        batch = self._counted(self._waiting.pop(number).result()).to(self.world.device)
        self.waited += time.perf_counter() - began
        return batch

    def close(self) -> None:
        """Drops what has not begun; what has begun ends with a sample of each thread."""
        if self._made is not None:
            self._made.close()
        self._pool.shutdown(cancel_futures=True)

    def batch(self, number: int, novel: int) -> Batch:
        """Loads the ``number``-th batch here and now, with ``novel`` novel views."""
        self._begin_made(number)
        return join([self.sample(n, novel) for n in self._numbers(number)])

    def sample(self, number: int, novel: int) -> Batch:
        """Loads the ``number``-th sample; an object that cannot be read gives way to the next.

        Raises:
            UserError: as ``take``.
        """
        self._begin_made(number // self.data.batch_size // self.world.size)
        return self._counted(self.prepare(number, novel))

    def prepare(self, number: int, novel: int) -> Prepared:
        """As ``sample``, but what fails is only told: threads may prepare samples in any order."""
        views, seed = self.config.views, self.config.run.seed
        rng = np.random.default_rng([seed, 2, number])
        background = torch.ones(3) if views.background == "white" else torch.zeros(3)
        if views.background == "random":
            background = torch.from_numpy(rng.random(3, dtype=np.float32))
        # From a source of its own, so that runs without changes stay what they were.
        chance = np.random.default_rng([seed, 3, number])
        reference = self.data.reference
        front = reference is None and chance.random() < views.front_share
        pick = int(chance.integers(2**32))
        change = None
        if views.mirror or views.recolor:
            change = draw_change(chance, views.mirror, views.recolor)
        surfaces = self.config.loss.depth_weight > 0

        def loaded(dataset: ViewDataset, index: int) -> Batch:
            first = reference
            if front:
                found = front_views(dataset.files(index).camera_to_world)
                first = found[pick % len(found)]
            chosen = choose_views(dataset.num_views(index), novel, first, rng)
            about = (views.size, self.model, background, change, surfaces)
            return load_sample(dataset, index, chosen, *about)

        made = self._made_sample(number)
        if made is not None:
            assert self._made is not None
            return Prepared(loaded(self._made.take(made), 0), [])
        failed: list[tuple[str, str]] = []
        for attempt in range(_TRIES):
            index = self._object(number + attempt)
            try:
                return Prepared(loaded(self.data.train, index), failed)
            except EXPECTED as error:
                failed.append((self.data.train.uids[index], first_line(error)))
        return Prepared(None, failed)

    def _made_sample(self, number: int) -> int | None:
        """Number of a sample among the made ones of this process; None: it is of the datasets."""
        share, own = self.config.views.made, self.data.batch_size
        batch, position = number // own // self.world.size, number % own
        local = batch * own + position  # among the samples of this process
        before, after = math.floor(local * share), math.floor((local + 1) * share)
        return before if after > before else None

    def _begin_made(self, number: int) -> None:
        """Starts the pool of made objects with the ``number``-th batch, where it is not there."""
        views, world = self.config.views, self.world
        if not views.made or self._made is not None:
            return
        pictures = Settings(
            views=views.made_views,
            size=max(views.size, self.model.image_size),
            seed=self.config.run.seed,
            depth=self.config.loss.depth_weight > 0,
            fronts=views.made_views // 3,
            light="varied",
            up="y",
            **VARIED_CAMERAS,
        )
        options = PoolOptions(
            seed=self.config.run.seed,
            rank=world.rank,
            world=world.size,
            uses=views.made_uses,
            workers=views.made_workers,
            views=pictures,
        )
        self._made = Pool(options, math.floor(number * self.data.batch_size * views.made))

    def _object(self, number: int) -> int:
        """Returns the object of the ``number``-th sample; each epoch has its own permutation."""
        objects = self.data.objects
        epoch, position = divmod(number, len(objects))
        known, order = self._order  # both at once, for other threads replace them
        if known != epoch:
            rng = np.random.default_rng([self.config.run.seed, 1, epoch])
            order = rng.permutation(len(objects))
            self._order = epoch, order
        return objects[order[position]]

    def _numbers(self, number: int) -> range:
        """The samples of the ``number``-th batch that this process works on."""
        share = self.data.batch_size
        first = (number * self.world.size + self.world.rank) * share
        return range(first, first + share)

    def _joined(self, parts: list[Future[Prepared]]) -> Prepared:
        samples = [part.result() for part in parts]
        failures = [failure for sample in samples for failure in sample.failures]
        good = [sample.batch for sample in samples if sample.batch is not None]
        if len(good) < len(samples):
            return Prepared(None, failures)
        batch = join(good)
        return Prepared(batch.pinned() if self.world.device.type == "cuda" else batch, failures)

    def _counted(self, prepared: Prepared) -> Batch:
        """Records what failed, in the order of the run, and returns the batch."""
        for uid, reason in prepared.failures:
            self.failures[uid] = reason
            bad, known = len(self.failures), len(set(self.data.objects))
            if bad > known / 2:
                raise UserError(f"{bad} of {known} objects cannot be read; the last: {reason}")
        if prepared.batch is None:
            reason = prepared.failures[-1][1]
            raise UserError(f"{_TRIES} objects in a row cannot be read; the last: {reason}")
        return prepared.batch


def fixed_batches(
    data: TrainingData, config: GambaConfig, size: int, failures: dict[str, str]
) -> Iterator[Batch]:
    """Yields the batches of a validation, one object each, always the same views, on white.

    View 0 is the input; ``data.val_views`` others follow, evenly spaced in the list. An object that
    cannot be read is passed over, with its reason in ``failures``.
    """
    dataset = data.train if data.validation is None else data.validation
    for index in data.held_out:
        try:
            others = range(1, dataset.num_views(index))
            novel = evenly(others, len(others) if data.val_views is None else data.val_views)
            batch = load_sample(dataset, index, [0, *novel], size, config, torch.ones(3))
        except EXPECTED as error:
            failures[dataset.uids[index]] = first_line(error)
            continue
        yield batch
