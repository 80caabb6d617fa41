"""Studies of the rasterizer: its switches one by one, and large scenes."""

from __future__ import annotations

import math
from dataclasses import fields, replace
from functools import partial

import torch
from torch import Tensor

from gamba_warp.kernels.bench.cases.raster_scene import (
    LEAVES,
    Scene,
    make_scene,
    orbit_cameras,
    shell,
)
from gamba_warp.kernels.bench.core.case import (
    DIRECTIONS,
    Case,
    Settings,
    Variant,
    make_cases,
)
from gamba_warp.kernels.rasterize import Skip

from .targets import Key, Target

_FEW = 16384
_CASE = "large scenes"
_SUM = "pairs_and_gaussians"
_LEVELS = {"quick": (1024, 40000), "normal": (_FEW, 262144), "full": (_FEW, 262144, 1048576)}


def cases(settings: Settings) -> list[Case]:
    """All studies of the rasterizer at the level's sizes."""
    builders = [("switches", switches, "skipped")]
    if settings.device.type == "cpu":
        builders.append((_CASE, large_scenes, "N"))
    return make_cases("raster", settings, builders)


def switches(settings: Settings) -> list[Variant]:
    """Every exact skip switched off alone, at scale 2, with an upstream gradient on the left half
    of the picture and for means alone. Same picture and gradients; what the switch is worth is
    the difference to the default. Skipped: the share of that switch's own count in the default.
    """
    scene = make_scene(settings, 2)
    part = torch.zeros_like(scene.upstream)
    part[:, :, : scene.size // 2] = scene.upstream[:, :, : scene.size // 2]
    scene = scene.changed(cotangent=part, wanted=("means",))
    made = scene.pair("all skips", default=True)
    for field in fields(Skip):
        off = scene.changed(options={"skip": replace(Skip(), **{field.name: False})})
        pair = off.pair(f"without {field.name}")
        for variant in pair[field.name in ("zero_upstream", "unused", "unasked") :]:
            variant.work = partial(_share, field.name, scene)
            made.append(variant)
    return made


def _share(name: str, scene: Scene) -> dict[str, float]:
    """Share skipped by the named switch of its own count, with all switches on."""
    counts = scene.work(True)
    blocks = 16 * counts["pairs_walked"]
    none, half = counts["tiles_empty"], counts["tiles"] - counts["tiles_empty"]
    share = {
        "tile_test": 1 - counts["pairs"] / counts["pairs_box"],
        "block_test": 1 - counts["blocks_walked"] / blocks,
        "stopped": 1 - counts["pairs_walked"] / counts["pairs"],
        "empty_tiles": none / counts["tiles"],
        "zero_upstream": (counts["tiles_skipped"] - none) / half,
        "unused": 1 - counts["blocks_used"] / blocks,
        "unasked": 1 - len(scene.wanted) / len(LEAVES),
    }
    return counts | {"skipped": share[name]}


def _width(size: int, wide: bool) -> int:
    return size * 16 // 9 if wide else size


class LargeScene(Scene):
    """A shell whose oracle sees only the Gaussians around the crop: it is dense.

    Attributes:
        wide: True for pictures of 16:9; ``size`` is their height.
    """

    wide: bool = False

    @property
    def width(self) -> int:
        """Width of the picture, pixels."""
        return _width(self.size, self.wide)

    def arguments(self) -> dict:
        """Arguments of any scene, with the width of the picture."""
        return super().arguments() | {"width": self.width}

    def crop(self, backward: bool) -> tuple[int, int, int, int]:
        """Crop of any scene; the object is also in the middle of a wide picture."""
        left, top, width, height = super().crop(True)
        return left + (self.width - self.size) // 2, top, width, height


def _scene(settings: Settings, count: int, few: int, size: int, wide: bool) -> LargeScene:
    viewmats, Ks = orbit_cameras(1, size)
    width = _width(size, wide)
    Ks[:, 0, 2] = width / 2
    g = torch.Generator().manual_seed(3)
    cotangent = torch.randn(1, size, width, 3, generator=g).to(settings.device)
    gaussians = shell(count, math.sqrt(few / count))
    scene = LargeScene(gaussians, viewmats, Ks, size, settings.device, cotangent=cotangent)
    scene.wide = wide
    if count > few:
        near = _near_crop(scene).to(settings.device)
        scene.truth = {k: x[near] for k, x in scene.gaussians.items()}
    return scene


def _near_crop(scene: Scene) -> Tensor:
    """Return the Gaussians that may reach the oracle's crop, within six standard deviations.

    Args:
        scene: one object, ``[N, ·]``; its first view is used.

    Returns:
        ``[N]`` bool on the CPU.
    """
    left, top, width, height = scene.crop(False)
    means, scales = (scene.gaussians[k].double().cpu() for k in ("means", "scales"))
    view, K = scene.viewmats[0].double().cpu(), scene.Ks[0].double().cpu()
    x, y, depth = (means @ view[:3, :3].T + view[:3, 3]).unbind(1)
    depth = depth.clamp_min(1e-3)
    # A pixel more: projected covariances are widened by a constant.
    reach = 6 * (scales.amax(1) * K[0, 0] / depth + 1)
    across, down = K[0, 0] * x / depth + K[0, 2], K[1, 1] * y / depth + K[1, 2]
    inside_x = (across > left - reach) & (across < left + width + reach)
    return inside_x & (down > top - reach) & (down < top + height + reach)


def _work(scene: LargeScene, backward: bool) -> dict[str, float]:
    counts: dict[str, float] = {**scene.work(backward)}
    return counts | {_SUM: counts["pairs"] + counts["gaussians"]}


def large_scenes(settings: Settings) -> list[Variant]:
    """From 16,384 to a million Gaussians that get smaller, so that they cover the same area. The
    check is that of a forward.
    """
    counts = _LEVELS[settings.level]
    size, high = (128, 144) if settings.level == "quick" else (512, 1080)
    made = []
    for count in counts:
        for wide in (False, True) if count > counts[0] else (False,):
            scene = _scene(settings, count, counts[0], high if wide else size, wide)
            name = f"{count} Gaussians" + f", {high * 16 // 9} x {high}" * wide
            forward, both = scene.pair(name)
            both.check, both.oracle = forward.check, forward.oracle
            for variant, backward in ((forward, False), (both, True)):
                variant.work = partial(_work, scene, backward)
                variant.parameters = {"N": count, "side": scene.size, "wide": int(wide)}
            made += [forward, both]
    return made


def targets(settings: Settings) -> list[Target]:
    """Return the target: time grows no faster than pairs plus Gaussians."""
    if settings.level == "quick" or settings.device.type != "cpu":
        return []
    made = []
    for count in _LEVELS[settings.level][1:]:
        few, many = f"{_FEW} Gaussians", f"{count} Gaussians"
        for direction in DIRECTIONS:
            key = partial(Key, "raster", _CASE, direction=direction)
            text = f"{direction}, growth of time over that of pairs + Gaussians, {_FEW} to {count}"
            times = key(variant=many), key(variant=few, field=_SUM)
            over = key(variant=few), key(variant=many, field=_SUM)
            made.append(Target(text, times, over, at_most=1.0))
    return made
