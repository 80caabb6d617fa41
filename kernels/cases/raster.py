"""Cases of the rasterizer: Gaussians on a shell, and random and hostile ones."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial
from typing import Any

import torch
from torch import Tensor

from ..rasterize import Skip, rasterization
from ..rasterize.reference import pixel_centers, rasterization_reference
from .case import BOTH, Case, gradients_of, wanted
from .random_case import (
    COTANGENTS,
    DTYPES,
    RANGES,
    Op,
    Outcome,
    RandomCase,
    Runs,
    fill,
    fits,
    generator,
    mostly,
)
from .raster_oracle import View, ViewOptions, render_view
from .rounding import SAMPLES, Rounding, samples_of

LEAVES = ("means", "quats", "scales", "opacities", "colors")
WORK = ("pairs_box", "pairs", "pairs_traversed", "blocks_traversed", "blocks_used")
WORK += ("tiles", "tiles_empty")
_HALF_FOV = math.radians(49.1) / 2
_CROPS = {"forward": (48, 40), BOTH: (24, 20)}  # width and height, pixels

# Allowed relative rms error to float64; a knob that trades accuracy is allowed the more it trades.
LIMITS, TRADE_LIMIT = {"forward": 1e-4, BOTH: 1e-3}, 10.0


def shell(count: int, scale: float = 1.0, seed: int = 0) -> dict[str, Tensor]:
    """Return Gaussians on a shell of radius 0.35, standard deviations 0.01·scale, log-normal.

    ``means, quats, scales [N, ·]``, ``opacities [N]`` in 0.3..1, ``colors [N, 3]``.
    """
    g = torch.Generator().manual_seed(seed)
    direction = torch.nn.functional.normalize(torch.randn(count, 3, generator=g), dim=1)
    means = direction * 0.35 * (0.9 + 0.1 * torch.rand(count, 1, generator=g))
    scales = torch.exp(0.4 * torch.randn(count, 3, generator=g) + math.log(0.010)) * scale
    quats = torch.nn.functional.normalize(torch.randn(count, 4, generator=g), dim=1)
    opacities = 0.7 * torch.rand(count, 1, generator=g) + 0.3
    colors = torch.rand(count, 3, generator=g)
    return dict(means=means, quats=quats, scales=scales, opacities=opacities[:, 0], colors=colors)


def orbit_cameras(views: int, size: int) -> tuple[Tensor, Tensor]:
    """Return ``viewmats [V, 4, 4]`` at distance 1.5 around the y axis, and ``Ks [V, 3, 3]``."""
    angle = torch.arange(views) * (2 * math.pi / views)
    viewmats = torch.eye(4).repeat(views, 1, 1)
    viewmats[:, 0, 0] = viewmats[:, 2, 2] = angle.cos()
    viewmats[:, 0, 2], viewmats[:, 2, 0] = angle.sin(), -angle.sin()
    viewmats[:, 2, 3] = 1.5
    focal = size / 2 / math.tan(_HALF_FOV)
    K = torch.tensor([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]])
    return viewmats, K.repeat(views, 1, 1)


def raster_case(
    gaussians: Mapping[str, Any],
    cameras: tuple[Tensor, Tensor],
    size: int,
    device: torch.device,
    exact: Mapping[str, Any] | None = None,
    **options: Any,
) -> Case:
    """Return the rendering of Gaussians, without a gradient of the cameras.

    The reference sees all Gaussians of the first object, and a crop of its first view.

    Args:
        gaussians: float32, ``[N, ·]`` or ``[B, N, ·]``.
        cameras: ``viewmats [.., V, 4, 4]`` and ``Ks [.., V, 3, 3]``.
        size: side of the image, pixels.
        device: of the operator.
        exact: options of the reference where it shall not have ours, as ``alpha_min``.
        options: of ``rasterization``.
    """
    viewmats, Ks = cameras
    known = {k: x for k, x in options.items() if k not in ("radius_clip", "skip")}
    if known.pop("rasterize_mode", "classic") == "antialiased":
        known["antialiased"] = True
    known |= exact or {}

    def reference(**x: Any) -> tuple[Tensor, Tensor]:
        renders, _, alphas = rasterization_reference(**x, width=size, height=size, **known)
        if not alphas.any():
            raise ValueError("the crop of the check sees no Gaussian")
        return renders, alphas

    def function(*, pixels: Tensor, **arguments: Any) -> tuple[Tensor, Tensor, dict]:
        return rasterization(**arguments, width=size, height=size)

    first = (slice(1),) * (viewmats.dim() - 3)
    shared = dict.fromkeys(gaussians, first or ...)
    shared |= dict.fromkeys(("viewmats", "Ks"), (*first, slice(1)))
    part = {}
    for direction, (wide, high) in _CROPS.items():  # within the object, off its centre
        left, top = round(0.58 * size), round(0.39 * size)
        crop = slice(top, top + high), slice(left, left + wide)
        images = dict.fromkeys(("renders", "alphas"), (*first, slice(1), *crop))
        part[direction] = {**shared, "pixels": crop, **images}
    views = viewmats.shape[:-2].numel()
    shape = (*viewmats.shape[:-2], size, size, 3)
    return Case(
        partial(function, **options),
        reference,
        {**gaussians, "viewmats": viewmats, "Ks": Ks, "pixels": pixel_centers(size, size)},
        torch.randn(shape, generator=torch.Generator().manual_seed(3)),
        device,
        "float64, all Gaussians dense, a crop of {} x {} pixels ({} x {} with gradients)".format(
            *_CROPS["forward"], *_CROPS[BOTH]
        )
        + (" without thresholds" if "t_min" in (exact or {}) else ""),
        {"N": gaussians["opacities"].shape[-1], "side": size, "views": views},
        LIMITS,
        outputs=("renders", "alphas"),
        cast=LEAVES,
        part=part,
        fixed=("viewmats", "Ks", "pixels"),
    )


def work_of(case: Case, direction: str) -> dict[str, int]:
    """Return the operator's own counts."""
    leaves = case.leaves()
    images, _, meta = case.call(leaves)
    if direction == BOTH:
        gradients_of({"renders": images}, wanted(leaves), {"renders": case.cotangent})
    counts = {name: int(meta[name]) for name in (*WORK, *["tiles_skipped"] * (direction == BOTH))}
    return counts | {"gaussians": case.inputs["opacities"].numel()}


# Random and hostile cases.

_PLAIN_KINDS = (
    "uniform", "needles", "discs", "points", "all sizes", "huge on screen", "around the camera",
    "near plane", "opaque", "faint", "equal depths", "close depths", "heap", "far away", "off axis",
)  # fmt: skip
# kind -> options that it fixes or draws
KINDS: dict[str, dict] = {
    **dict.fromkeys(_PLAIN_KINDS, {}),
    "odd quaternions": {"use_quats": True, "dtype": "float32"},
    "edge of range": {},
    "not finite": {"poison": (1, 2, 9)},
    "empty": {"num": (0, 0, 10), "views": (0, 1)},
}
LEADS = {"none": (), "one": (1,), "two": (2,), "two by one": (2, 1)}
_DISTANCE = 1.6
MODES = ("RGB", "D", "ED", "RGB+D", "RGB+ED")
_SIDES = (1, 2, 3, 5, 8, 15, 16, 17, 18, 23, 31, 33, 40, 48)
_LARGEST = 100_000  # most pairs of pixel and Gaussian, times channels
OPTIONS = {
    "lead": ("none", "none", "none", *LEADS),
    "views": (1, 1, 2, 3),
    "num": (1, 2, 3, 10, 30, 64, 100, 200, 300),
    "width": _SIDES,
    "height": _SIDES,
    "channels": (1, 2, 3, 3, 3, 4, 5, 7, 16, 33),
    "dtype": ("float32", "float32", "float32", "bfloat16", "float16"),
    "mode": ("RGB", *MODES),
    "antialiased": (False, False, True),
    "sh_degree": mostly("none", ("none", "1", "3")),
    "backgrounds": (False, True),
    "colors_per_view": (*[False] * 4, True),
    "use_quats": (False, *[True] * 4),
    "skip": mostly(127, range(128)),
    "alpha_min": mostly(1 / 255, (1 / 255, 1e-4, 0.02)),
    "alpha_max": mostly(0.99, (0.99, 0.999, 0.9)),
    "eps2d": mostly(0.3, (0.3, 0.1, 1.0)),
    "radius_clip": mostly(0.0, (0.0, 2.0)),
    "poison": (0,),
    "colors": mostly("uniform", RANGES),
    "cotangent": COTANGENTS,
}


def _fit(options: dict) -> dict:
    """Return sizes that the oracle can hold, and options that go together."""
    o = dict(options)
    if o["sh_degree"] != "none":
        o |= {"channels": 3, "colors_per_view": False}
    each = max(1, math.prod(LEADS[o["lead"]])) * max(1, o["views"]) * (o["channels"] + 2)
    while each * o["num"] * o["width"] * o["height"] > _LARGEST:
        names = [name for name in ("width", "height", "num") if o[name] > 1]
        if not names:
            break
        largest = max(names, key=lambda k: o[k] / (8 if k == "num" else 1))
        o[largest] = (o[largest] + 1) // 2
    return o


def _points(kind: str, batch: int, num: int, g: torch.Generator) -> Tensor:
    """Return centres ``[B, N, 3]`` in the first camera's frame (float64)."""
    normal = torch.randn(batch, num, 3, generator=g).double()
    uniform = torch.rand(batch, num, generator=g).double()
    points = 0.3 * normal
    points[..., 2] += _DISTANCE
    if kind == "around the camera":
        sign = torch.where(uniform < 0.5, -1.0, 1.0)
        points = normal * 10 ** (-4 * uniform[..., None])
        points[..., 2] = sign * 10 ** (2 - 6 * torch.rand(batch, num, generator=g).double())
    elif kind == "near plane":
        points[..., 2] = 0.01 * (1 + normal[..., 2] * 10 ** (-8 * uniform))
        points[..., :2] *= 0.01
    elif kind == "equal depths":
        points[..., 2] = _DISTANCE
    elif kind == "close depths":
        points[..., 2] = _DISTANCE * (1 + 1e-7 * normal[..., 2])
    elif kind == "heap":
        points[..., :2] *= 1e-4
    elif kind == "far away":
        points *= 1e4
    return points


def _cameras(o: dict, kind: str, batch: int, g: torch.Generator) -> tuple[Tensor, Tensor]:
    """Return ``viewmats [B, V, 4, 4]`` (float64) that face the scene, and ``Ks [B, V, 3, 3]``."""
    views, width, height = o["views"], o["width"], o["height"]
    rotation, _ = torch.linalg.qr(torch.randn(batch, views, 3, 3, generator=g).double())
    if kind in ("equal depths", "close depths"):
        rotation = torch.eye(3).double().expand_as(rotation)
    elif views:  # the others near the first
        rotation = rotation[:, :1] @ torch.linalg.matrix_exp(0.1 * (rotation - rotation.mT))
    viewmats = torch.zeros(batch, views, 4, 4).double()
    viewmats[..., :3, :3], viewmats[..., 2, 3], viewmats[..., 3, 3] = rotation, _DISTANCE, 1.0
    if kind == "far away":
        viewmats[..., 2, 3] *= 1e4
    K = torch.tensor([[1.3 * width, 0, 0.55 * width], [0, 0.9 * height, 0.45 * height], [0, 0, 1]])
    Ks = K.repeat(batch, views, 1, 1)
    if kind == "off axis":
        Ks[..., :2, 2] *= 8 * torch.rand(batch, views, 2, generator=g) - 3.5
    return viewmats, Ks


def _shapes(o: dict, kind: str, sizes: tuple[int, int], g: dict) -> dict[str, Tensor | None]:
    """Return quaternions, scales (log-normal around 0.06 unless the kind differs), opacities."""
    quats = torch.randn(*sizes, 4, generator=g["quats"])
    if kind == "odd quaternions":  # of any length, 0 included; some have one entry only
        uniform = torch.rand(*sizes, 1, generator=g["quats"])
        quats = torch.nn.functional.normalize(quats, dim=-1) * 10 ** (60 * uniform - 30)
        quats = torch.where(uniform < 0.1, 0.0, quats)
        quats = torch.where(uniform > 0.8, quats * torch.tensor([0.0, 1, 0, 0]), quats)
    uniform = torch.rand(*sizes, 3, generator=g["scales"])
    normal = torch.randn(*sizes, 3, generator=g["scales"])
    first = torch.tensor([1.0, 0.0, 0.0]).expand(*sizes, 3)
    scales = {
        "needles": 10 ** (-5 + (4.5 + 2 * uniform) * first),
        "discs": 10 ** (-5 + (4.5 + uniform) * (1 - first)),
        "points": 1e-9 * torch.exp(normal),
        "all sizes": 10 ** (-9 + 12 * uniform),
        "huge on screen": 10 ** (4 * uniform - 1),
        "edge of range": 10 ** (4 + 12 * uniform),
        "near plane": 10 ** (2 * uniform - 3),
        "around the camera": 10 ** (3 * uniform - 4),
    }.get(kind, 0.06 * torch.exp(0.5 * normal))
    uniform = torch.rand(sizes, generator=g["opacities"])
    opacities = 0.99 * uniform + 0.005
    if kind == "opaque":  # at the clamp, just below and above it, and at 1
        near = o["alpha_max"] + 2e-3 * (uniform - 0.25)
        opacities = torch.where(uniform < 0.5, near, 1 - uniform / 9)
    elif kind == "faint":
        around = o["alpha_min"] * (1 + 10 ** (-7 * uniform))
        around = torch.where(uniform < 0.3, o["alpha_min"] * (0.9 + uniform), around)
        opacities = torch.where(uniform > 0.9, torch.full_like(uniform, o["alpha_min"]), around)
    elif kind in ("huge on screen", "edge of range", "heap"):
        opacities = 0.3 * uniform
    quats = quats if o["use_quats"] else None
    return {"quats": quats, "scales": scales, "opacities": opacities}


def build(case: RandomCase, device: torch.device) -> dict[str, Tensor | None]:
    """Return the leaves by argument, with the case's leading dimensions; Ks needs no gradient."""
    o, kind = case.options, case.kind
    lead, num = LEADS[o["lead"]], o["num"]
    batch = int(torch.tensor(lead).prod()) if lead else 1
    g = {name: generator(case, name) for name in (*LEAVES, "camera", "rest")}
    viewmats, Ks = _cameras(o, kind, batch, g["camera"])
    points = _points(kind, batch, num, g["means"])
    if o["views"]:  # to the world: Rᵀ (p - t)
        points = (points - viewmats[:, :1, :3, 3]) @ viewmats[:, 0, :3, :3]
    colors = (batch, num, 16 if o["sh_degree"] == "3" else 5, 3)
    if o["sh_degree"] == "none":
        colors = (batch, *([o["views"]] if o["colors_per_view"] else []), num, o["channels"])
    leaves = {
        "means": points.float(),
        **_shapes(o, kind, (batch, num), g),
        "colors": fill(colors, o["colors"], g["colors"]),
    }
    dtype = DTYPES[o["dtype"]]
    limit = torch.finfo(dtype).max
    leaves = {k: x if x is None else x.clamp(-limit, limit).to(dtype) for k, x in leaves.items()}
    leaves |= {"viewmats": viewmats.float(), "Ks": Ks, "backgrounds": None}
    if o["backgrounds"]:
        shape = (batch, o["views"], o["channels"] if o["sh_degree"] == "none" else 3)
        leaves["backgrounds"] = torch.rand(shape, generator=g["rest"])
    shaped = {k: x if x is None else x.reshape(*lead, *x.shape[1:]) for k, x in leaves.items()}
    return {
        k: x if x is None else x.to(device).requires_grad_(k != "Ks") for k, x in shaped.items()
    }


def poisoned(case: RandomCase, x: dict[str, Tensor | None]) -> tuple[dict[str, Any], Tensor]:
    """Add Gaussians, each with one number that is not finite.

    Returns:
        The leaves with ``poison`` Gaussians strewn in, and where the old ones are, ``[N]``.
    """
    o, g = case.options, generator(case, "poison")
    num, more = o["num"], o["poison"]
    place = torch.randperm(num + more, generator=g)
    fresh, old = place[num:], place[:num].sort().values
    rows: dict[str, Tensor] = {}  # the axis of the Gaussians first
    for name in LEAVES:
        if (known := x[name]) is not None:
            before = known.detach().cpu().movedim(gaussians_axis(o, name), 0)
            rows[name] = torch.full((num + more, *before.shape[1:]), 0.5, dtype=before.dtype)
            rows[name][old] = before
    names = list(rows)
    for i in fresh.tolist():  # the same entry in all objects and views
        name = names[torch.randint(len(names), (), generator=g)]
        row = rows[name][i]
        if name != "opacities":
            row = row[..., torch.randint(row.shape[-1], (), generator=g)]
        if name == "colors" and o["sh_degree"] != "none":
            row = row[..., 0]  # the first coefficient is always used
        row.fill_((torch.nan, torch.inf, -torch.inf)[torch.randint(3, (), generator=g)])
    leaves: dict[str, Any] = {**x}
    for name, row in rows.items():
        row = row.movedim(0, gaussians_axis(o, name)).contiguous()
        leaves[name] = row.to(leaves[name].device).requires_grad_()
    return leaves, old


def gaussians_axis(o: dict, name: str) -> int:
    """Return the dimension of a leaf that indexes the Gaussians."""
    return len(LEADS[o["lead"]]) + (name == "colors" and o["colors_per_view"])


def exact_image(case: RandomCase, x: dict[str, Tensor | None], trial: int = 0) -> tuple[dict, View]:
    """Return the leaves by name, and all views in float64, as ``rasterization`` renders them.

    Each of the view's tensors is ``[.., *lead, V, H, W, C + 1]``; the last channel is alpha.
    """
    o, r, lead = case.options, Rounding(case.seed, trial), LEADS[case.options["lead"]]
    leaves = {k: samples_of(t) for k, t in x.items() if t is not None and k != "Ks"}
    if not o["views"]:
        colors = 3 if o["sh_degree"] != "none" else o["channels"]
        channels = {"RGB": colors, "D": 1, "ED": 1}.get(o["mode"], colors + 1) + 1
        blank = torch.zeros(SAMPLES, *lead, 0, o["height"], o["width"], channels)
        none = blank[0, ..., :1] > 0
        return leaves, View(blank, blank[0], none, none)
    count = math.prod(lead)
    objects = {k: t.reshape(SAMPLES, count, *t.shape[1 + len(lead) :]) for k, t in leaves.items()}
    Ks = x["Ks"]
    assert Ks is not None
    Ks = Ks.detach().cpu().double().reshape(count, o["views"], 3, 3)
    views = [
        _view(o, {k: t[:, b] for k, t in objects.items()}, v, Ks[b, v], r)
        for b in range(count)
        for v in range(o["views"])
    ]
    shape = *lead, o["views"], o["height"], o["width"]
    stacked = [torch.stack(parts, int(i == 0)) for i, parts in enumerate(zip(*views))]
    return leaves, View(*(t.reshape(*t.shape[: t.dim() - 3], *shape, t.shape[-1]) for t in stacked))


def _view(o: dict, x: dict[str, Tensor], v: int, K: Tensor, r: Rounding) -> View:
    """Render one object in one view: the channels of the mode on the background, and alpha."""
    gaussians: dict[str, Any] = {k: x.get(k) for k in LEAVES}
    if o["colors_per_view"]:
        gaussians["colors"] = gaussians["colors"][:, v]
    names = ("width", "height", "alpha_min", "alpha_max", "eps2d", "radius_clip", "antialiased")
    options = ViewOptions(**{k: o[k] for k in names}, sh_degree=_degree(o))
    W, w = x["viewmats"][:, v, :3, :3], x["viewmats"][:, v, :3, 3]
    view = render_view(gaussians, W, w, K, options, r)
    parts = [view.blended.shape[-1] - 3, 1, 1, 1]
    color, depth, weight, alpha = view.blended.split(parts, dim=-1)
    more, more_depth, more_weight, more_alpha = view.allowance.split(parts, dim=-1)
    if "backgrounds" in x:
        background = x["backgrounds"][:, v][:, None]
        color = r(color + r(r(1 - alpha) * background))
        more = more + more_alpha * background[0].detach().abs()
    if o["mode"].endswith("ED"):
        depth = r(depth / weight.clamp_min(1e-10))
        least = (weight[0].detach() - more_weight).clamp_min(1e-10)
        more_depth = (more_depth + depth[0].detach() * more_weight) / least
        more_depth = more_depth * view.undecided
    words = o["mode"].split("+")
    blended = [color] * (words[0] == "RGB") + [depth] * (words[-1] != "RGB") + [alpha]
    slack = [more] * (words[0] == "RGB") + [more_depth] * (words[-1] != "RGB") + [more_alpha]
    return view._replace(blended=torch.cat(blended, -1), allowance=torch.cat(slack, -1))


def _degree(o: dict) -> int | None:
    return None if o["sh_degree"] == "none" else int(o["sh_degree"])


# The dimensions of a gradient that are taken together: the entries of one Gaussian.
_PARTS = {
    "means": (-1,), "quats": (-1,), "scales": (-1,), "opacities": (), "colors": (-1,),
    "viewmats": (-2, -1), "backgrounds": (-1,),
}  # fmt: skip


def evaluate(case: RandomCase, device: torch.device, trial: int = 0) -> Outcome:
    """Run the operator; compare images pixel by pixel, gradients Gaussian by Gaussian."""
    o, x = case.options, build(case, device)
    leaves = {k: t for k, t in x.items() if t is not None and k != "Ks"}
    samples, image = exact_image(case, x, trial)
    names = ("alpha_min", "alpha_max", "eps2d", "radius_clip", "width", "height")

    def run(x: dict = x) -> dict[str, Tensor]:
        renders, alphas, _ = rasterization(
            **x,
            **{name: o[name] for name in names},
            render_mode=o["mode"],
            rasterize_mode="antialiased" if o["antialiased"] else "classic",
            sh_degree=_degree(o),
            skip=Skip.from_bits(o["skip"]),
        )
        return {"renders": renders, "alphas": alphas}

    expected = {"renders": image.blended[..., :-1], "alphas": image.blended[..., -1:]}
    runs = Runs(case, run, leaves, expected, samples, without=image.loose)
    outcome = runs.outcome(
        _PARTS,
        renders={"extra": image.allowance[..., :-1], "shown": ~image.undecided},
        alphas={"extra": image.allowance[..., -1:], "shown": ~image.undecided},
    )
    if o["poison"]:
        outcome.faults += _poison_faults(case, x, run, runs)
    outcome.pixels, outcome.undecided = image.undecided.numel(), int(image.undecided.sum())
    return outcome


def _poison_faults(case: RandomCase, x: dict, run, runs: Runs) -> list[str]:
    """List what Gaussians that are not finite change in image and gradients: no bit may."""
    bad, old = poisoned(case, x)
    again = run(bad)
    others = gradients_of(again, {k: bad[k] for k in runs.grads}, runs.cotangents)
    moved = [name for name, x in runs.results.items() if not torch.equal(x, again[name])]
    faults = [f"{name} changed by Gaussians that are not finite" for name in moved]
    for name, gradient in runs.grads.items():
        other, of_gaussian = others[name], name in LEAVES
        axis = gaussians_axis(case.options, name)
        kept = other.index_select(axis, old.to(other.device)) if of_gaussian else other
        # A gradient beyond its dtype's range is infinite, whatever the other Gaussians.
        beyond = ~fits(runs.expected_grads[name][0], kept.dtype).to(kept.device)
        allowed = int((beyond & ~kept.isfinite()).sum())
        if int((~other.isfinite()).sum()) > allowed:
            faults.append(f"gradient of {name} not finite next to Gaussians that are not")
        elif of_gaussian and not torch.equal(kept, gradient):
            faults.append(f"gradient of {name} changed by Gaussians that are not finite")
    return faults


OP = Op("raster", KINDS, OPTIONS, _fit, evaluate)
