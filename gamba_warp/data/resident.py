"""A dataset whose pictures lie decoded on one device."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress

import numpy as np
import torch
from torch import Tensor

from ..batch import EXPECTED, progress_bar
from ..errors import UserError
from .dataset import ViewDataset


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
        self.__dict__ |= vars(dataset)  # its files are read once for both
        # Its own tensor: a GPU would divide by a plain number by multiplying with its inverse,
        # whose last bit is another.
        self._most = torch.tensor(255.0, device=device)
        self._kept: dict[tuple[str, int], tuple[Tensor, np.ndarray]] = {}
        if device.type == "cuda":
            views = sum(dataset.num_views(index) for index in objects)
            needed = sum(4 * views * size**2 for size in sizes)
            free, _ = torch.cuda.mem_get_info(device)
            if needed > free:
                raise UserError(
                    f"--cache-device: {views} views take {needed / 2**30:.1f} GB, of which the GPU "
                    f"has {free / 2**30:.1f} free"
                )

        def keep(key: tuple[str, int]) -> None:
            with suppress(*EXPECTED):
                pixels, Ks = dataset.pictures(key[0], None, key[1])
                self._kept[key] = torch.from_numpy(pixels).to(device), Ks

        keys = [(self.uids[index], size) for index in objects for size in sizes]
        with ThreadPoolExecutor(workers) as pool:
            done = pool.map(keep, keys)
            for _ in progress_bar(done, total=len(keys), desc="decoding", unit="object"):
                pass

    def _images(
        self, uid: str, views: Sequence[int] | None, size: int | None
    ) -> tuple[Tensor, np.ndarray]:
        kept = None if size is None else self._kept.get((uid, size))
        if kept is None:
            return super()._images(uid, views, size)
        pixels, Ks = kept
        wanted = list(range(len(Ks))) if views is None else [int(v) for v in views]
        if not wanted or not all(0 <= v < len(Ks) for v in wanted):
            return super()._images(uid, views, size)  # it says what is wrong
        chosen = pixels[torch.tensor(wanted, device=pixels.device)]
        return chosen.float() / self._most, Ks[wanted]
