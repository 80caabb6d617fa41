"""Order of the training objects by shards, as WebDataset reads them."""

from __future__ import annotations

import random
from collections import defaultdict
from collections.abc import Sequence

import numpy as np

from gamba_warp.errors import UserError
from gamba_warp.versions import require


class ShardOrder:
    """Order of the objects of this process: whole shards, split by process and mixed by a buffer.

    The shards of an epoch are shuffled; ``webdataset`` splits them by process, and mixes the
    objects of this process through a buffer. All of it follows from the seed and the epoch, so a
    resumed run continues with the same objects. All processes take the same number of objects in an
    epoch: one with fewer repeats some.

    Attributes:
        length: objects of this process in an epoch.
    """

    def __init__(self, shards: Sequence[str], buffer: int, seed: int, processes: int) -> None:
        """Collect the objects of each shard.

        Args:
            shards: name of the shard of each object.
            buffer: number of objects that are mixed at a time.
            seed: of the run.
            processes: number of the processes of the run.

        Raises:
            UserError: there are fewer shards than processes.
            ModuleNotFoundError: ``webdataset`` is not installed.
        """
        require("webdataset")
        self._inside: dict[str, list[int]] = defaultdict(list)
        for position, name in enumerate(shards):
            self._inside[name].append(position)
        if len(self._inside) < processes:
            count = len(self._inside)
            raise UserError(
                f"--sampler shards: {processes} processes need at least as many shards, there "
                f"{'are' if count > 1 else 'is'} {count} (gamba data pack --shard-mb)"
            )
        self._buffer, self._seed = buffer, seed
        self.length = -(-len(shards) // processes)

    def __call__(self, epoch: int) -> np.ndarray:
        """Return the positions of an epoch among the objects, ``[length]`` int."""
        from webdataset.filters import shuffle
        from webdataset.shardlists import SimpleShardList, split_by_node

        first, second = np.random.SeedSequence([self._seed, 4, epoch]).generate_state(2).tolist()
        listed = SimpleShardList(sorted(self._inside), seed=first)
        own = [item["url"] for item in split_by_node(listed)]
        stream = (position for name in own for position in self._inside[name])
        mixed = shuffle(self._buffer, initial=self._buffer, rng=random.Random(second))(stream)
        return np.resize(np.fromiter(mixed, int), self.length)
