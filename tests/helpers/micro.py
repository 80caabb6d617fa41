"""A tiny dataset of clouds, drawn by our rasterizer, and options that train in milliseconds."""

import json
from dataclasses import replace
from pathlib import Path

import torch
from safetensors.torch import load_file

from gamba_warp.cameras import Cameras, intrinsics, orbit
from gamba_warp.gaussians import Gaussians
from gamba_warp.train import checkpoint
from gamba_warp.train.batches import Batch, Batches
from gamba_warp.train.config import TrainConfig
from gamba_warp.train.ddp import World
from gamba_warp.train.loop import train

from .views import around, straight, write_views

checkpoint.KEPT = 9  # tests compare the checkpoints of all steps of short runs
ALONE = World(0, 1, torch.device("cpu"))
SIZE = 16
VIEWS = 6
# One narrow block and 64 Gaussians.
NARROW = f"image_size={SIZE} patch_size=4 width=16 depth=1 state_size=4 scale_init=0.06"
MODEL = tuple(NARROW.split())


def cloud(seed: int, num: int = 40) -> Gaussians:
    """Make Gaussians of one hue in an off-centre ball."""
    rng = torch.Generator().manual_seed(seed)
    centre = 0.1 * torch.randn(3, generator=rng)
    hue = torch.rand(3, generator=rng)
    return Gaussians(
        means=centre + 0.1 * torch.randn(num, 3, generator=rng),
        quats=None,
        scales=torch.full((num, 3), 0.06),
        opacities=torch.full((num,), 0.9),
        colors=(hue + 0.1 * torch.randn(num, 3, generator=rng)).clamp(0, 1),
    )


def views_around(count: int, width: int = 32, height: int = 32) -> Cameras:
    """Make cameras on a ring of changing height about the origin."""
    azimuths = torch.arange(count) * (360.0 / count)
    elevations = 25.0 * torch.cos(torch.arange(count) * 2.0)
    viewmats = torch.cat([orbit(a[None], e.item(), 1.8) for a, e in zip(azimuths, elevations)])
    return Cameras(viewmats, intrinsics(width, height).expand(count, 3, 3), width, height)


def write_object(folder: Path, gaussians: Gaussians, views: int = VIEWS) -> None:
    """Write one object in the transforms.json layout."""
    cameras = around(torch.arange(views) * (360.0 / views), 15.0, 1.8, SIZE)
    write_views(folder, straight(gaussians, cameras).clamp(0, 1), cameras)


def write_dataset(root: Path, objects: int = 3) -> Path:
    """Write a dataset of ``objects`` clouds, of which the last is held out."""
    uids = [f"cloud{chr(ord('a') + i)}" for i in range(objects)]
    for i, uid in enumerate(uids):
        write_object(root / uid, cloud(i))
    write_split(root, train=uids[:-1], val=uids[-1:])
    return root


def write_split(data: Path, **parts: list[str]) -> None:
    """Writes ``split.json``; parts that are not given are empty."""
    empty: dict = {"version": 1, "train": [], "val": [], "test": []}
    (data / "split.json").write_text(json.dumps(empty | parts))


def options(data: Path, out: Path, model: tuple[str, ...] = MODEL, **groups: dict) -> TrainConfig:
    """Make quick options; ``groups`` changes them, for example ``optim={"lr": 1.0}``."""
    config = TrainConfig(data=data, preset="tiny", set=model)
    quick = {
        "length": {"steps": 6},
        "views": {"batch_size": 2, "size": SIZE, "views_per_object": 2},
        "loss": {"lpips": "off"},
        "optim": {"warmup_steps": 1},
        "run": {"out": out, "device": "cpu", "val_every": 0, "log_every": 1},
    }
    for name in quick:
        changes = {**quick[name], **groups.get(name, {})}
        config = replace(config, **{name: replace(getattr(config, name), **changes)})
    return config


def run(data: Path, out: Path, model: tuple[str, ...] = MODEL, **groups: dict) -> int:
    """Train with ``options`` in this process; return the exit code."""
    return train(options(data, out, model, **groups), ALONE)


def take(source: Batches, number: int) -> Batch:
    """The batch of a number, with none prepared ahead."""
    source.last = number + 1
    return source.take(number)


def same_weights(a: Path, b: Path) -> bool:
    """True if two files of weights hold bit-identical tensors."""
    one, other = load_file(a), load_file(b)
    return one.keys() == other.keys() and all(torch.equal(one[n], other[n]) for n in one)


def lines(out: Path, event: str) -> list[dict]:
    """The lines of one kind in a run's log."""
    records = [json.loads(line) for line in (out / "log.jsonl").read_text().splitlines()]
    return [record for record in records if record["event"] == event]
