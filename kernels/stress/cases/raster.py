"""Random and hostile cases of the rasterizer."""

from __future__ import annotations

import math
from random import Random
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ...rasterize import Skip, rasterization
from ..core import case as core
from ..core.case import DTYPES, FACTOR, Case, Comparison, Op, Outcome, fitted, generator, judge
from ..core.ranges import RANGES, fill
from ..core.rounding import SAMPLES, UNIT, Rounding, samples_of
from ..oracles.raster import Lens, render_view
from .raster_scene import GAUSSIAN, KINDS, LEADS, build, poisoned
from .scan import gradients_of, repeated

MODES = ("RGB", "D", "ED", "RGB+D", "RGB+ED")
_SIDES = (1, 2, 3, 5, 8, 15, 16, 17, 18, 23, 31, 33, 40, 48)
_LARGEST = 100_000  # most pairs of pixel and Gaussian, times channels
_PLAIN = {
    "lead": "none", "views": 1, "num": 1, "width": 1, "height": 1, "channels": 1,
    "dtype": "float32", "mode": "RGB", "antialiased": False, "sh_degree": "none",
    "backgrounds": False, "colors_per_view": False, "use_quats": False, "skip": 127,
    "alpha_min": 1 / 255, "alpha_max": 0.99, "eps2d": 0.3, "radius_clip": 0.0, "poison": 0,
    "colors": "uniform", "cotangent": "normal",
}  # fmt: skip
_CHOICES = {
    "lead": tuple(LEADS), "dtype": tuple(DTYPES), "mode": MODES, "sh_degree": ("none", "1", "3"),
    "alpha_min": (1 / 255, 1e-4, 0.02), "alpha_max": (0.99, 0.999, 0.9), "eps2d": (0.3, 0.1, 1.0),
    "radius_clip": (0.0, 2.0), "colors": RANGES, "cotangent": RANGES,
}  # fmt: skip


def draw(rng: Random, kind: str) -> dict:
    """Random options."""
    flag = lambda chance=0.5: rng.random() < chance  # noqa: E731
    pick = lambda name: rng.choice(_CHOICES[name]) if flag(0.3) else _PLAIN[name]  # noqa: E731
    options = dict(
        lead=rng.choice(("none", "none", *LEADS)), views=rng.choice((1, 1, 2, 3)),
        num=rng.choice((1, 2, 3, 10, 30, 64, 100, 200, 300)), width=rng.choice(_SIDES),
        height=rng.choice(_SIDES), channels=rng.choice((1, 2, 3, 3, 3, 4, 5, 7, 16, 33)),
        dtype=rng.choice(("float32", "float32", "float32", "bfloat16", "float16")),
        mode=rng.choice(("RGB", *MODES)), antialiased=flag(0.3), sh_degree=pick("sh_degree"),
        backgrounds=flag(), colors_per_view=flag(0.2), use_quats=flag(0.8),
        skip=rng.randrange(128) if flag(0.2) else 127, alpha_min=pick("alpha_min"),
        alpha_max=pick("alpha_max"), eps2d=pick("eps2d"), radius_clip=pick("radius_clip"),
        poison=rng.choice((1, 2, 9)) if kind == "not finite" else 0,
        colors=rng.choice(RANGES) if flag(0.2) else "uniform",
        cotangent=rng.choice(("normal", "normal", "ones", "spikes", "zeros")),
    )  # fmt: skip
    if kind == "empty":
        options[rng.choice(("num", "views"))] = 0
    if kind == "odd quaternions":
        options |= {"use_quats": True, "dtype": "float32"}
    return valid(options)


def valid(options: dict) -> dict:
    """Sizes that the oracle can hold, options that go together."""
    o = dict(options)
    o |= {k: max(1, o[k]) for k in ("width", "height", "channels")}
    if o["sh_degree"] != "none":
        o |= {"channels": 3, "colors_per_view": False}
    o["skip"] = min(o["skip"], 127)
    each = max(1, math.prod(LEADS[o["lead"]])) * max(1, o["views"]) * (o["channels"] + 2)
    while each * o["num"] * o["width"] * o["height"] > _LARGEST:
        names = [name for name in ("width", "height", "num") if o[name] > 1]
        if not names:
            break
        largest = max(names, key=lambda k: o[k] / (8 if k == "num" else 1))
        o[largest] = (o[largest] + 1) // 2
    o["poison"] = min(o["poison"], 100)
    return fitted(o, ("views", "num", "width", "height", "channels"), 5 * _LARGEST)


def _options(o: dict) -> dict:
    """The options that ``rasterization`` is called with."""
    names = ("alpha_min", "alpha_max", "eps2d", "radius_clip", "width", "height")
    return {name: o[name] for name in names} | dict(
        render_mode=o["mode"], rasterize_mode="antialiased" if o["antialiased"] else "classic",
        sh_degree=None if o["sh_degree"] == "none" else int(o["sh_degree"]),
        skip=Skip.from_bits(o["skip"]),
    )  # fmt: skip


class _Pixels(NamedTuple):
    """A view's pixels, ``[H W, C]``.

    Attributes:
        renders: ``[SAMPLES, H W, C]``, as ``rasterization`` renders them.
        alphas: ``[SAMPLES, H W, 1]``.
        extra: by how much an undecided pixel of the picture may differ besides.
        extra_alpha: likewise of alpha.
        undecided: whether a cut or an order is within rounding.
        loose: or a clamp is, so that no gradient is asked for.
    """

    renders: Tensor
    alphas: Tensor
    extra: Tensor
    extra_alpha: Tensor
    undecided: Tensor
    loose: Tensor


class _Truth:
    """The picture in float64, sample by sample, and where rounding decides."""

    def __init__(self, case: Case, x: dict[str, Tensor | None], trial: int = 0) -> None:
        self.o, lead = case.options, LEADS[case.options["lead"]]
        self.lead, self.batch, self.views = lead, math.prod(lead), self.o["views"]
        self.leaves = {k: samples_of(t) for k, t in x.items() if t is not None and k != "Ks"}
        self.flat = {
            k: t.reshape(len(t), self.batch, *t.shape[1 + len(lead) :])
            for k, t in self.leaves.items()
        }
        Ks = x["Ks"]
        assert Ks is not None
        self.Ks = Ks.detach().cpu().double().reshape(self.batch, self.views, 3, 3)
        names = ("width", "height", "alpha_min", "alpha_max", "eps2d", "radius_clip", "antialiased")
        degree = None if self.o["sh_degree"] == "none" else int(self.o["sh_degree"])
        self.lens = Lens(**{k: self.o[k] for k in names}, sh_degree=degree)
        self.round = Rounding(case.seed, trial)
        pairs = [(b, v) for b in range(self.batch) for v in range(self.views)]
        made = [self._view(b, v) for b, v in pairs] or [self._blank()]
        self.renders = self._together([view.renders for view in made], sampled=True)
        self.alphas = self._together([view.alphas for view in made], sampled=True)
        self.extra = self._together([view.extra for view in made])
        self.extra_alpha = self._together([view.extra_alpha for view in made])
        self.undecided = self._together([view.undecided for view in made])
        self.loose = self._together([view.loose for view in made])

    def _together(self, parts: list[Tensor], sampled: bool = False) -> Tensor:
        """All views ``[.., H W, C]`` as one tensor ``[.., *lead, V, H, W, C]``."""
        stacked = torch.stack(parts, int(sampled))
        if not self.views:
            stacked = stacked.narrow(int(sampled), 0, 0)
        shape = (*self.lead, self.views, self.o["height"], self.o["width"], stacked.shape[-1])
        return stacked.reshape(*stacked.shape[: int(sampled)], *shape)

    def _blank(self) -> _Pixels:
        """An empty view, in the form of ``_view``."""
        color = 3 if self.o["sh_degree"] != "none" else self.o["channels"]
        size = {"RGB": color, "D": 1, "ED": 1}.get(self.o["mode"], color + 1)
        pixels = self.o["height"] * self.o["width"]
        picture, one = torch.zeros(SAMPLES, pixels, size), torch.zeros(SAMPLES, pixels, 1)
        none = one[0] > 0
        return _Pixels(picture, one, picture[0], one[0], undecided=none, loose=none)

    def _view(self, b: int, v: int) -> _Pixels:
        r, x = self.round, {k: t[:, b] for k, t in self.flat.items()}
        gaussians: dict[str, Any] = {k: x.get(k) for k in GAUSSIAN}
        if self.o["colors_per_view"]:
            gaussians["colors"] = gaussians["colors"][:, v]
        W, w = x["viewmats"][:, v, :3, :3], x["viewmats"][:, v, :3, 3]
        view, top = render_view(gaussians, W, w, self.Ks[b, v], self.lens, r)
        parts = [view.blended.shape[-1] - 3, 1, 1, 1]
        color, depth, weight, alpha = view.blended.split(parts, dim=-1)
        slack = view.allowance + FACTOR * UNIT * torch.cat([top, torch.ones(1)])
        more, more_depth, more_weight, more_alpha = slack.split(parts, dim=-1)
        if "backgrounds" in x:
            background = x["backgrounds"][:, v][:, None]
            color = r(color + r(r(1 - alpha) * background))
            more = more + more_alpha * background[0].detach().abs()
        if self.o["mode"].endswith("ED"):
            depth = r(depth / weight.clamp_min(1e-10))
            least = (weight[0].detach() - more_weight).clamp_min(1e-10)
            more_depth = (more_depth + depth[0].detach() * more_weight) / least
            more_depth = more_depth * view.undecided[:, None]
        if "+" in self.o["mode"]:
            color, more = torch.cat([color, depth], -1), torch.cat([more, more_depth], -1)
        elif self.o["mode"] != "RGB":
            color, more = depth, more_depth
        undecided, loose = view.undecided[:, None], view.loose[:, None]
        return _Pixels(color, alpha, more, more_alpha, undecided=undecided, loose=loose)


# The dimensions of a gradient that are taken together: the entries of one Gaussian.
_PARTS = {
    "means": (-1,), "quats": (-1,), "scales": (-1,), "opacities": (), "colors": (-1,),
    "viewmats": (-2, -1), "backgrounds": (-1,),
}  # fmt: skip


def evaluate(case: Case, device: torch.device, trial: int = 0) -> Outcome:
    """Runs the operator; pictures pixel by pixel, gradients Gaussian by Gaussian."""
    x = build(case, device)
    leaves = {k: t for k, t in x.items() if t is not None and k != "Ks"}
    truth = _Truth(case, x, trial)
    cotangents = {}
    for name, like in (("renders", truth.renders), ("alphas", truth.alphas)):
        values = fill(like.shape[1:], case.options["cotangent"], generator(case, f"v_{name}"))
        cotangents[name] = torch.where(truth.loose, 0.0, values) if like.numel() else values

    def run(x: dict = x) -> dict[str, Tensor]:
        renders, alphas, _ = rasterization(**x, **_options(case.options))
        return {"renders": renders, "alphas": alphas}

    results, grads, faults = repeated(run, cotangents, leaves)
    named = {"renders": truth.renders, "alphas": truth.alphas}
    true_grads = gradients_of(named, truth.leaves, cotangents)
    made: list[Comparison] = [
        judge("renders", results["renders"], truth.renders, (), truth.extra, ~truth.undecided),
        judge("alphas", results["alphas"], truth.alphas, (), truth.extra_alpha, ~truth.undecided),
    ]
    made += [judge(f"gradient of {k}", g, true_grads[k], _PARTS[k]) for k, g in grads.items()]
    if case.options["poison"]:
        faults += _poison_faults(case, x, run, results, grads, true_grads, cotangents)
    return Outcome(made, faults, truth.undecided.numel(), int(truth.undecided.sum()))


def _poison_faults(case: Case, x, run, results, grads, true_grads, cotangents) -> list[str]:
    """Gaussians that are not finite must change no bit of the picture, nor of the gradients."""
    bad, old = poisoned(case, x)
    again = run(bad)
    leaves = {k: bad[k] for k in grads}
    others = gradients_of(again, leaves, cotangents)
    faults = [f"{n} changed by Gaussians that are not finite" for n in results
              if not torch.equal(results[n], again[n])]  # fmt: skip
    lead = len(LEADS[case.options["lead"]])
    for name, gradient in grads.items():
        other, of_gaussian = others[name], name in GAUSSIAN
        axis = lead + (1 if name == "colors" and case.options["colors_per_view"] else 0)
        kept = other.index_select(axis, old.to(other.device)) if of_gaussian else other
        # A gradient beyond its dtype's range is infinite, beside whatever Gaussians.
        beyond = ~core.fits(true_grads[name][0], kept.dtype).to(kept.device)
        allowed = int((beyond & ~kept.isfinite()).sum())
        if int((~other.isfinite()).sum()) > allowed:
            faults.append(f"gradient of {name} not finite beside Gaussians that are not")
        elif of_gaussian and not torch.equal(kept, gradient):
            faults.append(f"gradient of {name} changed by Gaussians that are not finite")
    return faults


OP = Op(
    name="raster",
    kinds=KINDS,
    plain=_PLAIN,
    choices=_CHOICES,
    draw=draw,
    valid=valid,
    evaluate=evaluate,
)
