"""Random and hostile cases of the rasterizer."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from ...rasterize import Skip, rasterization
from ..core.case import Case, Op, Option, Outcome, Runs, fits, fitted, gradients_of
from ..core.ranges import COTANGENTS, RANGES
from ..core.rounding import SAMPLES, Rounding, samples_of
from ..oracles.raster import Lens, View, render_view
from .raster_scene import GAUSSIAN, KINDS, LEADS, build, gaussians_axis, poisoned

MODES = ("RGB", "D", "ED", "RGB+D", "RGB+ED")
_SIDES = (1, 2, 3, 5, 8, 15, 16, 17, 18, 23, 31, 33, 40, 48)
_LARGEST = 100_000  # most pairs of pixel and Gaussian, times channels
OPTIONS = {
    "lead": Option("none", ("none", "none", *LEADS)),
    "views": Option(1, (1, 1, 2, 3)),
    "num": Option(1, (1, 2, 3, 10, 30, 64, 100, 200, 300)),
    "width": Option(1, _SIDES, span=(1, 10**6)),
    "height": Option(1, _SIDES, span=(1, 10**6)),
    "channels": Option(1, (1, 2, 3, 3, 3, 4, 5, 7, 16, 33), span=(1, 10**6)),
    "dtype": Option("float32", ("float32", "float32", "float32", "bfloat16", "float16")),
    "mode": Option("RGB", ("RGB", *MODES)),
    "antialiased": Option(False, 0.3),
    "sh_degree": Option("none", ("none", "1", "3"), 0.3),
    "backgrounds": Option(False, 0.5),
    "colors_per_view": Option(False, 0.2),
    "use_quats": Option(False, 0.8),
    "skip": Option(127, range(128), 0.2, span=(0, 127)),
    "alpha_min": Option(1 / 255, (1 / 255, 1e-4, 0.02), 0.3),
    "alpha_max": Option(0.99, (0.99, 0.999, 0.9), 0.3),
    "eps2d": Option(0.3, (0.3, 0.1, 1.0), 0.3),
    "radius_clip": Option(0.0, (0.0, 2.0), 0.3),
    "poison": Option(0, span=(0, 100)),
    "colors": Option("uniform", RANGES, 0.2),
    "cotangent": Option("normal", COTANGENTS, others=RANGES),
}


def _fit(options: dict) -> dict:
    """Sizes that the oracle can hold, options that go together."""
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
    return fitted(o, ("views", "num", "width", "height", "channels"), 5 * _LARGEST)


def truth(case: Case, x: dict[str, Tensor | None], trial: int = 0) -> tuple[dict, View]:
    """The leaves by name, and all views in float64, as ``rasterization`` renders them.

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
    made = [
        _view(o, {k: t[:, b] for k, t in objects.items()}, v, Ks[b, v], r)
        for b in range(count)
        for v in range(o["views"])
    ]
    shape = *lead, o["views"], o["height"], o["width"]
    stacked = [torch.stack(parts, int(i == 0)) for i, parts in enumerate(zip(*made))]
    return leaves, View(*(t.reshape(*t.shape[: t.dim() - 3], *shape, t.shape[-1]) for t in stacked))


def _view(o: dict, x: dict[str, Tensor], v: int, K: Tensor, r: Rounding) -> View:
    """One object in one view: the channels of the mode on the background, and alpha."""
    gaussians: dict[str, Any] = {k: x.get(k) for k in GAUSSIAN}
    if o["colors_per_view"]:
        gaussians["colors"] = gaussians["colors"][:, v]
    names = ("width", "height", "alpha_min", "alpha_max", "eps2d", "radius_clip", "antialiased")
    lens = Lens(**{k: o[k] for k in names}, sh_degree=_degree(o))
    W, w = x["viewmats"][:, v, :3, :3], x["viewmats"][:, v, :3, 3]
    view = render_view(gaussians, W, w, K, lens, r)
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


def evaluate(case: Case, device: torch.device, trial: int = 0) -> Outcome:
    """Runs the operator; pictures pixel by pixel, gradients Gaussian by Gaussian."""
    o, x = case.options, build(case, device)
    leaves = {k: t for k, t in x.items() if t is not None and k != "Ks"}
    samples, picture = truth(case, x, trial)
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

    truths = {"renders": picture.blended[..., :-1], "alphas": picture.blended[..., -1:]}
    runs = Runs(case, run, leaves, truths, samples, without=picture.loose)
    outcome = runs.outcome(
        _PARTS,
        renders={"extra": picture.allowance[..., :-1], "shown": ~picture.undecided},
        alphas={"extra": picture.allowance[..., -1:], "shown": ~picture.undecided},
    )
    if o["poison"]:
        outcome.faults += _poison_faults(case, x, run, runs)
    outcome.pixels, outcome.undecided = picture.undecided.numel(), int(picture.undecided.sum())
    return outcome


def _poison_faults(case: Case, x: dict, run, runs: Runs) -> list[str]:
    """Gaussians that are not finite must change no bit of the picture, nor of the gradients."""
    bad, old = poisoned(case, x)
    again = run(bad)
    others = gradients_of(again, {k: bad[k] for k in runs.grads}, runs.cotangents)
    faults = [f"{n} changed by Gaussians that are not finite" for n, x in runs.results.items()
              if not torch.equal(x, again[n])]  # fmt: skip
    for name, gradient in runs.grads.items():
        other, of_gaussian = others[name], name in GAUSSIAN
        axis = gaussians_axis(case.options, name)
        kept = other.index_select(axis, old.to(other.device)) if of_gaussian else other
        # A gradient beyond its dtype's range is infinite, beside whatever Gaussians.
        beyond = ~fits(runs.true_grads[name][0], kept.dtype).to(kept.device)
        allowed = int((beyond & ~kept.isfinite()).sum())
        if int((~other.isfinite()).sum()) > allowed:
            faults.append(f"gradient of {name} not finite beside Gaussians that are not")
        elif of_gaussian and not torch.equal(kept, gradient):
            faults.append(f"gradient of {name} changed by Gaussians that are not finite")
    return faults


OP = Op("raster", KINDS, OPTIONS, _fit, evaluate)
