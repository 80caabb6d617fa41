"""Procedural objects for training: other processes make and render them while the model trains.

The pool has ``SLOTS`` slots. A round takes one sample from each slot, in its own order, and an
object stays in its slot for ``USES`` rounds. The slots change their objects at staggered rounds, so
every round needs the same number of new ones. The object of a sample is a function of the sample's
number, so a resumed run continues with the same objects.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from functools import lru_cache, partial
from itertools import count

import numpy as np
import torch

from gamba_warp.data.dataset import ViewDataset
from gamba_warp.data.layouts import MemoryImage, ObjectFiles
from gamba_warp.devices import quiet_warp
from gamba_warp.errors import UserError
from gamba_warp.untrusted.children import Failed, end_idle, run_each
from gamba_warp.versions import PROCEDURAL, require

from .render import DEPTH_UNIT, Views, draw_views
from .settings import Settings

SLOTS = 64  # objects in use at a time; one has 2 MB at 12 views of 128² with depth
AHEAD = 8  # objects prepared ahead
USES = 16  # samples of an object
VIEWS = 12  # of an object


class Pool:
    """Procedural objects by sample number; threads may take them in roughly that order."""

    def __init__(self, settings: Settings, first: int, rank: int = 0, world: int = 1) -> None:
        """Start making the objects of the samples from ``first`` on.

        Args:
            settings: of the images; its seed is that of the objects, their cameras and lights.
            first: number of the first sample.
            rank: rank of this training process; each has its own objects.
            world: number of training processes.

        Raises:
            ModuleNotFoundError: a library for making objects is not installed.
        """
        require(*PROCEDURAL)
        self.settings, self.rank, self.world = settings, rank, world
        self._first = first
        self._ready: dict[int, ViewDataset] = {}
        self._untaken: set[int] = set()  # objects that are ready and were never taken
        self._failure: str | None = None  # reason why the pool has stopped
        self._closed = False
        self._changed = threading.Condition()
        self._maker = threading.Thread(target=self._make, name="procedural objects", daemon=True)
        self._maker.start()

    def take(self, sample: int) -> ViewDataset:
        """Wait for the object of a sample; return it as a dataset of one object.

        Raises:
            UserError: the object cannot be made, or its process died twice.
        """
        number = self._object(sample)
        with self._changed:
            self._changed.wait_for(lambda: number in self._ready or self._failure or self._closed)
            if number not in self._ready:
                raise UserError(self._failure or "the pool of procedural objects is closed")
            if number in self._untaken:
                self._untaken.remove(number)
                oldest = sample // SLOTS - 1  # other threads may still be in the round before
                for old in self._ready.keys() - self._untaken:
                    generation, slot = divmod(old // self.world, SLOTS)
                    if (generation + 1) * USES - slot % USES - 1 < oldest:  # its last round
                        del self._ready[old]
                self._changed.notify_all()
            return self._ready[number]

    def close(self) -> None:
        """End the processes and discard the objects in progress."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._maker.join()
        end_idle()

    def _object(self, sample: int) -> int:
        """Number of the object of a sample."""
        round_number, position = divmod(sample, SLOTS)
        slot = int(_order(self.settings.seed, round_number)[position])
        generation = (round_number + slot % USES) // USES
        return (generation * SLOTS + slot) * self.world + self.rank

    def _needed(self) -> Iterator[int]:
        """Yield the numbers of all objects, each once, in the order of first use."""
        latest: dict[int, int] = {}
        for sample in count(self._first):
            number = self._object(sample)
            slot = number // self.world % SLOTS
            if latest.get(slot) != number:
                latest[slot] = number
                yield number

    def _make(self) -> None:
        """Make objects until the pool is closed or one fails; runs in its own thread."""
        try:
            for number in self._needed():
                if reason := self._make_one(number):
                    reason = self._make_one(number)  # memory may have been short for a moment
                if self._closed:
                    return
                if reason:
                    raise UserError(f"procedural object {number}: {reason}")
        except Exception as error:  # ``take`` raises it in the caller's thread
            with self._changed:
                self._failure = str(error)
                self._changed.notify_all()

    def _make_one(self, number: int) -> str | None:
        """Make an object in another process; return the reason of a failure."""
        make = partial(_make_views, settings=self.settings)
        _, result = next(iter(run_each(make, [number], workers=1)))
        if isinstance(result, Failed):
            return result.reason
        uid = f"procedural-{self.settings.seed}-{number}"
        dataset = ViewDataset({uid: partial(_files, result)}, "procedural", cache=False)
        with self._changed:
            self._ready[number] = dataset
            self._untaken.add(number)
            self._changed.notify_all()
            self._changed.wait_for(lambda: len(self._untaken) < AHEAD or self._closed)
        return None


@lru_cache(maxsize=8)
def _order(seed: int, round_number: int) -> np.ndarray:
    """Slots in the order of a round."""
    return np.random.default_rng([seed, 5, round_number]).permutation(SLOTS)


def _make_views(number: int, settings: Settings) -> Views:
    """Make and render an object, in a child process."""
    # It needs libraries that training without procedural objects does not.
    from .procedural import make_object

    quiet_warp()
    torch.set_num_threads(1)
    mesh = make_object(np.random.default_rng([settings.seed, number]))
    return draw_views(mesh, str(number), settings)


def _files(views: Views, uid: str) -> ObjectFiles:
    number, size = views.images.shape[:2]
    near, far = (
        None if steps is None else [MemoryImage(uid, each.astype(np.float32)) for each in steps]
        for steps in (views.depths, views.backs)
    )
    return ObjectFiles(
        images=[MemoryImage(uid, image) for image in views.images],
        camera_to_world=views.poses,
        Ks=np.broadcast_to(views.K, (number, 3, 3)),
        sizes=[(size, size)] * number,
        depths=near,
        backs=far,
        depth_unit=DEPTH_UNIT,
        name=uid,
    )
