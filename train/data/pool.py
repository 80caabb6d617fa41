"""Made objects for a training: other processes make and render them while the model trains.

The pool has ``SLOTS`` slots. A round takes one sample from each slot, in an order of its own, and
an object stays in its slot for ``uses`` rounds; the slots change their objects in turn, so that
every round needs as many new ones. Which object a sample shows is a function of its number alone,
so a resumed run goes on with the same ones.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from itertools import count, islice

import numpy as np
import torch

from gamba_warp.data.dataset import ViewDataset
from gamba_warp.data.layouts import ObjectFiles, Stored
from gamba_warp.devices import quiet_warp
from gamba_warp.errors import UserError
from gamba_warp.untrusted.children import Failed, end_idle, run_each
from gamba_warp.versions import NEEDS, require

from .render import DEPTH_UNIT, Views, draw_views
from .settings import Settings

SLOTS = 64  # objects that are in use at a time; one has 2 MB at 12 views of 128² with depth
AHEAD = 8  # objects that are ready before they are needed


@dataclass(frozen=True)
class PoolOptions:
    """Options of a pool.

    Attributes:
        seed: of all objects, their cameras and lights.
        rank: of this process among those that train together; each has objects of its own.
        world: number of these processes.
        uses: samples of an object.
        workers: number of processes that make and render.
        views: options of the pictures.
    """

    seed: int
    rank: int
    world: int
    uses: int
    workers: int
    views: Settings


class Pool:
    """Made objects by the number of their sample; threads may take them in about that order."""

    def __init__(self, options: PoolOptions, first: int) -> None:
        """Starts to make the objects of the samples from ``first`` on.

        Args:
            options: the pool's options.
            first: number of the first sample that is taken.

        Raises:
            ModuleNotFoundError: what makes objects needs a library that is not installed.
        """
        require(*NEEDS["data made"])
        self.options = options
        self._first = first
        self._ready: dict[int, ViewDataset] = {}
        self._untaken: set[int] = set()  # objects that are ready and were never taken
        self._failure: str | None = None  # the reason why no more objects come
        self._closed = False
        self._changed = threading.Condition()
        self._maker = threading.Thread(target=self._make, name="made objects", daemon=True)
        self._maker.start()

    def take(self, sample: int) -> ViewDataset:
        """Waits for the object of a sample; returns it as a dataset of one object.

        Raises:
            UserError: the object cannot be made, or its process died twice.
        """
        number = self._object(sample)
        with self._changed:
            self._changed.wait_for(lambda: number in self._ready or self._failure or self._closed)
            if number not in self._ready:
                raise UserError(self._failure or "the pool of made objects is closed")
            if number in self._untaken:
                self._untaken.remove(number)
                oldest = sample // SLOTS - 1  # other threads may still be in the round before
                for old in self._ready.keys() - self._untaken:
                    if self._last_round(old) < oldest:
                        del self._ready[old]
                self._changed.notify_all()
            return self._ready[number]

    def close(self) -> None:
        """Ends the processes; the object that each makes is lost."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._maker.join()
        end_idle()

    def _object(self, sample: int) -> int:
        """Number of the object that a sample shows."""
        turn, position = divmod(sample, SLOTS)
        slot = int(_order(self.options.seed, turn)[position])
        generation = (turn + slot % self.options.uses) // self.options.uses
        return (generation * SLOTS + slot) * self.options.world + self.options.rank

    def _last_round(self, number: int) -> int:
        """Last round in which samples show an object."""
        generation, slot = divmod(number // self.options.world, SLOTS)
        uses = self.options.uses
        return (generation + 1) * uses - slot % uses - 1

    def _needed(self) -> Iterator[int]:
        """Numbers of all objects, each once, in the order in which samples first show them."""
        latest: dict[int, int] = {}
        for sample in count(self._first):
            number = self._object(sample)
            slot = number // self.options.world % SLOTS
            if latest.get(slot) != number:
                latest[slot] = number
                yield number

    def _make(self) -> None:
        """Makes objects until the pool is closed or one fails; runs in a thread of its own."""
        needed = self._needed()
        try:
            while not self._closed:
                numbers = [*islice(needed, self.options.workers)]
                if failed := self._make_all(numbers):
                    failed = self._make_all([*failed])  # a process may die of other work's memory
                if failed and not self._closed:
                    number, reason = failed.popitem()
                    raise UserError(f"made object {number}: {reason}")
        except Exception as error:  # ``take`` raises it in the caller's thread
            with self._changed:
                self._failure = str(error)
                self._changed.notify_all()

    def _make_all(self, numbers: Sequence[int]) -> dict[int, str]:
        """Makes these objects; returns reasons by number, of those that failed."""
        failed = {}
        made = partial(_made, seed=self.options.seed, settings=self.options.views)
        for index, result in run_each(made, numbers, workers=self.options.workers):
            if isinstance(result, Failed):
                failed[numbers[index]] = result.reason
                continue
            uid = f"made-{self.options.seed}-{numbers[index]}"
            dataset = ViewDataset({uid: partial(_files, uid, result)}, "made", cache=False)
            with self._changed:
                self._ready[numbers[index]] = dataset
                self._untaken.add(numbers[index])
                self._changed.notify_all()
                self._changed.wait_for(lambda: len(self._untaken) < AHEAD or self._closed)
                if self._closed:
                    break
        return failed


@lru_cache(maxsize=8)
def _order(seed: int, turn: int) -> np.ndarray:
    """The slots in the order of a round."""
    return np.random.default_rng([seed, 5, turn]).permutation(SLOTS)


def _made(number: int, seed: int, settings: Settings) -> Views:
    """In a child process: an object's views."""
    from .made import make_object  # needs libraries that a training without made objects does not

    quiet_warp()
    torch.set_num_threads(1)
    return draw_views(make_object(np.random.default_rng([seed, number])), str(number), settings)


class _Picture(Stored):
    """A picture in memory."""

    def __init__(self, values: np.ndarray) -> None:
        self.values = values

    def read(self) -> np.ndarray:
        return self.values


def _files(uid: str, views: Views) -> ObjectFiles:
    number, size = views.images.shape[:2]
    near, far = (
        None if steps is None else [_Picture(each.astype(np.float32)) for each in steps]
        for steps in (views.depths, views.backs)
    )
    return ObjectFiles(
        images=[_Picture(image) for image in views.images],
        camera_to_world=views.poses,
        Ks=np.broadcast_to(views.K, (number, 3, 3)),
        sizes=[(size, size)] * number,
        depths=near,
        backs=far,
        depth_unit=DEPTH_UNIT,
        name=uid,
    )
