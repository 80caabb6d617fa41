"""Cases of the rasterizer's knobs: what a caller may trade, and what is chosen inside."""

from __future__ import annotations

import torch

from ...rasterize.cpu.tuning import Tuning, use_tuning
from ..core.case import Settings, Variant, on_kernels
from .raster_scene import Scene
from .raster_variants import TRADE_LIMIT, make_pair, make_scene, make_variant

# An alpha or transmittance below these does not show in float64's picture of 16,384 Gaussians.
_NO_THRESHOLDS = {"alpha_min": 1e-9, "t_min": 1e-30}


def trades(settings: Settings) -> list[Variant]:
    """What may be traded for time, at scale 2; the truth has float32 inputs, all Gaussians, no
    threshold of alpha or T and no radius clip. The defaults are what trained Gaussians and other
    renderers assume.
    """
    scene = make_scene(settings, 2).changed(exact=_NO_THRESHOLDS)
    made = make_pair(scene, "default: alpha 1/255, T 1e-4", limit=TRADE_LIMIT, default=True)
    quick = settings.level == "quick"
    for denominator in (64,) if quick else (4096, 1024, 64, 32, 16):
        made += _trade(scene, f"alpha 1/{denominator}", alpha_min=1 / denominator)
    for limit in (1e-2,) if quick else (1e-6, 1e-3, 1e-2, 1e-1):
        made += _trade(scene, f"T {limit:g}", t_min=limit)
    made += _trade(scene, "alpha 1/4096, T 1e-6", alpha_min=1 / 4096, t_min=1e-6)
    for radius in (scene.size / 32, scene.size / 16):
        made += _trade(scene, f"radius clip {radius:g}", radius_clip=radius)
    for opacity in (0.35, 0.4):
        kept = scene.gaussians["opacities"] >= opacity
        pruned = {k: x[kept] for k, x in scene.gaussians.items()}
        pruned = scene.changed(gaussians=pruned, truth=scene.gaussians)
        made.append(make_variant(pruned, f"no opacities < {opacity}", limit=TRADE_LIMIT))
    for dtype in (torch.bfloat16, torch.float16):
        name = str(dtype).removeprefix("torch.")
        rounded = {k: x.to(dtype) for k, x in scene.gaussians.items()}
        rounded = scene.changed(gaussians=rounded, truth=scene.gaussians)
        made += make_pair(rounded, f"{name} inputs", limit=TRADE_LIMIT)
        made[-1].dtype = made[-2].dtype = name
    if settings.device.type == "cpu":
        made += on_kernels(
            use_tuning,
            Tuning(degree=3),
            make_pair(scene, "exp of degree 3", limit=TRADE_LIMIT),
        )
    return made


def _trade(scene: Scene, name: str, **options: float) -> list[Variant]:
    return make_pair(scene.changed(options=options), name, limit=TRADE_LIMIT)


def exponential(settings: Settings) -> list[Variant]:
    """Degree of the polynomial that makes exp in the CPU's kernels, at scale 2. The truth has the
    same thresholds, so that the polynomial alone is seen: without them ("knobs") their error
    hides it. Degree 5 errs by float32's own rounding at a price that is hardly to be measured.
    """
    scene, default, made = make_scene(settings, 2), Tuning(), []
    for degree in (3, 5) if settings.level == "quick" else (2, 3, 4, 5):
        choice = Tuning(degree=degree)
        pair = make_pair(scene, f"degree {degree}", limit=TRADE_LIMIT, default=choice == default)
        made += on_kernels(use_tuning, choice, pair)
    return made


def tiles(settings: Settings) -> list[Variant]:
    """Side of the tiles that have a list, and size of the sub-tiles that an ellipse is tested
    against in them, of the CPU's kernels, at scale 2. Same picture: a smaller tile makes more
    pairs, a larger sub-tile more evaluations.
    """
    scene, default, made = make_scene(settings, 2), Tuning(), []
    sizes = [(16, 4, 4), (16, 8, 4), (16, 8, 8), (16, 16, 16), (8, 4, 4), (8, 8, 8)]
    for tile, width, height in sizes[::4] if settings.level == "quick" else sizes:
        choice = Tuning(tile=tile, width=width, height=height)
        pair = make_pair(scene, f"{tile}, {width} x {height}", default=choice == default)
        made += on_kernels(use_tuning, choice, pair)
    return made
