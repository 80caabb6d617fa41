"""Benchmark cases of growth: time and memory of scan and rasterizer over each of their sizes.

One size of a case grows, the others stay. Beside each figure stands the work that it should grow
with: elements of the states for the scan, pairs of Gaussians and tiles plus the Gaussians of every
view for the rasterizer.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import partial

import torch
from torch import Tensor

from gamba_warp.kernels.bench.cases.raster_scene import Scene, orbit_cameras, shell
from gamba_warp.kernels.bench.cases.scan_problem import make_inputs, scan_problem
from gamba_warp.kernels.bench.core.case import BOTH, Case, Error, Settings, Variant
from gamba_warp.kernels.bench.core.measure import peak_bytes

from .slopes import GROWTH

SCAN, RASTER = "growth-scan", "growth-raster"
_TOKENS = 512  # first tokens that the scan's oracle sees
_DENSE = 16384  # of more Gaussians the oracle sees those near its crop

# Growing sizes of a case by level; constant ones are in ``_SCAN_BASE`` and ``_RASTER_BASE``.
_SCAN_SIZES = {
    "quick": {"L": (256, 1024), "D": (16, 64), "N": (4, 16), "B": (1, 2)},
    "normal": {
        "L": (1024, 4096, 16384, 65536),
        "D": (64, 256, 1024, 4096),
        "N": (4, 16, 64, 256),
        "B": (1, 4, 16, 64),
    },
    "full": {
        "L": tuple(2**k for k in range(10, 18)),
        "D": tuple(2**k for k in range(4, 13)),
        "N": tuple(2**k for k in range(9)),
        "B": tuple(2**k for k in range(7)),
    },
}
_SCAN_BASE = {
    "quick": {"L": 256, "D": 32, "N": 16, "B": 1},
    "normal": {"L": 2048, "D": 256, "N": 16, "B": 1},
}
_WIDTH_OF_LENGTHS = 512  # channels where the tokens grow: enough that both cores have work
_RASTER_SIZES = {
    "quick": {"Gaussians": (256, 1024), "pixels": (64, 128), "views": (1, 2)},
    "normal": {
        "Gaussians": (4096, 16384, 65536, 262144),
        "pixels": (128, 256, 512, 1024),
        "views": (1, 2, 4, 8, 16),
    },
    "full": {
        "Gaussians": (4096, 16384, 65536, 262144, 1048576),
        "pixels": (128, 256, 512, 1024, 2048),
        "views": (1, 2, 4, 8, 16, 32),
    },
}
_RASTER_BASE = {"quick": (1024, 64, 64), "normal": (16384, 512, 256)}  # count, side, side of views


def cases(settings: Settings) -> list[Case]:
    """Return the cases: scan over L, D, N and B, rasterizer over Gaussians, pixels and views."""
    scan = {
        "L": f"Time and memory over the number of tokens L, {_WIDTH_OF_LENGTHS} channels.",
        "D": "Time and memory over the number of channels D.",
        "N": "Time and memory over the number of states N of a channel.",
        "B": "Time and memory over the number of sequences B.",
    }
    raster = {
        "Gaussians": "Time and memory over the number of Gaussians, which get smaller so that they "
        "cover the same area.",
        "pixels": "Time and memory over the number of pixels of a picture.",
        "views": "Time and memory over the number of views in one call.",
    }
    return [
        Case(op, name, text, partial(build, settings, name), GROWTH + name)
        for op, build, texts in ((SCAN, _scans, scan), (RASTER, _scenes, raster))
        for name, text in texts.items()
    ]


def _weighed(variant: Variant, size: str, value: int, unit: str, device: torch.device) -> Variant:
    """Add the memory to a variant's work, and the growing size to its parameters."""
    count, run = variant.work, variant.run

    def work() -> dict[str, int | float]:
        peak = peak_bytes(run, device)
        counts = dict(count()) if count is not None else {}
        return counts if peak is None else counts | {"peak_bytes": peak}

    variant.work = work
    variant.parameters |= {size: value, "unit": unit}
    return variant


def _scans(settings: Settings, size: str) -> list[Variant]:
    level = "quick" if settings.level == "quick" else "normal"
    made = []
    for value in _SCAN_SIZES[settings.level][size]:
        sizes = _SCAN_BASE[level] | {size: value}
        if size == "L" and level == "normal":
            sizes["D"] = _WIDTH_OF_LENGTHS
        inputs = make_inputs(sizes["B"], sizes["L"], sizes["D"], sizes["N"])
        problem = scan_problem(inputs, settings.device, _TOKENS)
        for variant in problem.pair(f"{size} {value:,}"):
            variant.work = partial(_elements, sizes)
            made.append(_weighed(variant, size, value, "elements", settings.device))
    return made


def _elements(sizes: dict[str, int]) -> dict[str, int]:
    return {"units": math.prod(sizes.values())}


def _scenes(settings: Settings, size: str) -> list[Variant]:
    sizes = _RASTER_SIZES[settings.level][size]
    count, side, small = _RASTER_BASE["quick" if settings.level == "quick" else "normal"]
    made = []
    for value in sizes:
        if size == "Gaussians":
            shrunk = math.sqrt(sizes[0] / value)
            scene = _scene(settings, shell(value, 2 * shrunk), side, 1)
        elif size == "pixels":
            scene, value = _scene(settings, shell(count, 2), value, 1), value * value
        else:
            scene = _scene(settings, shell(count), small, value)
        for variant in scene.pair(f"{value:,} {size}"):
            backward = variant.direction == BOTH
            if scene.gaussians["opacities"].numel() > _DENSE:
                variant.check = partial(check_near, scene, backward)
                variant.oracle += ", of the Gaussians near the crop"
            assert variant.work is not None
            variant.work = partial(_pairs, scene, variant.work)
            unit = "pairs + Gaussians"
            made.append(_weighed(variant, size, value, unit, settings.device))
    return made


def _scene(settings: Settings, gaussians: dict[str, Tensor], side: int, views: int) -> Scene:
    return Scene(gaussians, *orbit_cameras(views, side), side, settings.device)


def _pairs(scene: Scene, count: Callable[[], Mapping[str, int | float]]) -> dict[str, int | float]:
    """The rasterizer's own counts; every view projects every Gaussian."""
    counts = dict(count())
    views = scene.viewmats.shape[:-2].numel()
    return counts | {"units": counts["pairs"] + views * counts["gaussians"]}


def near_crop(scene: Scene, backward: bool) -> Tensor:
    """Mask of the Gaussians that may reach the oracle's crop: by a box of six standard deviations.

    Args:
        scene: one object, ``[N, ·]``; its first view is used.
        backward: True for the smaller crop of the gradients.

    Returns:
        ``[N]`` bool on the CPU.
    """
    left, top, width, height = scene.crop(backward)
    means, scales = (scene.gaussians[k].double().cpu() for k in ("means", "scales"))
    view, K = scene.viewmats[0].double().cpu(), scene.Ks[0].double().cpu()
    x, y, depth = (means @ view[:3, :3].T + view[:3, 3]).unbind(1)
    depth = depth.clamp_min(1e-3)
    # A pixel more: projected covariances are widened by a constant.
    reach = 6 * (scales.amax(1) * K[0, 0] / depth + 1)
    across, down = K[0, 0] * x / depth + K[0, 2], K[1, 1] * y / depth + K[1, 2]
    inside_x = (across > left - reach) & (across < left + width + reach)
    return inside_x & (down > top - reach) & (down < top + height + reach)


def check_near(scene: Scene, backward: bool) -> Error:
    """Error on the crop, with the oracle limited to the Gaussians that may reach it.

    The picture is that of all Gaussians. Gradients are those of a rendering of only the Gaussians
    near the crop: the dense oracle of all would take gigabytes.
    """
    near = near_crop(scene, backward)
    few = {k: x[near.to(x.device)] for k, x in scene.gaussians.items()}
    if backward:
        return scene.changed(gaussians=few).check(BOTH)
    return scene.changed(truth=few).check("forward")
