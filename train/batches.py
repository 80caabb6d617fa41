"""Training data of a run: its objects, and batches of their views.

A sample is a function of the seed and of its number in the run. The order of the data therefore
needs no saved state, and a resumed run continues with the same batches.
"""

from __future__ import annotations

import hashlib
import math
import os
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from itertools import chain
from pathlib import Path
from threading import Lock
from typing import Any, NamedTuple

import numpy as np
import torch

from gamba_warp.batch import EXPECTED
from gamba_warp.data.dataset import (
    ViewDataset,
    background_note,
    camera_note,
    evenly,
    open_dataset,
)
from gamba_warp.data.gso import scanned
from gamba_warp.errors import UserError, first_line
from gamba_warp.model.config import GambaConfig

from .config import TrainConfig
from .data.pool import VIEWS as POOL_VIEWS
from .data.pool import Pool
from .data.poses import front_views
from .data.samples import Batch, choose_views, draw_change, join, load_sample
from .data.settings import VARIED_CAMERAS, Settings
from .data.shards import Shards, Unreachable, dataset_of, shards_at
from .ddp import World

_TRIES = 100  # objects tried in turn until one can be read
VAL_VIEWS = 4  # novel views of an object in a validation
_READ, _SIZED = 16, 4096  # objects whose first image, and sizes of files, are in a digest


class FixedObjects(NamedTuple):
    """Objects of one dataset whose figures a validation computes.

    Attributes:
        dataset: the dataset.
        objects: indices into it.
    """

    dataset: ViewDataset
    objects: list[int]


@dataclass(frozen=True)
class TrainingData:
    """Training and validation data of a run.

    Attributes:
        train: dataset with the objects to train on.
        objects: indices into ``train``, possibly repeated; one pass over the list is an epoch.
        held_out: validation objects; None without any.
        seen: as many training objects, whose figures are logged beside; None for shards.
        notes: lines for the user.
        shards: the shards to train on; ``train`` is then empty, and ``objects`` are numbers.
    """

    train: ViewDataset
    objects: list[int]
    held_out: FixedObjects | None = None
    seen: FixedObjects | None = None
    notes: list[str] = field(default_factory=list)
    shards: Shards | None = None

    @property
    def fingerprint(self) -> str:
        """Hash of the objects' names in order; a run with another list is another run."""
        names = "\n".join(
            [self.train.uids[i] for i in self.objects]
            if self.shards is None
            else [str(self.shards.count), *(url.rpartition("/")[2] for url in self.shards.urls)]
        )
        return hashlib.sha256(os.fsencode(names)).hexdigest()[:16]

    @cached_property
    def digests(self) -> dict[str, str]:
        """Hashes of the content: of each object, of several in a large set, or of each shard here.

        Of an object its cameras; of up to ``_SIZED`` objects the sizes of all files; of up to
        ``_READ`` the first image. Times are left out, since copies have others.
        """
        if self.shards is not None:
            urls = [url for url in self.shards.urls if "://" not in url]
            return {os.path.basename(url): str(_size(url)) for url in urls}
        chosen, hashes = sorted(set(self.objects)), {}
        read, sized = (set(evenly(chosen, count)) for count in (_READ, _SIZED))
        step = max(1, math.ceil(len(chosen) / _SIZED))
        for part in (chosen[at : at + step] for at in range(0, len(chosen), step)):
            digest = hashlib.sha256()
            for index in part:
                digest.update(self.train.digest(index).encode())
                if index in sized:
                    files = self.train.files(index)
                    kinds = filter(None, (files.images, files.masks, files.depths, files.backs))
                    paths = [path for path in chain.from_iterable(kinds) if isinstance(path, Path)]
                    digest.update(repr([_size(path) for path in paths]).encode())
                    if index in read and paths:
                        with suppress(OSError):  # the training reports it when it matters
                            digest.update(paths[0].read_bytes())
            names = dict.fromkeys(self.train.uids[index] for index in (part[0], part[-1]))
            hashes[" to ".join(names)] = digest.hexdigest()[:16]
        return hashes

    @property
    def content(self) -> str:
        """Hash of ``digests``; a run with other images of the same names is another run."""
        return hashlib.sha256(repr(self.digests).encode()).hexdigest()[:16]


def _size(path: str | Path) -> int:
    """Bytes of a file; -1 if it cannot be read."""
    try:
        return os.stat(path).st_size
    except OSError:
        return -1


def open_data(config: TrainConfig) -> TrainingData:
    """Open the datasets of a run.

    Args:
        config: options of the run.

    Raises:
        UserError: a folder does not exist, no object can be read, or the data has Google Scanned
            Objects.
    """
    if (source := shards_at(config.data)) is not None:
        return _open_shards(config, source)
    views = config.views
    train = open_dataset(config.data, "train", cache=views.cache)
    taken = [range(len(train))]  # objects of DATA, then of each of --extra
    known = {config.data.resolve(): taken[0]}
    for folder in views.extra:
        if folder.resolve() not in known:
            first = len(train)
            train = train.joined(folder.resolve().name, open_dataset(folder, "train"))
            known[folder.resolve()] = range(first, len(train))
        taken.append(known[folder.resolve()])
    bad = train.check()
    objects = [i for part in taken for i in part if train.uids[i] not in bad]
    notes = [f"{uid} is left out: {reason}" for uid, reason in bad.items()]
    if not objects:
        raise UserError(f"{config.data}: none of its {len(bad)} objects can be read: {notes[0]}")
    if config.loss.depth_weight and all(train.files(i).depths is None for i in objects):
        line = f"{config.data} has no depth images (gamba data render --depth)"
        if config.run.recipe is None:
            raise UserError(f"--depth-weight: {line}")
        notes.append(f"{line}: its objects are trained without the loss of depth")
    if note := camera_note(train):
        raise UserError(f"{config.data}: {note}")
    notes += filter(None, [background_note(train)])
    held_out = None
    try:
        held_out = _fixed_objects(open_dataset(config.data, "val"), config.run.val_objects)
    except UserError as error:
        notes.append(f"no validation: {error}")
    used = {train.uids[i] for i in objects}
    if held_out is not None:
        used |= {held_out.dataset.uids[i] for i in held_out.objects}
    if names := scanned(used):
        shown = ", ".join(names[:3]) + (", ..." if len(names) > 3 else "")
        raise UserError(
            f"the data has Google Scanned Objects, which are for evaluation ({shown}): leave them "
            "out"
        )
    seen = FixedObjects(train, evenly(sorted(set(objects)), config.run.val_objects))
    return TrainingData(train, objects, held_out, seen, notes)


def _open_shards(config: TrainConfig, source: str) -> TrainingData:
    """Open shards of ``gamba data pack``.

    Raises:
        UserError: the index is invalid, or an option needs a folder of objects.
    """
    needs_folders = {"--extra": config.views.extra, "--cache": config.views.cache}
    for name in (name for name, value in needs_folders.items() if value):
        raise UserError(f"{name}: needs a folder of objects, and {config.data} has shards")
    shards, notes, held_out = Shards(source, "train"), [], None
    try:
        held_out = _fixed_objects(Shards(source, "val").first(config.run.val_objects))
    except UserError as error:
        notes.append(f"no validation: {error}")
    everything = [*range(shards.count)]
    return TrainingData(dataset_of(), everything, held_out, notes=notes, shards=shards)


def _fixed_objects(dataset: ViewDataset, count: int | None = None) -> FixedObjects | None:
    """Choose ``count`` evenly spaced readable objects, or all; None without any."""
    bad = dataset.check()
    good = [i for i, uid in enumerate(dataset.uids) if uid not in bad]
    chosen = evenly(good, len(good) if count is None else count)
    return FixedObjects(dataset, chosen) if chosen else None


class Prepared(NamedTuple):
    """Batch prepared by threads, before its failures are counted.

    Attributes:
        batch: the batch, or None if too many objects in a row cannot be read.
        failures: uids of unreadable objects with the reasons, in order.
        copied: event of a GPU at which the batch is there; None on a CPU.
    """

    batch: Batch | None
    failures: list[tuple[str, str]]
    copied: Any = None


class Batches:
    """Batches of a run, by number (see the module's docstring).

    One batch per thread is prepared ahead. A batch is the same for any number of threads, and so is
    the step at which an error is raised: a failure on a thread counts when its batch is taken.

    Attributes:
        failures: reasons by uid, of the objects that could not be read so far.
        waited: seconds spent in ``take``, until it is set to 0.
        model: configuration of the model.
    """

    def __init__(
        self,
        data: TrainingData,
        config: TrainConfig,
        world: World,
        novel: Callable[[int], int] = lambda number: 0,
        last: int | None = None,
    ) -> None:
        """Create the thread pool; nothing is prepared yet.

        Args:
            data: training data.
            config: options of the run.
            world: this process; its part of each batch is moved to its device.
            novel: number of novel views of a batch, by its number. It is called when the batch is
                begun, so a schedule by the clock is ``workers`` batches behind.
            last: number of batches of the run; None means no limit.
        """
        self.data, self.config, self.model = data, config, config.model_config()
        self.world, self.novel, self.last = world, novel, last
        self.failures: dict[str, str] = {}
        self.waited = 0.0
        self._procedural: Pool | None = None  # started with the first batch
        self._stream: Iterator[dict[str, Any] | Unreachable] | None = None  # begins with a batch
        self._reading = Lock()
        self._copies: torch.cuda.Stream | None = None
        self._order: tuple[int, np.ndarray] = (-1, np.empty(0, int))  # epoch and its permutation
        self.workers = config.views.threads(world.device.type)
        self._pool = ThreadPoolExecutor(self.workers, thread_name_prefix="batches")
        self._waiting: dict[int, Future[Prepared]] = {}

    def take(self, number: int) -> Batch:
        """Wait for the ``number``-th batch, on the device, and start the next ones.

        Raises:
            UserError: more than half of the objects, or 100 in a row, cannot be read.
        """
        began, end = time.perf_counter(), number + self.workers + 1
        self._begin(number)
        for following in range(number, end if self.last is None else min(end, self.last)):
            if following not in self._waiting:
                # Threads take work in this order. When one reaches the join, others have begun all
                # its samples, so it never waits for a thread that waits for it.
                novel = self.novel(following)
                parts = [
                    self._pool.submit(self.prepare, n, novel) for n in self._numbers(following)
                ]
                self._waiting[following] = self._pool.submit(self._join_samples, parts)
        prepared = self._waiting.pop(number).result()
        batch = self._record_failures(prepared)
        if prepared.copied is not None:
            stream = torch.cuda.current_stream(self.world.device)
            stream.wait_event(prepared.copied)
            batch.used_on(stream)
        self.waited += time.perf_counter() - began
        return batch

    def close(self) -> None:
        """Cancel the waiting samples; each thread finishes its current one."""
        if self._procedural is not None:
            self._procedural.close()
        self._pool.shutdown(cancel_futures=True)

    def prepare(self, number: int, novel: int) -> Prepared:
        """Load the ``number``-th sample, on a thread; after an unreadable object the next one."""
        views, seed = self.config.views, self.config.run.seed
        rng = np.random.default_rng([seed, 2, number])
        background = torch.ones(3) if views.background == "white" else torch.zeros(3)
        if views.background == "random":
            background = torch.from_numpy(rng.random(3, dtype=np.float32))
        # A separate generator, so that runs without augmentation stay the same.
        chance = np.random.default_rng([seed, 3, number])
        front = chance.random() < views.front_fraction
        pick = int(chance.integers(2**32))
        change = None
        if views.flip or views.color_jitter:
            change = draw_change(chance, views.flip, views.color_jitter)
        surfaces = self.config.loss.depth_weight > 0

        def loaded(dataset: ViewDataset, index: int) -> Batch:
            first = None
            if front:
                fronts = front_views(dataset.files(index).camera_to_world)
                first = fronts[pick % len(fronts)]
            chosen = choose_views(dataset.num_views(index), novel, first, rng)
            about = (views.size, self.model, background, change, surfaces)
            return load_sample(dataset, index, chosen, *about)

        sample = self._procedural_sample(number)
        if sample is not None:
            assert self._procedural is not None
            return Prepared(loaded(self._procedural.take(sample), 0), [])
        failed: list[tuple[str, str]] = []
        for attempt in range(_TRIES):
            dataset, index = self.data.train, 0
            if self._stream is not None:
                with self._reading:
                    taken = next(self._stream)
                if isinstance(taken, Unreachable):  # no fault of the object
                    raise taken
                dataset = dataset_of(taken)
            else:
                index = self._object(number + attempt)
            try:
                return Prepared(loaded(dataset, index), failed)
            except EXPECTED as error:
                failed.append((dataset.uids[index], first_line(error)))
        return Prepared(None, failed)

    def _procedural_sample(self, number: int) -> int | None:
        """Number among this process's procedural samples; None if the sample is of a dataset."""
        fraction, size = self.config.views.procedural, self.config.views.batch_size
        batch, position = number // size // self.world.size, number % size
        local = batch * size + position  # among the samples of this process
        before, after = math.floor(local * fraction), math.floor((local + 1) * fraction)
        return before if after > before else None

    def _begin(self, number: int) -> None:
        """Start procedural objects and the stream of shards at the ``number``-th batch, once."""
        views, world = self.config.views, self.world
        if self.data.shards is not None and self._stream is None:
            # A resumed run begins with another order.
            order = np.random.SeedSequence([self.config.run.seed, 4, number])
            self._stream = self.data.shards.stream(int(order.generate_state(1)[0]))
        if not views.procedural or self._procedural is not None:
            return
        images = Settings(
            views=POOL_VIEWS,
            size=max(views.size, self.model.image_size),
            seed=self.config.run.seed,
            depth=self.config.loss.depth_weight > 0,
            fronts=POOL_VIEWS // 3,
            light="randomized",
            up="y",
            **VARIED_CAMERAS,
        )
        first = math.floor(number * views.batch_size * views.procedural)
        self._procedural = Pool(images, first, world.rank, world.size)

    def _object(self, place: int) -> int:
        """Return the object of a place in the order; each epoch has its own permutation."""
        objects = self.data.objects
        epoch, position = divmod(place, len(objects))
        known, order = self._order  # read both at once: other threads replace them
        if known != epoch:
            rng = np.random.default_rng([self.config.run.seed, 1, epoch])
            order = rng.permutation(len(objects))
            self._order = epoch, order
        return objects[order[position]]

    def _numbers(self, number: int) -> range:
        """Samples of the ``number``-th batch for this process."""
        size = self.config.views.batch_size
        first = (number * self.world.size + self.world.rank) * size
        return range(first, first + size)

    def _join_samples(self, parts: list[Future[Prepared]]) -> Prepared:
        samples = [part.result() for part in parts]
        failures = [failure for sample in samples for failure in sample.failures]
        good = [sample.batch for sample in samples if sample.batch is not None]
        if len(good) < len(samples):
            return Prepared(None, failures)
        batch = join(good, self.model)
        if self.world.device.type != "cuda":
            return Prepared(batch, failures)
        if self._copies is None:
            self._copies = torch.cuda.Stream(self.world.device)
        with torch.cuda.stream(self._copies):  # in parallel with the steps
            batch = batch.for_gpu().to(self.world.device)
            return Prepared(batch, failures, self._copies.record_event())

    def _record_failures(self, prepared: Prepared) -> Batch:
        """Record failures in the order of the run, and return the batch."""
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
    part: FixedObjects, config: GambaConfig, size: int, failures: dict[str, str]
) -> Iterator[Batch]:
    """Yield the batches of a validation: one object each, fixed views, on white.

    View 0 is the input, followed by ``VAL_VIEWS`` others, evenly spaced. An unreadable object is
    skipped, with its reason in ``failures``.
    """
    dataset = part.dataset
    for index in part.objects:
        try:
            novel = evenly(range(1, dataset.num_views(index)), VAL_VIEWS)
            batch = load_sample(dataset, index, [0, *novel], size, config, torch.ones(3))
        except EXPECTED as error:
            failures[dataset.uids[index]] = first_line(error)
            continue
        yield batch
