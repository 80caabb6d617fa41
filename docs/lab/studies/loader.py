"""Benchmark case of the training's data: batches alone, from files, from memory and from shards."""

from __future__ import annotations

import tempfile
import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import torch

from gamba_warp.data.dataset import ViewDataset, open_dataset
from gamba_warp.kernels.bench.core.case import Case, Settings, Variant
from gamba_warp.train.batches import Batches, TrainingData
from gamba_warp.train.config import DataConfig, TrainConfig
from gamba_warp.train.ddp import World
from gamba_warp.train.sources.pack import PackSettings, write_pack

from .made_up import write_views

_BATCH, _NOVEL, _SIZE = 4, 3, 128  # as in the cases of a step
_VIEWS, _OBJECTS = 24, 24  # of a made-up folder, and used of another
_BATCHES = {"quick": 2, "normal": 24, "full": 96}
_WORKERS = 2


def cases(settings: Settings) -> list[Case]:
    """Return the case of the loader."""
    text = (
        f"Batches of {_BATCH} objects in {_NOVEL + 1} views of {_SIZE}², half of them mirrored and "
        f"three in ten recoloured, prepared by {_WORKERS} threads and taken at once, from the "
        "first one on. Views are those of --data, or made up; up to "
        f"{_OBJECTS} objects, so that all lie in the system's own cache of files. "
        "Pictures are decoded, or were decoded before, into memory or onto the device, or resized "
        "into shards before. "
        "There is no oracle: a test holds the batches to be the same to the bit."
    )
    return [Case(op="loader", name="views", text=text, build=partial(_build, settings), axis=None)]


@dataclass
class _Loader:
    """Batches of a dataset; keeps ``folder`` alive."""

    dataset: ViewDataset
    objects: list[int]
    world: World
    batches: int
    folder: tempfile.TemporaryDirectory

    def run(self) -> None:
        """Take all batches; timed."""
        views = DataConfig(size=_SIZE, mirror=0.5, recolor=0.3, workers=_WORKERS)
        config = TrainConfig(data=Path(self.folder.name), preset="rays", views=views)
        data = TrainingData(self.dataset, self.objects, batch_size=_BATCH)
        batches = Batches(data, config, self.world, lambda _: _NOVEL, self.batches)
        try:
            for number in range(self.batches):
                batches.take(number)
        finally:
            batches.close()
        if self.world.device.type == "cuda":
            torch.cuda.synchronize(self.world.device)

    def work(self) -> dict[str, float]:
        """Count the samples and the process time of each, beside other work."""
        began = time.process_time()
        self.run()
        used, count = time.process_time() - began, _BATCH * self.batches
        return {"samples": count, "cpu_ms_per_sample": 1e3 * used / count}


def _build(settings: Settings) -> list[Variant]:
    folder = tempfile.TemporaryDirectory(prefix="gamba-bench-")
    root = Path(folder.name)
    data = getattr(settings, "data", None)
    if data is None:
        data = root / "views"
        write_views(data, 4 if settings.level == "quick" else _OBJECTS, _VIEWS, _SIZE)
    files, cached = open_dataset(data), open_dataset(data, cache=True)
    objects = list(range(min(_OBJECTS, len(files))))
    for index in objects:
        cached.pictures(index, None, _SIZE)
    write_pack(data, root / "shards", PackSettings(_SIZE), _WORKERS, len(objects))
    shards, resident = open_dataset(root / "shards"), open_dataset(root / "shards")
    resident.preload(objects, [_SIZE], settings.device, _WORKERS)
    made: dict[str, ViewDataset] = {"files": files, "files, --cache": cached}
    made |= {"shards": shards, "shards, --cache-device": resident}
    world, batches = World(0, 1, settings.device), _BATCHES[settings.level]
    variants = []
    for name, dataset in made.items():
        loader = _Loader(dataset, objects, world, batches, folder)
        variants.append(
            Variant(
                name=name,
                run=loader.run,
                check=None,
                default=name == "files",
                rounds=9,
                parameters={"B": _BATCH, "views": _NOVEL + 1, "side": _SIZE},
                work=loader.work,
            )
        )
    return variants
