"""Operators at realistic sizes: inputs by name, runs, and the error to a formula in float64."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import torch
from torch import Tensor

BOTH = "forward+backward"
DIRECTIONS = ("forward", BOTH)


class Error(NamedTuple):
    """Distance of results from the truth.

    Attributes:
        rel_rms: rms of the difference over rms of the truth, of the worst tensor.
        maximum: largest difference over the largest value of the truth, of the worst tensor.
        worst: name of the tensor with that ``rel_rms``.
    """

    rel_rms: float
    maximum: float
    worst: str


def compare(got: Mapping[str, Tensor], want: Mapping[str, Tensor]) -> Error:
    """Return the error of named results in float64; NaN or a wrong shape makes it infinite."""
    rel_rms, maximum, worst = 0.0, 0.0, ""
    for name, truth in want.items():
        value, truth = got[name].detach().double().cpu(), truth.detach().double().cpu()
        if value.shape != truth.shape or not value.isfinite().all():
            return Error(math.inf, math.inf, name)
        if not truth.numel():
            continue
        difference = value - truth
        # If the truth is all zeros, the absolute difference is used.
        rms = truth.square().mean().sqrt().item() or 1.0
        relative = difference.square().mean().sqrt().item() / rms
        if relative >= rel_rms:
            rel_rms, worst = relative, name
        maximum = max(maximum, (difference.abs().max() / (truth.abs().max() or 1.0)).item())
    return Error(rel_rms, maximum, worst)


@dataclass(eq=False)
class Operator:
    """An operator of tensors by name, and its formula.

    The oracle may see a corner of the problem, as the first tokens and a few channels, if the
    operator's results there depend on nothing else. For gradients the cotangent is 0 outside the
    corner, so that gradients of shared inputs are exact as well.

    Attributes:
        function: of the inputs by name and of options; the output.
        reference: the formula, likewise, of the corner.
        inputs: float32 on the CPU, the truth that every dtype is compared with.
        cotangent: of the output, for the clock; the check draws its own.
        device: device of the operator.
        text: the oracle in words.
        sizes: for the records.
        limits: largest relative rms error to float64 by direction.
        half_limits: limits in half precision, explained by the rounding of inputs and output.
        cast: names of the inputs that a dtype holds for.
        corner: index of the corner by name of an input, or "out".
        transposed: inputs, and "out", whose last two dimensions are exchanged for ``function``.
        fixed: inputs without a gradient.
        compared: True to compare gradients too, not only the output.
    """

    function: Callable[..., Tensor]
    reference: Callable[..., Tensor]
    inputs: dict[str, Tensor]
    cotangent: Tensor
    device: torch.device
    text: str
    sizes: dict[str, int]
    limits: Mapping[str, float]
    half_limits: Mapping[torch.dtype, float] = field(default_factory=dict)
    cast: tuple[str, ...] = ()
    corner: Mapping[str, Any] = field(default_factory=dict)
    transposed: tuple[str, ...] = ()
    fixed: tuple[str, ...] = ()
    compared: bool = True
    truths: dict = field(default_factory=dict)
    _laid: dict = field(default_factory=dict, init=False)

    def oracle(self, direction: str) -> str:
        """Return a description of the reference."""
        return self.text + (", output only" if direction == BOTH and not self.compared else "")

    def limit(self, direction: str, dtype: torch.dtype = torch.float32) -> float:
        """Return the largest error that is allowed."""
        return self.half_limits.get(dtype, self.limits[direction])

    def at(self, dtype: torch.dtype = torch.float32) -> dict[str, Tensor]:
        """Return the inputs on the device, as ``function`` takes them, with ``cast`` in a dtype."""
        if dtype not in self._laid:
            self._laid[dtype] = {
                k: self._turn(k, x).to(self.device, dtype if k in self.cast else None)
                for k, x in (self.inputs | {"out": self.cotangent}).items()
            }
        return {k: x for k, x in self._laid[dtype].items() if k != "out"}

    def _turn(self, name: str, x: Tensor) -> Tensor:
        return x.mT.contiguous() if name in self.transposed else x

    def call(self, inputs: dict[str, Tensor], **options: Any) -> Tensor:
        """Call the operator."""
        return self.function(**inputs, **options)

    @torch.no_grad()
    def forward(self, dtype: torch.dtype = torch.float32, **options: Any) -> Tensor:
        """Compute the output, without a gradient (timed)."""
        return self.call(self.at(dtype), **options)

    def leaves(self, dtype: torch.dtype = torch.float32) -> dict[str, Tensor]:
        """Return the inputs, which require gradients unless they are ``fixed``."""
        return {
            k: x.detach().requires_grad_(k not in self.fixed) for k, x in self.at(dtype).items()
        }

    def backward(self, dtype: torch.dtype = torch.float32, **options: Any) -> tuple[Tensor, ...]:
        """Compute the output and all gradients (timed)."""
        leaves = self.leaves(dtype)
        out = self.call(leaves, **options)
        wanted = [x for x in leaves.values() if x.requires_grad]
        return torch.autograd.grad(out, wanted, self._laid[dtype]["out"].to(out.dtype))

    def check(self, direction: str, dtype: torch.dtype = torch.float32, **options: Any) -> Error:
        """Return the error of the output, and of every gradient if the direction has them."""
        gradients = direction == BOTH and self.compared
        return compare(self.results(gradients, dtype, **options), self.truth(gradients, **options))

    def results(
        self, gradients: bool, dtype: torch.dtype = torch.float32, **options: Any
    ) -> dict[str, Tensor]:
        """Return the operator's results, in the form of ``truth``."""
        if not gradients:
            return {"out": self.cut("out", self.forward(dtype, **options))}
        leaves = self.leaves(dtype)
        out = self.call(leaves, **options)
        head = torch.zeros_like(self._turn("out", out.detach()), device="cpu")
        truth = self.truth(gradients, **options)
        head[self.corner.get("out", ...)] = self._drawn(truth["out"]).to(head.dtype)
        wanted = {k: x for k, x in leaves.items() if x.requires_grad}
        head = self._turn("out", head).to(out.device)
        grads = torch.autograd.grad(out, list(wanted.values()), head)
        got = {"out": out.detach()} | dict(zip(wanted, grads))
        return {k: self.cut(k, x) for k, x in got.items()}

    def cut(self, name: str, x: Tensor) -> Tensor:
        """Return the corner of a result, laid out as the reference's."""
        return self._turn(name, x).cpu()[self.corner.get(name, ...)]

    def _drawn(self, like: Tensor) -> Tensor:
        return torch.randn(like.shape, generator=torch.Generator().manual_seed(1))

    def truth(self, gradients: bool, **options: Any) -> dict[str, Tensor]:
        """Return the output, and if asked for the gradients, of the corner in float64; kept."""
        key = gradients, *sorted(options.items())
        if key not in self.truths:
            leaves = {
                k: x[self.corner.get(k, ...)].double().requires_grad_(k not in self.fixed)
                for k, x in self.inputs.items()
            }
            with torch.set_grad_enabled(gradients):
                out = self.reference(**leaves, **options)
            self.truths[key] = {"out": out.detach()}
            if gradients:
                wanted = {k: x for k, x in leaves.items() if x.requires_grad}
                grads = torch.autograd.grad(out, list(wanted.values()), self._drawn(out).double())
                self.truths[key] |= dict(zip(wanted, grads))
        return self.truths[key]
