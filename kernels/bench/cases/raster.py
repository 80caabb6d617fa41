"""Cases of the rasterizer."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial

import torch

from ...rasterize.harmonics import colors_seen_from
from ...rasterize.harmonics.formula import colors_by_formula
from .. import peers
from ..core.case import (
    BOTH,
    DIRECTIONS,
    Case,
    Error,
    Settings,
    Variant,
    compare,
    dtype_name,
    make_cases,
    over_threads,
)
from ..core.problem import Operator
from .raster_scene import (
    LEAVES,
    TRADE_LIMIT,
    Scene,
    make_scene,
    orbit_cameras,
    shell,
)

# An alpha or transmittance below these does not show in float64's picture of 16,384 Gaussians.
_NO_THRESHOLDS = {"alpha_min": 1e-9, "t_min": 1e-30}


def cases(settings: Settings) -> list[Case]:
    """All cases of the rasterizer at the level's sizes."""
    builders = [
        ("scene", scenes, None),
        ("knobs", knobs, "error"),
        ("skipping", skipping, "skipped"),
        ("one call", one_call, None),
        ("Gaussians", counts, "N"),
        ("pixels", pixels, "side"),
        ("views", views, "views"),
        ("batch", batches, "B"),
    ]
    if settings.device.type == "cuda":
        builders.append(("32 views", many_views, None))
    else:
        builders.append(("threads", by_threads, "threads"))
    builders += [("harmonics by degree", degrees, "degree"), ("harmonics", harmonics, "N")]
    return make_cases("raster", settings, builders)


def scenes(settings: Settings) -> list[Variant]:
    """The probe scene: 16,384 Gaussians on a shell, one view of 512², whole operator (project,
    sort, bin, blend), with standard deviations of 0.01, 0.02 and 0.04 of the object's size.
    """
    made = []
    for scale in (1, 2, 4):
        scene = make_scene(settings, scale)
        variants = scene.pair(f"scale {scale}", default=True)
        if settings.peers:
            variants += _peers(scene, f"scale {scale}")
        for variant in variants:
            variant.parameters["scale"] = scale
        made += variants
    return made


def _peers(scene: Scene, name: str) -> list[Variant]:
    """On CUDA gsplat and gswarp, the whole operator."""
    if scene.device.type != "cuda":
        return []
    packages = {"gsplat": peers.gsplat_rasterization, "gswarp": peers.gswarp_rasterization}

    def error(function) -> Error:
        got, want = scene.forward(function)[0], scene.forward()[0]
        return compare({"picture": got}, {"picture": want})

    return [
        Variant(
            name=f"{package}, {name}",
            run=partial(run, function),
            check=partial(error, function),
            limit=1e-2,
            oracle="our float32 picture",
            direction=direction,
            peer=True,
            parameters=scene.sizes,
        )
        for package, function in packages.items()
        for direction, run in (("forward", scene.forward), (BOTH, scene.backward))
    ]


def knobs(settings: Settings) -> list[Variant]:
    """Accuracy traded for time, at scale 2; the truth has float32 inputs, all Gaussians, no
    threshold of alpha or T and no radius clip. The defaults are those of trained Gaussians and
    other renderers.
    """
    scene = make_scene(settings, 2).changed(exact=_NO_THRESHOLDS)
    made = scene.pair("default: alpha 1/255, T 1e-4", limit=TRADE_LIMIT, default=True)
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
        made.append(pruned.variant(f"no opacities < {opacity}", limit=TRADE_LIMIT))
    for dtype in (torch.bfloat16, torch.float16):
        name = dtype_name(dtype)
        rounded = {k: x.to(dtype) for k, x in scene.gaussians.items()}
        rounded = scene.changed(gaussians=rounded, truth=scene.gaussians)
        made += rounded.pair(f"{name} inputs", limit=TRADE_LIMIT, dtype=name)
    return made


def _trade(scene: Scene, name: str, **options: float) -> list[Variant]:
    return scene.changed(options=options).pair(name, limit=TRADE_LIMIT)


def skipping(settings: Settings) -> list[Variant]:
    """Work left out because no result needs it, at scale 2, against the same call that needs
    all. Skipped: share of the pairs of Gaussians and tiles, or of the gradients.
    """
    scene = make_scene(settings, 2)
    made = [scene.variant("all gradients, whole picture", BOTH, default=True)]
    for name in ("colors", "means"):
        made.append(scene.changed(wanted=(name,)).variant(f"gradient of {name} alone", BOTH))
        made[-1].work = lambda: scene.work(True) | {"skipped": 1 - 1 / len(LEAVES)}
    half = scene.size // 2
    for name, rows in (("half", scene.size), ("a quarter", half)):
        part = torch.zeros_like(scene.upstream)
        part[:, :rows, :half] = scene.upstream[:, :rows, :half]
        part = scene.changed(cotangent=part)
        made.append(part.variant(f"upstream gradient on {name} of the picture", BOTH))
        made[-1].work = partial(_tiles_skipped, part)
    return made


def _tiles_skipped(scene: Scene) -> dict[str, float]:
    counts = scene.work(True)
    occupied = counts["tiles"] - counts["tiles_empty"]
    skipped = counts["tiles_skipped"] - counts["tiles_empty"]
    return counts | {"skipped": skipped / max(occupied, 1)}


def one_call(settings: Settings) -> list[Variant]:
    """8 objects of 4,096 Gaussians in 4 views of 128² each: in one call, and in 32."""
    objects, views, size = (2, 2, 64) if settings.level == "quick" else (8, 4, 128)
    together = _objects(settings, objects, views, size)
    x, viewmats, Ks = together.gaussians, together.viewmats, together.Ks
    single = [
        Scene(
            gaussians={k: values[b] for k, values in x.items()},
            viewmats=viewmats[b, v : v + 1],
            Ks=Ks[b, v : v + 1],
            size=size,
            device=settings.device,
        )
        for b in range(objects)
        for v in range(views)
    ]
    made = together.pair("one call", default=True)
    for direction in DIRECTIONS:
        variant = single[0].variant(f"{len(single)} calls", direction)
        runs = [s.forward if direction == "forward" else s.backward for s in single]
        variant.run, variant.work = partial(_call_all, runs), None
        variant.parameters["views"] = len(single)
        made.append(variant)
    return made


def _call_all(runs: list) -> None:
    for run in runs:
        run()


def counts(settings: Settings) -> list[Variant]:
    """Cost against the number of Gaussians, which get smaller so that they cover the same area."""
    counts = {
        "quick": (1024, 4096),
        "normal": (16384, 65536),
        "full": (16384, 65536, 262144),
    }[settings.level]
    made = []
    for count in counts:
        scene = make_scene(settings, math.sqrt(counts[0] / count), count)
        made += scene.pair(f"{count} Gaussians")
    return made


def pixels(settings: Settings) -> list[Variant]:
    """Cost against the side of the picture, at scale 2."""
    sides = (64, 128) if settings.level == "quick" else (128, 256, 512, 1024)
    made = []
    for side in sides:
        made += make_scene(settings, 2, size=side).pair(f"{side} x {side}")
    return made


def views(settings: Settings) -> list[Variant]:
    """Cost against the number of views of 256² in one call."""
    numbers, size = ((1, 2), 64) if settings.level == "quick" else ((1, 2, 4, 8, 16), 256)
    made = []
    for views in numbers:
        scene = make_scene(settings, size=size, views=views)
        made += scene.pair(f"{views} view{'s' * (views > 1)}")
    return made


def batches(settings: Settings) -> list[Variant]:
    """Cost against the number of objects of 4,096 Gaussians in one call, a view of 256² each."""
    numbers, size = ((1, 2), 64) if settings.level == "quick" else ((1, 2, 4, 8, 16), 256)
    made = []
    for number in numbers:
        made += _objects(settings, number, 1, size).pair(f"B {number}")
        made[-1].parameters["B"] = made[-2].parameters["B"] = number
    return made


def _objects(settings: Settings, number: int, views: int, size: int) -> Scene:
    """Shells of 4,096 Gaussians, one for each object, in one call."""
    shells = [shell(4096, 2, seed) for seed in range(number)]
    gaussians = {k: torch.stack([x[k] for x in shells]) for k in shells[0]}
    viewmats, Ks = (x.expand(number, *x.shape) for x in orbit_cameras(views, size))
    return Scene(gaussians, viewmats, Ks, size, settings.device)


def by_threads(settings: Settings) -> list[Variant]:
    """Cost against torch's number of threads, at scale 2."""
    return over_threads(make_scene(settings, 2).pair)


def many_views(settings: Settings) -> list[Variant]:
    """32 views of 512² in one launch, beside gsplat."""
    scene = make_scene(settings, views=32)
    return scene.pair("ours", default=True) + (_peers(scene, "32 views") * settings.peers)


def degrees(settings: Settings) -> list[Variant]:
    """Colours of 16,384 Gaussians in one view (2,048 in a quick run) from harmonics of each degree,
    alone and with the gradients of coefficients, means and centres.
    """
    count = 2048 if settings.level == "quick" else 16384
    made = []
    for degree in range(5):
        made += _harmonics(settings, degree, count, 1, f"degree {degree}")
    return made


def harmonics(settings: Settings) -> list[Variant]:
    """Degree 3 with more Gaussians and views, alone and with gradients."""
    quick, made = settings.level == "quick", []
    for count in (2048,) if quick else (16384, 262144):
        for views in (1, 2 if quick else 4):
            name = f"{count} Gaussians, {views} view{'s' * (views > 1)}"
            made += _harmonics(settings, 3, count, views, name)
    return made


def _harmonics(settings: Settings, degree: int, count: int, views: int, name: str) -> list[Variant]:
    """N Gaussians seen from V centres: our kernels, the formula in torch and gsplat's torch."""
    g = torch.Generator().manual_seed(0)
    inputs = {
        "coefficients": 0.3 * torch.randn(1, count, (degree + 1) ** 2, 3, generator=g),
        "means": torch.randn(1, count, 3, generator=g),
        "centers": 3 * torch.randn(1, views, 3, generator=g),
    }
    problem = Operator(
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
    formula = replace(problem, function=problem.reference)
    made = problem.pair(f"ours, {name}", default=True)
    made += formula.pair(f"the formula in torch, {name}")
    if settings.peers:
        gsplat = replace(problem, function=partial(peers.gsplat_colors, degree))
        made += gsplat.pair(f"gsplat's torch, {name}", peer=True)
    return made
