"""Cases of the rasterizer, and the targets on them."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import fields, replace
from functools import partial

import torch

from ...rasterize import Skip
from .. import peers
from ..core.case import Case, Error, Key, Settings, Target, Variant, compare
from . import harmonics, raster_knobs, raster_large
from .raster_parts import Parts
from .raster_scene import LEAVES, Scene, orbit_cameras, shell
from .raster_variants import BOTH, COUNT, make_pair, make_scene, make_variant, sizes_of

# gsplat's lists of many Gaussians take seconds: a loop in Python.
_LARGE_PARTS: dict[str, dict[int, tuple[str, ...]]] = {
    "normal": {262144: ("projection", "tile lists")},
    "full": {262144: ("projection", "tile lists"), 1048576: ("projection",)},
}


def cases(settings: Settings) -> list[Case]:
    """All cases of the rasterizer at the level's sizes."""
    cpu = settings.device.type == "cpu"
    builders = [
        ("scene", _scenes, None),
        ("knobs", raster_knobs.trades, "error"),
        *([("exponential", raster_knobs.exponential, "error")] if cpu else []),
        *([("tiles", raster_knobs.tiles, "error")] if cpu else []),
        ("skipping", _skipping, "skipped"),
        ("switches", _switches, "switched off"),
        ("one call", _one_call, None),
        ("Gaussians", _counts, "N"),
        ("pixels", _pixels, "side"),
        ("views", _views, "views"),
        ("batch", _batches, "B"),
    ]
    if cpu:
        builders.append(("large scenes", raster_large.large_scenes, "N"))
        builders.append(("threads", _threads, "threads"))
        if settings.peers:
            builders.append(("gsplat's parts", _gsplat_parts, None))
    else:
        builders.append(("32 views", _many_views, None))
    return [
        Case(
            op="raster",
            name=name,
            text=" ".join(build.__doc__.split()),
            build=partial(build, settings),
            axis=axis,
        )
        for name, build, axis in builders
    ] + harmonics.cases(settings)


def _scenes(settings: Settings) -> list[Variant]:
    """The probe scene: 16,384 Gaussians on a shell, one view of 512², whole operator (project,
    sort, bin, blend), with standard deviations of 0.01, 0.02 and 0.04 of the object's size.
    """
    made = []
    for scale in (1, 2, 4):
        scene = make_scene(settings, scale)
        variants = make_pair(scene, f"scale {scale}", default=True)
        if settings.peers:
            variants += _peers(scene, f"scale {scale}")
        for variant in variants:
            variant.parameters["scale"] = scale
        made += variants
    return made


def _peers(scene: Scene, name: str) -> list[Variant]:
    """On CUDA gsplat and gswarp, the whole operator; a CPU has ``_gsplat_parts``."""
    if scene.device.type != "cuda":
        return []
    made = []
    for package, function in (
        ("gsplat", peers.gsplat_rasterization),
        ("gswarp", peers.gswarp_rasterization),
    ):

        def error(function=function) -> Error:
            got, want = scene.forward(function)[0], scene.forward()[0]
            return compare({"picture": got}, {"picture": want})

        for direction, run in (("forward", scene.forward), (BOTH, scene.backward)):
            made.append(
                Variant(
                    name=f"{package}, {name}",
                    run=partial(run, function),
                    check=error,
                    limit=1e-2,
                    oracle="our float32 picture",
                    direction=direction,
                    peer=True,
                    parameters=sizes_of(scene),
                )
            )
    return made


def _gsplat_parts(settings: Settings) -> list[Variant]:
    """The torch functions of gsplat that run on a CPU, beside the same part of ours: projection,
    tile lists (theirs of boxes, ours of ellipses) and harmonics of degree 3. Its compositing needs
    CUDA. More Gaussians are smaller, so that they cover the same area.
    """
    made = _parts_of(make_scene(settings), "", ("projection", "tile lists", "harmonics"))
    for count, parts in _LARGE_PARTS.get(settings.level, {}).items():
        scene = make_scene(settings, math.sqrt(COUNT / count), count)
        made += _parts_of(scene, f", {count} Gaussians", parts)
    return made


def _parts_of(scene: Scene, suffix: str, wanted: Sequence[str]) -> list[Variant]:
    """Parts of ours and of gsplat on a scene; ``suffix`` ends their names."""
    made = []
    pairs = Parts(scene).pairs()
    for part in wanted:
        ours, theirs, check = pairs[part]
        for name, run, peer in (("ours", ours, False), ("gsplat", theirs, True)):
            made.append(
                Variant(
                    name=name + suffix,
                    run=run,
                    check=check if peer else None,
                    limit=1e-4,
                    oracle="our float32 result" if peer and check else "",
                    direction=part,
                    peer=peer,
                    default=not peer,
                    rounds=3 if peer and part == "tile lists" else None,
                    parameters=sizes_of(scene),
                )
            )
    return made


def _skipping(settings: Settings) -> list[Variant]:
    """What is not computed because nobody needs it, at scale 2, against the same call that needs
    all. Skipped: share of the pairs of Gaussians and tiles, or of the gradients.
    """
    scene = make_scene(settings, 2)
    made = [make_variant(scene, "all gradients, whole picture", BOTH, default=True)]
    for name in ("colors", "means"):
        made.append(make_variant(scene.changed(wanted=(name,)), f"gradient of {name} alone", BOTH))
        made[-1].work = partial(_gradients_skipped, scene, 1 - 1 / len(LEAVES))
    half = scene.size // 2
    for name, rows in (("half", scene.size), ("a quarter", half)):
        part = torch.zeros_like(scene.upstream)
        part[:, :rows, :half] = scene.upstream[:, :rows, :half]
        part = scene.changed(cotangent=part)
        made.append(make_variant(part, f"upstream gradient on {name} of the picture", BOTH))
        made[-1].work = partial(_tiles_skipped, part)
    return made


def _switches(settings: Settings) -> list[Variant]:
    """Every exact skip switched off alone, at scale 2, with an upstream gradient on the left half
    of the picture and for means alone. Same picture and gradients; what the switch is worth is
    the difference to the default. Skipped: the share of that switch's own count in the default.
    """
    scene = make_scene(settings, 2)
    part = torch.zeros_like(scene.upstream)
    part[:, :, : scene.size // 2] = scene.upstream[:, :, : scene.size // 2]
    scene = scene.changed(cotangent=part, wanted=("means",))
    made = make_pair(scene, "all skips", default=True)
    for field in fields(Skip):
        off = scene.changed(options={"skip": replace(Skip(), **{field.name: False})})
        pair = make_pair(off, f"without {field.name}")
        for variant in pair[field.name in ("zero_upstream", "unused", "unasked") :]:
            variant.work = partial(_share, field.name, scene)
            made.append(variant)
    return made


def _share(name: str, scene: Scene) -> dict[str, float]:
    """What the named switch leaves out of its own count, where all are on."""
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


def _gradients_skipped(scene: Scene, share: float) -> dict[str, float]:
    return scene.work(True) | {"skipped": share}


def _tiles_skipped(scene: Scene) -> dict[str, float]:
    counts = scene.work(True)
    occupied = counts["tiles"] - counts["tiles_empty"]
    skipped = counts["tiles_skipped"] - counts["tiles_empty"]
    return counts | {"skipped": skipped / max(occupied, 1)}


def _one_call(settings: Settings) -> list[Variant]:
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
    made = make_pair(together, "one call", default=True)
    for direction in ("forward", BOTH):
        variant = make_variant(single[0], f"{len(single)} calls", direction)
        runs = [s.forward if direction == "forward" else s.backward for s in single]
        variant.run = partial(_call_all, runs)
        variant.work = None
        variant.parameters["views"] = len(single)
        made.append(variant)
    return made


def _call_all(runs: list) -> None:
    for run in runs:
        run()


def _counts(settings: Settings) -> list[Variant]:
    """Cost against the number of Gaussians, which get smaller so that they cover the same area."""
    counts = {
        "quick": (1024, 4096),
        "normal": (16384, 65536),
        "full": (16384, 65536, 262144),
    }[settings.level]
    made = []
    for count in counts:
        scene = make_scene(settings, math.sqrt(counts[0] / count), count)
        made += make_pair(scene, f"{count} Gaussians")
    return made


def _pixels(settings: Settings) -> list[Variant]:
    """Cost against the side of the picture, at scale 2."""
    sides = (64, 128) if settings.level == "quick" else (128, 256, 512, 1024)
    made = []
    for side in sides:
        made += make_pair(make_scene(settings, 2, size=side), f"{side} x {side}")
    return made


def _views(settings: Settings) -> list[Variant]:
    """Cost against the number of views of 256² in one call."""
    numbers, size = ((1, 2), 64) if settings.level == "quick" else ((1, 2, 4, 8, 16), 256)
    made = []
    for views in numbers:
        made += make_pair(
            make_scene(settings, size=size, views=views), f"{views} view{'s' * (views > 1)}"
        )
    return made


def _batches(settings: Settings) -> list[Variant]:
    """Cost against the number of objects of 4,096 Gaussians in one call, a view of 256² each."""
    numbers, size = ((1, 2), 64) if settings.level == "quick" else ((1, 2, 4, 8, 16), 256)
    made = []
    for number in numbers:
        for variant in make_pair(_objects(settings, number, 1, size), f"B {number}"):
            variant.parameters["B"] = number
            made.append(variant)
    return made


def _objects(settings: Settings, number: int, views: int, size: int) -> Scene:
    """Shells of 4,096 Gaussians, one for each object, in one call."""
    shells = [shell(4096, 2, seed) for seed in range(number)]
    gaussians = {k: torch.stack([x[k] for x in shells]) for k in shells[0]}
    viewmats, Ks = (x.expand(number, *x.shape) for x in orbit_cameras(views, size))
    return Scene(gaussians, viewmats, Ks, size, settings.device)


def _threads(settings: Settings) -> list[Variant]:
    """Cost against torch's number of threads, at scale 2."""
    cores = os.cpu_count() or 1
    scene = make_scene(settings, 2)
    made = []
    for threads in sorted({1, cores, *(2**i for i in range(1, 10) if 2**i < cores)}):
        for variant in make_pair(scene, f"{threads} thread{'s' * (threads > 1)}", threads=threads):
            variant.parameters["threads"] = threads
            made.append(variant)
    return made


def _many_views(settings: Settings) -> list[Variant]:
    """32 views of 512² in one launch, beside gsplat."""
    scene = make_scene(settings, views=32)
    return make_pair(scene, "ours", default=True) + (_peers(scene, "32 views") * settings.peers)


def _raster(case: str, variant: str, direction: str = "forward", field: str = "ms_p50") -> Key:
    return Key("raster", case, variant, direction, field)


def targets(settings: Settings) -> list[Target]:
    """What should be reached; nothing at a quick run's sizes."""
    if settings.level == "quick":
        return []
    made = []
    for scale, bound in ((1, 12), (2, 25), (4, 55)):
        forward, both = (_raster("scene", f"scale {scale}", d) for d in ("forward", BOTH))
        if settings.device.type == "cpu":
            made.append(Target(f"forward, scale {scale}, ms", (forward,), at_most=bound))
        text = f"forward + backward over forward, scale {scale}"
        made.append(Target(text, (both,), (forward,), at_most=3.5))
    for direction in ("forward", BOTH):
        many, one = (_raster("one call", name, direction) for name in ("32 calls", "one call"))
        text = f"8 objects x 4 views, {direction}, 32 calls over one"
        made.append(Target(text, (many,), (one,), at_least=1.3))
    made += _growth(settings) + harmonics.targets(settings)
    cuda = settings.device.type == "cuda"
    return made + (_cuda_targets() if cuda else raster_large.targets(settings))


def _growth(settings: Settings) -> list[Target]:
    """Time grows no faster than the pairs of Gaussians and tiles."""
    made = []
    for count in (65536, 262144) if settings.level == "full" else (65536,):
        for direction in ("forward", BOTH):
            few, many = (
                partial(_raster, "Gaussians", f"{n} Gaussians", direction) for n in (16384, count)
            )
            text = f"{direction}, growth of time over growth of pairs, 16384 to {count} Gaussians"
            times, over = (many(), few("pairs")), (few(), many("pairs"))
            made.append(Target(text, times, over, at_most=1.0))
    return made


def _cuda_targets() -> list[Target]:
    ours, both = (_raster("32 views", "ours", d) for d in ("forward", BOTH))
    peer = _raster("32 views", "gsplat, 32 views")
    return [
        Target("forward, µs a view of 512²", (ours,), scale=1e3 / 32, at_most=60),
        Target("forward + backward, µs a view of 512²", (both,), scale=1e3 / 32, at_most=210),
        Target("forward, gsplat's time over ours", (peer,), (ours,), at_least=1.5),
    ]
