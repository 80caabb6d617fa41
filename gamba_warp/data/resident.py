"""A dataset whose pictures lie decoded on one device."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np
import torch
from torch import Tensor

from ..batch import EXPECTED, progress_bar
from ..errors import UserError
from .dataset import ViewDataset
from .layouts import ObjectFiles
from .prefetch import Prefetcher

_Pictures = tuple[np.ndarray, np.ndarray]  # those of ViewDataset.pictures


class ResidentViews(ViewDataset):
    """As another dataset, but pictures of some sizes lie on a device, with 8 bits a channel.

    ``load`` gives them on that device, and cameras and depths on the CPU. What it gives is the same
    to the bit: the pictures are divided on the device as they are on the CPU.
    """

    def __init__(
        self,
        dataset: ViewDataset,
        objects: Sequence[int],
        sizes: Sequence[int],
        device: torch.device,
        workers: int = 1,
    ) -> None:
        """Decodes the pictures, with a progress bar.

        Args:
            dataset: where they come from.
            objects: indices of those objects that are kept. One that cannot be read is left to
                ``dataset``, which raises its error when it is loaded.
            sizes: heights, pixels.
            device: where they are kept.
            workers: number of threads that decode.

        Raises:
            UserError: the device, a GPU, has no room for them.
        """
        super().__init__({}, dataset.layout, False, dataset.split_version, dataset.packed_size)
        self.uids, self._dataset = dataset.uids, dataset
        # Its own tensor: a GPU would divide by a plain number by multiplying with its inverse,
        # whose last bit is another.
        self._most = torch.tensor(255.0, device=device)
        self._kept: dict[tuple[str, int], tuple[Tensor, np.ndarray]] = {}
        self._check_room(objects, sizes, device)
        self._fill(objects, sizes, device, workers)

    def _check_room(
        self, objects: Sequence[int], sizes: Sequence[int], device: torch.device
    ) -> None:
        if device.type != "cuda":
            return
        views = sum(self._dataset.num_views(index) for index in objects)
        needed = sum(4 * views * size**2 for size in sizes)
        free, _ = torch.cuda.mem_get_info(device)
        if needed > free:
            raise UserError(
                f"--cache-device: {views} views take {needed / 2**30:.1f} GB, of which the GPU has "
                f"{free / 2**30:.1f} free"
            )

    def _fill(
        self, objects: Sequence[int], sizes: Sequence[int], device: torch.device, workers: int
    ) -> None:
        threads: Prefetcher[_Pictures, _Pictures] = Prefetcher(workers)
        keys = [(self.uids[index], size) for index in objects for size in sizes]
        try:
            for number, key in enumerate(progress_bar(keys, desc="decoding", unit="object")):
                for uid, size in keys[number : number + workers + 1]:
                    if (uid, size) not in threads:
                        part = partial(self._dataset.pictures, uid, None, size)
                        threads.submit((uid, size), [part], lambda made: made[0])
                try:
                    pixels, Ks = threads.take(key)
                except EXPECTED:
                    continue
                self._kept[key] = torch.from_numpy(pixels).to(device), Ks
        finally:
            threads.close()

    def files(self, index: int | str) -> ObjectFiles:
        """Those of the other dataset."""
        return self._dataset.files(index)

    def _uid(self, index: int | str) -> str:
        return self._dataset._uid(index)

    def _images(
        self, uid: str, views: Sequence[int] | None, size: int | None
    ) -> tuple[Tensor, np.ndarray]:
        kept = None if size is None else self._kept.get((uid, size))
        if kept is None:
            return self._dataset._images(uid, views, size)
        pixels, Ks = kept
        wanted = list(range(len(Ks))) if views is None else [int(v) for v in views]
        if not wanted or not all(0 <= v < len(Ks) for v in wanted):
            return self._dataset._images(uid, views, size)  # it says what is wrong
        chosen = pixels[torch.tensor(wanted, device=pixels.device)]
        return chosen.float() / self._most, Ks[wanted]
