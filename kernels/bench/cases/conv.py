"""Cases of the causal convolution, and the targets on them."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

from ...causal_conv1d import causal_conv1d
from ...causal_conv1d.reference import causal_conv1d_reference
from .. import peers
from ..core.case import Case, Error, Key, Settings, Target, Variant, compare, make_cases

LIMIT = 1e-6
HALF_LIMITS = {torch.bfloat16: 1e-2, torch.float16: 2e-3}
BOTH = "forward+backward"
_TAPS = 4
_SIZES = {"quick": (1024, 256), "normal": (16961, 1024), "full": (16961, 1024)}
_TOKENS = 2048  # that the oracle looks at


def cases(settings: Settings) -> list[Case]:
    """All cases of the convolution at the level's sizes."""
    builders = [("operator", operator, None), ("knobs", knobs, "error")]
    return make_cases("conv", settings, builders)


class _Problem:
    """Inputs, and the oracle on all channels of the first tokens."""

    def __init__(self, settings: Settings):
        self.length, self.width = _SIZES[settings.level]
        self.device = settings.device
        g = torch.Generator().manual_seed(0)
        self.inputs = {
            "x": torch.randn(1, self.length, self.width, generator=g),
            "weight": torch.rand(self.width, _TAPS, generator=g) - 0.5,
            "bias": torch.rand(self.width, generator=g) - 0.5,
        }
        self.cotangent = torch.randn(1, self.length, self.width, generator=g)
        self.tokens = min(self.length, _TOKENS)
        self._truth: dict[str, Tensor] = {}

    @property
    def oracle(self) -> str:
        part = "" if self.tokens == self.length else f", first {self.tokens} tokens"
        return f"float64 sum{part}"

    def truth(self) -> dict[str, Tensor]:
        if not self._truth:
            leaves = {k: v.double() for k, v in self.inputs.items()}
            leaves["x"] = leaves["x"][:, : self.tokens]
            leaves = {k: v.requires_grad_() for k, v in leaves.items()}
            out, _ = causal_conv1d_reference(**leaves, activation="silu")
            cotangent = self.cotangent[:, : self.tokens].double()
            grads = torch.autograd.grad(out, list(leaves.values()), cotangent)
            self._truth = {"out": out.detach(), **dict(zip(leaves, grads))}
        return self._truth

    def variant(
        self,
        name: str,
        function: Callable,
        direction: str,
        dtype: torch.dtype = torch.float32,
        channels_first: bool = False,
        **changes,
    ) -> Variant:
        """A variant that calls ``function(x, weight, bias)``, in its own layout."""
        x = self.inputs["x"].to(self.device, dtype)
        cotangent = self.cotangent.to(self.device, dtype)
        if channels_first:
            x, cotangent = x.mT.contiguous(), cotangent.mT.contiguous()
        own = dtype if channels_first else torch.float32  # peers want one dtype
        rest = {k: self.inputs[k].to(self.device, own) for k in ("weight", "bias")}
        inputs = {"x": x, **rest}

        def forward() -> Tensor:
            with torch.no_grad():
                return function(**inputs)

        def backward(cotangent: Tensor = cotangent) -> tuple[Tensor, ...]:
            leaves = {k: v.detach().requires_grad_() for k, v in inputs.items()}
            return torch.autograd.grad(function(**leaves), list(leaves.values()), cotangent)

        def check() -> Error:
            out = forward()
            got = {"out": out.mT if channels_first else out}
            if direction == BOTH:
                head = cotangent.clone()
                head.narrow(2 if channels_first else 1, self.tokens, self.length - self.tokens)[
                    :
                ] = 0
                got |= dict(zip(inputs, backward(head)))
                got["x"] = got["x"].mT if channels_first else got["x"]
            got = {k: v[:, : self.tokens] if k in ("out", "x") else v for k, v in got.items()}
            return compare(got, {k: self.truth()[k] for k in got})

        return Variant(
            name,
            forward if direction == "forward" else backward,
            check,
            HALF_LIMITS.get(dtype, LIMIT if direction == "forward" else 10 * LIMIT),
            self.oracle,
            direction,
            str(dtype).removeprefix("torch."),
            parameters={"B": 1, "L": self.length, "D": self.width, "taps": _TAPS},
            **changes,
        )


_silu = partial(causal_conv1d, activation="silu")


def operator(settings: Settings) -> list[Variant]:
    """Convolution and SiLU beside torch's grouped convolution in its own layout."""
    problem = _Problem(settings)
    made = []
    for direction in ("forward", BOTH):
        made.append(problem.variant("default", _silu, direction, default=True))
        peer = partial(problem.variant, direction=direction, channels_first=True, peer=True)
        made.append(peer("torch conv1d", peers.torch_conv, rounds=10))
        if settings.peers and settings.device.type == "cuda":
            made.append(peer("causal-conv1d", peers.causal_conv1d))
    return made


def knobs(settings: Settings) -> list[Variant]:
    """Half precision is compared with the truth of the float32 inputs."""
    problem = _Problem(settings)
    made = []
    for dtype in (torch.float32, torch.bfloat16, torch.float16):
        name = str(dtype).removeprefix("torch.")
        for direction in ("forward", BOTH):
            default = dtype == torch.float32
            made.append(problem.variant(name, _silu, direction, dtype, default=default))
    return made


def targets(settings: Settings) -> list[Target]:
    """What should be reached; nothing at a quick run's sizes."""
    if settings.level == "quick":
        return []
    return [
        Target(
            f"{direction}, torch conv1d's time over ours",
            (Key("conv", "operator", "torch conv1d", direction),),
            (Key("conv", "operator", "default", direction),),
            at_least=1,
        )
        for direction in ("forward", BOTH)
    ]
