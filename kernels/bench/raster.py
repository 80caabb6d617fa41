"""Benchmark of the rasterizer, and of its colours from harmonics."""

from __future__ import annotations

from dataclasses import fields, replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from ..cases.case import BOTH, DIRECTIONS, Case, Error, compare
from ..cases.raster import LEAVES, TRADE_LIMIT, orbit_cameras, raster_case, shell, work_of
from ..rasterize import Skip
from ..rasterize.harmonics import colors_seen_from
from ..rasterize.harmonics.formula import colors_by_formula
from . import measure, peers
from .measure import Settings, Table, Variant

# An alpha or transmittance below these does not show in float64's image of 16,384 Gaussians.
_NO_THRESHOLDS = {"alpha_min": 1e-9, "t_min": 1e-30}


def tables(settings: Settings) -> list[Table]:
    """Return the tables of the rasterizer."""
    builders = {
        "scene": scenes,
        "knobs": knobs,
        "skipping": skipping,
        "one call": one_call,
    }
    if settings.device.type == "cuda":
        builders["32 views"] = many_views
    builders["harmonics"] = harmonics
    return [Table("raster", name, build) for name, build in builders.items()]


def make_scene(
    settings: Settings,
    scale: float = 1.0,
    count: int | None = None,
    size: int | None = None,
    views: int = 1,
    **options: Any,
) -> Case:
    """Return the shell; a quick run has an eighth of the Gaussians and a quarter of the pixels."""
    quick = settings.level == "quick"
    count = count or (2048 if quick else 16384)
    size = size or (256 if quick else 512)
    cameras = orbit_cameras(views, size)
    return raster_case(shell(count, scale), cameras, size, settings.device, **options)


def _variant(scene: Case, name: str, direction: str = "forward", **changes) -> Variant:
    work = partial(work_of, scene, direction)
    return measure.variant(scene, name, direction, **({"work": work} | changes))


def _pair(scene: Case, name: str, **changes) -> list[Variant]:
    return [_variant(scene, name, direction, **changes) for direction in DIRECTIONS]


def _with(scene: Case, **options: Any) -> Case:
    """Return the case with other options of ``rasterization``, against the same exact values."""
    return replace(scene, function=partial(scene.function, **options))


def scenes(settings: Settings) -> list[Variant]:
    """The probe scene: Gaussians on a shell in one view, whole operator (project, sort, bin,
    blend), with standard deviations of 0.01, 0.02 and 0.04 of the object's size.
    """
    variants = []
    for scale in (1, 2, 4):
        scene = make_scene(settings, scale)
        of_scale = _pair(scene, f"scale {scale}", default=True)
        of_scale += _peers(scene, f"scale {scale}") * settings.peers
        for variant in of_scale:
            variant.parameters["scale"] = scale
        variants += of_scale
    return variants


def _peers(scene: Case, name: str) -> list[Variant]:
    """Return the variants of gsplat, the whole operator, which runs on CUDA."""
    if scene.device.type != "cuda":
        return []
    side = scene.sizes["side"]

    def function(*, pixels: Tensor, **arguments: Any) -> tuple[Tensor, Tensor, dict]:
        return peers.gsplat_rasterization(**arguments, width=side, height=side)

    theirs = replace(scene, function=function)

    def error() -> Error:
        return compare({"image": theirs.forward()[0]}, {"image": scene.forward()[0]})

    changes = {"check": error, "limit": 1e-2, "oracle": "our float32 image", "peer": True}
    return measure.pair(theirs, f"gsplat, {name}", **changes)


def knobs(settings: Settings) -> list[Variant]:
    """Accuracy traded for time, at scale 2; exact values are of float32 inputs, all Gaussians, no
    threshold of alpha or T and no radius clip. The defaults suit trained Gaussians and
    other renderers.
    """
    scene = make_scene(settings, 2, exact=_NO_THRESHOLDS)
    variants = _pair(scene, "default: alpha 1/255, T 1e-4", limit=TRADE_LIMIT, default=True)
    trades = {f"alpha 1/{n}": {"alpha_min": 1 / n} for n in (4096, 1024, 64, 32, 16)}
    trades |= {f"T {limit:g}": {"t_min": limit} for limit in (1e-6, 1e-3, 1e-2, 1e-1)}
    if settings.level == "quick":
        trades = {name: trades[name] for name in ("alpha 1/64", "T 0.01")}
    trades["alpha 1/4096, T 1e-6"] = {"alpha_min": 1 / 4096, "t_min": 1e-6}
    for radius in (scene.sizes["side"] / 32, scene.sizes["side"] / 16):
        trades[f"radius clip {radius:g}"] = {"radius_clip": radius}
    for name, options in trades.items():
        variants += _pair(_with(scene, **options), name, limit=TRADE_LIMIT)
    gaussians = scene.at()
    for opacity in (0.35, 0.4):
        mask = gaussians["opacities"] >= opacity
        pruned = {k: gaussians[k][mask] for k in LEAVES}

        def function(pruned: dict = pruned, **arguments: Any) -> tuple[Tensor, Tensor, dict]:
            return scene.function(**(arguments | pruned))

        case = replace(scene, function=function)
        variants.append(_variant(case, f"no opacities < {opacity}", limit=TRADE_LIMIT))
    for dtype in (torch.bfloat16, torch.float16):
        name = str(dtype).removeprefix("torch.")
        variants += _pair(scene, f"{name} inputs", limit=TRADE_LIMIT, options={"dtype": dtype})
    for v in variants:
        v.parameters["scale"] = 2
    return variants


def skipping(settings: Settings) -> list[Variant]:
    """Work left out because no result needs it: each switch of ``Skip`` off alone, and all off.
    One view; a few large Gaussians, and many small ones.
    """
    quick = settings.level == "quick"
    scenes = {"few large": (512, 8.0), "many small": (4096 if quick else 65536, 0.5)}
    variants = []
    for name, (count, scale) in scenes.items():
        scene = make_scene(settings, scale, count)
        variants += [v for direction in DIRECTIONS for v in switches(scene, name, direction)]
    return variants + partial_gradients(make_scene(settings, 2))


_FORWARD = ("tile_test", "block_test", "stopped", "empty_tiles")  # the others are of the gradient
_SAME = "the call with all on (0: the same bits)"


def switches(scene: Case, name: str, direction: str) -> list[Variant]:
    """Return the variants with each switch off alone, and all off; their bits are compared."""
    names = [x.name for x in fields(Skip) if direction == BOTH or x.name in _FORWARD]
    off = {"all on": (), **{f"{x} off": (x,) for x in names}, "all off": names}
    variants = []
    for label, disabled in off.items():
        other = _with(scene, skip=Skip(**dict.fromkeys(disabled, False)))
        check = partial(measure.difference, other, scene, direction)
        changes = {"check": check, "limit": 0.0, "oracle": _SAME, "default": not disabled}
        variants.append(_variant(other, f"{name}: {label}", direction, **changes))
    return variants


def partial_gradients(scene: Case) -> list[Variant]:
    """Return calls that need a part of the gradients, with the switch for it on and off."""
    half = scene.sizes["side"] // 2
    quarter = torch.zeros_like(scene.cotangent)
    quarter[:, :half, :half] = scene.cotangent[:, :half, :half]
    others = tuple(name for name in scene.inputs if name != "colors")
    cases = {
        "gradient of colors alone": (replace(scene, fixed=others), "unasked"),
        "upstream gradient on a quarter": (replace(scene, cotangent=quarter), "zero_upstream"),
    }
    calls = []
    for name, (changed, switch) in cases.items():
        calls += [v for v in switches(changed, name, BOTH) if v.default or f": {switch} " in v.name]
    return calls


def one_call(settings: Settings) -> list[Variant]:
    """Several objects in a few views each: in one call, and in as many as images."""
    objects, views, size = (2, 2, 64) if settings.level == "quick" else (8, 4, 128)
    shells = [shell(4096, 2, seed) for seed in range(objects)]
    viewmats, Ks = orbit_cameras(views, size)
    stacked = {k: torch.stack([x[k] for x in shells]) for k in LEAVES}
    cameras = viewmats.expand(objects, -1, -1, -1), Ks.expand(objects, -1, -1, -1)
    together = raster_case(stacked, cameras, size, settings.device)
    variants = _pair(together, "one call", default=True)
    single = [
        raster_case(gaussians, (viewmats[v : v + 1], Ks[v : v + 1]), size, settings.device)
        for gaussians in shells
        for v in range(views)
    ]
    for direction in DIRECTIONS:
        runs = [s.forward if direction == "forward" else s.backward for s in single]
        run = partial(_call_all, runs)
        variants.append(_variant(single[0], f"{len(single)} calls", direction, run=run, work=None))
        variants[-1].parameters["views"] = len(single)
    return variants


def _call_all(runs: list) -> None:
    for run in runs:
        run()


def many_views(settings: Settings) -> list[Variant]:
    """Many views in one launch, compared with gsplat."""
    scene = make_scene(settings, views=32)
    return _pair(scene, "ours", default=True) + (_peers(scene, "32 views") * settings.peers)


def harmonics(settings: Settings) -> list[Variant]:
    """Colours of Gaussians in views from harmonics, alone and with the gradients of coefficients,
    means and centres: our kernels, and the formula in torch.
    """
    quick = settings.level == "quick"
    sizes = [(2048 if quick else 16384, 1, degree) for degree in range(5)]
    sizes.append((2048, 2, 3) if quick else (262144, 4, 3))
    variants = []
    for count, views, degree in sizes:
        g = torch.Generator().manual_seed(0)
        inputs = {
            "coefficients": 0.3 * torch.randn(1, count, (degree + 1) ** 2, 3, generator=g),
            "means": torch.randn(1, count, 3, generator=g),
            "centers": 3 * torch.randn(1, views, 3, generator=g),
        }
        case = Case(
            partial(colors_seen_from, degree),
            partial(colors_by_formula, degree),
            inputs,
            torch.randn(1, views, count, 3, generator=g),
            settings.device,
            "the formula in float64",
            {"N": count, "views": views, "degree": degree},
            dict.fromkeys(DIRECTIONS, 1e-5),
            fixed=() if degree else ("means", "centers"),
        )
        name = f"degree {degree}, {count} Gaussians, {views} view{'s' * (views > 1)}"
        variants += measure.pair(case, f"ours, {name}", default=True)
        formula = replace(case, function=case.reference)
        variants += measure.pair(formula, f"the formula in torch, {name}")
    return variants
