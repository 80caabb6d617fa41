"""Benchmark cases of the losses of a step: SSIM beside kornia's, LPIPS in layouts and dtypes."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, cosine_similarity

from gamba_warp.image_metrics import SSIM_WINDOW, ssim
from gamba_warp.kernels.bench.core.case import (
    Error,
    NotInstalled,
    Settings,
    Variant,
    compare,
)
from gamba_warp.train.objective.losses import structure
from gamba_warp.vision.lpips import LPIPS, load_lpips
from gamba_warp.vision.weights import lpips_available, read_cached

from ..targets import Key, Target
from .made_up import BATCH, BOTH, NOVEL, OP, SIZE, views

SSIM_TEXT = (
    f"1 - SSIM of {BATCH * (NOVEL + 1)} pictures of {SIZE}² with its gradient: objects before "
    "white, whose equal backgrounds ours leaves out, and pictures that differ everywhere. Error: "
    "of value and gradient, the worse of both, to kornia's in float64."
)
LPIPS_TEXT = (
    f"LPIPS of {BATCH} crops with its gradient, by layout and dtype. The error is that of the "
    "value to float64; beside it stands that of the gradient, as a share and as 1 - cosine. Block "
    "5 in bfloat16 is what --precision bfloat16 takes: also the gradient is made by products in "
    "bfloat16 there, through the ReLUs of float32. All in bfloat16 moves the ReLUs."
)
_CROP = 64
_SSIM_LIMIT, _LPIPS_LIMIT = 1e-5, 3e-2  # the second allows for bfloat16 in single values
OURS, THEIRS = "ours", "kornia"


def ssim_targets(settings: Settings) -> list[Target]:
    """Return the targets of SSIM; none at a quick run's sizes."""
    if settings.level == "quick":
        return []
    return [
        Target(
            text=f"1 - SSIM with gradient, {where}: kornia's time over ours",
            times=(Key(OP, "SSIM", f"{THEIRS}, {where}", BOTH),),
            over=(Key(OP, "SSIM", f"{OURS}, {where}", BOTH),),
            at_least=5.0,
        )
        for where in ("objects", "all over")
    ]


@dataclass
class _Pair:
    """Pictures under test and true ones, ``[B, H, W, 3]``, and a loss ``(got, want) -> [B]``."""

    got: Tensor
    want: Tensor
    loss: Callable[[Tensor, Tensor], Tensor]

    def run(self, double: bool = False) -> dict[str, Tensor]:
        """Make value and gradient; timed."""
        kind = torch.float64 if double else torch.float32
        got = self.got.to(kind, copy=True).requires_grad_()
        value = self.loss(got, self.want.to(kind))
        return {"value": value, "gradient": torch.autograd.grad(value.sum(), got)[0]}


def _pictures(settings: Settings, everywhere: bool) -> tuple[Tensor, Tensor]:
    """True pictures of made-up objects before white, and smoothed ones with a little noise."""
    torch.manual_seed(0)
    rgba = views(settings, BATCH * (NOVEL + 1))
    color, alpha = rgba[..., :3], rgba[..., 3:]
    noisy = avg_pool2d(color.movedim(-1, 1), 5, 1, 2).movedim(1, -1)
    noisy = noisy + 0.03 * torch.randn_like(color)
    if everywhere:
        return noisy.to(settings.device), color.to(settings.device)
    made = [c * alpha + 1 - alpha for c in (noisy, color)]
    return made[0].to(settings.device), made[1].to(settings.device)


def _kornia(got: Tensor, want: Tensor) -> Tensor:
    """Result of kornia, in the dtype of the pictures."""
    try:
        from kornia.metrics import ssim as ssim_map
    except ModuleNotFoundError as error:
        raise NotInstalled(str(error.name)) from None
    x, y = (p.movedim(-1, 1) for p in (got, want))
    values = ssim_map(x, y, SSIM_WINDOW, max_val=1.0, eps=0.0, padding="valid")
    return 1 - values.mean((1, 2, 3))


def ssim_variants(settings: Settings) -> list[Variant]:
    """The variants of the case SSIM."""
    made = []
    for where in ("objects", "all over"):
        got, want = _pictures(settings, where == "all over")
        truth = _Pair(got, want, lambda a, b: 1 - ssim(a, b))

        def check(pair: _Pair, truth: _Pair = truth) -> Error:
            return compare(pair.run(), truth.run(double=True))

        for name, loss in ((OURS, structure), (THEIRS, _kornia)):
            pair = _Pair(got, want, loss)
            made.append(
                Variant(
                    name=f"{name}, {where}",
                    run=pair.run,
                    check=partial(check, pair),
                    # kornia's float32 loses digits where pictures are flat; it is timed anyway
                    limit=_SSIM_LIMIT if name == OURS else 1.0,
                    oracle="kornia's in float64",
                    direction=BOTH,
                    peer=name == THEIRS,
                    default=name == OURS,
                    parameters={"B": len(got), "side": got.shape[1], "pictures": where},
                )
            )
    return made


def _one_pass(network: LPIPS, got: Tensor, want: Tensor) -> Tensor:
    """Both pictures as one batch; the gradient is made for both halves."""
    both = network.features(torch.cat([got, want]))
    count = len(got)
    return network.distance([x[:count] for x in both], [x[count:].detach() for x in both])


def _autocast(network: LPIPS, got: Tensor, want: Tensor) -> Tensor:
    with torch.autocast(got.device.type, torch.bfloat16):
        return network(got, want)


class _Doubled(LPIPS):
    """LPIPS whose features stay float64."""

    def features(self, pictures: Tensor) -> list[Tensor]:
        x = pictures.movedim(-1, 1)
        found = self.trunk((2 * x - 1 - self.shift) / self.scale)
        return [y / (y.square().sum(1, keepdim=True) + 1e-20).sqrt() for y in found]


def lpips_variants(settings: Settings) -> list[Variant]:
    """The variants of the case LPIPS; none without its weights."""
    if not lpips_available():
        raise NotInstalled("the LPIPS weights (gamba weights lpips)")
    network = load_lpips().to(settings.device)
    planes = copy.deepcopy(network)
    planes.trunk.to(memory_format=torch.contiguous_format)
    doubled = _Doubled(read_cached()).to(settings.device).double()
    got, want = (x[:BATCH, :_CROP, :_CROP].contiguous() for x in _pictures(settings, True))
    truth = _Pair(got, want, doubled).run(double=True)
    half = torch.bfloat16
    ways: dict[str, Callable[[Tensor, Tensor], Tensor]] = {
        "float32": network,
        "float32, planes first": planes,
        "float32, one pass": partial(_one_pass, network),
        "block 5 in bfloat16": partial(network, precision=half),
        "all in bfloat16 (autocast)": partial(_autocast, network),
    }
    made = []
    for name, loss in ways.items():
        pair = _Pair(got, want, loss)
        made.append(
            Variant(
                name=name,
                run=pair.run,
                check=partial(_check_value, pair, truth),
                limit=_LPIPS_LIMIT,
                oracle="float64",
                direction=BOTH,
                dtype="bfloat16" if "bfloat16" in name else "float32",
                default=name in ("float32", "block 5 in bfloat16"),
                parameters={"B": BATCH, "side": _CROP},
                work=partial(_gradient, pair, truth),
            )
        )
    return made


def _check_value(pair: _Pair, truth: dict[str, Tensor]) -> Error:
    return compare({"value": pair.run()["value"]}, {"value": truth["value"]})


def _gradient(pair: _Pair, truth: dict[str, Tensor]) -> dict[str, float]:
    """Error of the gradient."""
    got, want = (v["gradient"].detach().double().flatten() for v in (pair.run(), truth))
    error = (got - want).norm() / want.norm()
    cosine = 1 - cosine_similarity(got, want, 0)
    return {"gradient_error": float(f"{error:.2g}"), "gradient_angle": float(f"{cosine:.2g}")}
