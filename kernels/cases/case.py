"""A computation at a realistic size: inputs by name, runs, and the error to float64."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import torch
from torch import Tensor

BOTH = "forward+backward"
DIRECTIONS = ("forward", BOTH)
_GRADIENT = "gradient of "


class Error(NamedTuple):
    """Distance of results from the exact ones.

    Attributes:
        rel_rms: rms of the difference over rms of the exact values, of the worst tensor.
        maximum: largest difference over the largest exact value, of the worst tensor.
        worst: name of the tensor with that ``rel_rms``.
    """

    rel_rms: float
    maximum: float
    worst: str


def compare(got: Mapping[str, Tensor], want: Mapping[str, Tensor]) -> Error:
    """Return the error of named results in float64; NaN or a wrong shape makes it infinite."""
    rel_rms, maximum, worst = 0.0, 0.0, ""
    for name, exact in want.items():
        value, exact = got[name].detach().double().cpu(), exact.detach().double().cpu()
        if value.shape != exact.shape or not value.isfinite().all():
            return Error(math.inf, math.inf, name)
        if not exact.numel():
            continue
        difference = value - exact
        # If all exact values are 0, the absolute difference is used.
        rms = exact.square().mean().sqrt().item() or 1.0
        relative = difference.square().mean().sqrt().item() / rms
        if relative >= rel_rms:
            rel_rms, worst = relative, name
        maximum = max(maximum, (difference.abs().max() / (exact.abs().max() or 1.0)).item())
    return Error(rel_rms, maximum, worst)


def gradients_of(
    results: Mapping[str, Tensor], leaves: Mapping[str, Tensor], cotangents: Mapping[str, Tensor]
) -> dict[str, Tensor]:
    """Return gradients by leaf; zeros where a result does not depend on it."""
    names = [n for n in results if results[n].requires_grad and results[n].numel()]
    if not names:
        return {k: torch.zeros_like(x) for k, x in leaves.items()}
    outputs = [results[n] for n in names]
    upstream = [cotangents[n].to(x).expand_as(x) for n, x in zip(names, outputs)]
    grads = torch.autograd.grad(outputs, list(leaves.values()), upstream, allow_unused=True)
    return {k: torch.zeros_like(x) if g is None else g for (k, x), g in zip(leaves.items(), grads)}


@dataclass(eq=False)
class Case:
    """A computation of tensors by name, and its formula.

    The reference may see a part of the inputs and compute a part of the results, such as the first
    tokens of a few channels or the crop of an image, if these depend on nothing else. The check's
    cotangents are 0 outside the part, so that gradients of shared inputs are exact as well.

    Attributes:
        function: of the inputs by name and of options; the results, one or several.
        reference: the formula, likewise, of the part.
        inputs: float32 on the CPU, of which every dtype has its exact results; None if left out.
        cotangent: of the first result, for the timed gradient; the check draws its own.
        device: device of the computation.
        text: the reference in words.
        sizes: for the records.
        limits: largest relative rms error to float64 by direction.
        half_limits: limits in half precision, explained by the rounding of inputs and output.
        outputs: names of the results that are compared.
        cast: names of the inputs that a dtype holds for.
        part: by direction, the index of the part by name of an input or result.
        transposed: inputs and results whose last two dimensions are exchanged for ``function``.
        fixed: inputs without a gradient.
        parameters: tensors of the function whose gradients are timed too, and not compared.
        compared: True to compare gradients too, not only the results.
        known: results of the reference so far; shared with the copies by ``replace``.
    """

    function: Callable[..., Any]
    reference: Callable[..., Any]
    inputs: Mapping[str, Any]
    cotangent: Tensor
    device: torch.device
    text: str
    sizes: dict[str, int]
    limits: Mapping[Any, float]
    half_limits: Mapping[torch.dtype, float] = field(default_factory=dict)
    outputs: tuple[str, ...] = ("out",)
    cast: tuple[str, ...] = ()
    part: Mapping[Any, Mapping[Any, Any]] = field(default_factory=dict)
    transposed: tuple[str, ...] = ()
    fixed: tuple[str, ...] = ()
    parameters: Sequence[Tensor] = ()
    compared: bool = True
    known: dict = field(default_factory=dict)
    _laid: dict = field(default_factory=dict, init=False)

    def oracle(self, direction: str) -> str:
        """Return a description of the reference."""
        return self.text + (", output only" if direction == BOTH and not self.compared else "")

    def limit(self, direction: str, dtype: torch.dtype = torch.float32) -> float:
        """Return the largest error that is allowed."""
        return self.half_limits.get(dtype, self.limits[direction])

    def at(self, dtype: torch.dtype = torch.float32) -> dict[str, Any]:
        """Return the inputs on the device, as ``function`` takes them, with ``cast`` in a dtype."""
        if dtype not in self._laid:
            self._laid[dtype] = {
                k: x
                if x is None
                else self._turn(k, x).to(self.device, dtype if k in self.cast else None)
                for k, x in self.inputs.items()
            }
        return dict(self._laid[dtype])

    def _turn(self, name: str, x: Tensor) -> Tensor:
        return x.mT.contiguous() if name in self.transposed else x

    def call(self, inputs: Mapping[str, Any], **options: Any) -> Any:
        """Call the function."""
        return self.function(**inputs, **options)

    @torch.no_grad()
    def forward(self, dtype: torch.dtype = torch.float32, **options: Any) -> Any:
        """Compute the results, without a gradient (timed)."""
        return self.call(self.at(dtype), **options)

    def leaves(self, dtype: torch.dtype = torch.float32) -> dict[str, Any]:
        """Return the inputs, which require gradients unless they are ``fixed``."""
        return _leaves(self.at(dtype), self.fixed)

    def backward(self, dtype: torch.dtype = torch.float32, **options: Any) -> tuple[Tensor, ...]:
        """Compute the results, and all gradients of the first (timed)."""
        leaves, name = self.leaves(dtype), self.outputs[0]
        out = self._named(self.call(leaves, **options))[name]
        key = name, out.dtype
        if key not in self._laid:
            self._laid[key] = self._turn(name, self.cotangent).to(out)
        inputs = [*wanted(leaves).values(), *self.parameters]
        return torch.autograd.grad(out, inputs, self._laid[key])

    def check(self, direction: str, dtype: torch.dtype = torch.float32, **options: Any) -> Error:
        """Return the error of the results, and of every gradient if the direction has them."""
        direction = direction if self.compared else "forward"
        return compare(self.results(direction, dtype, **options), self.exact(direction, **options))

    def results(
        self, direction: str, dtype: torch.dtype = torch.float32, **options: Any
    ) -> dict[str, Tensor]:
        """Return the results of the function, in the form of ``exact``."""
        if direction != BOTH:
            got = self._named(self.forward(dtype, **options))
            return {k: self.cut(direction, k, x) for k, x in got.items()}
        leaves, exact = self.leaves(dtype), self.exact(direction, **options)
        got, heads = self._named(self.call(leaves, **options)), {}
        for k, x in got.items():
            head = torch.zeros_like(self._turn(k, x.detach()), device="cpu")
            head[self._index(direction, k)] = self._drawn(k, exact[k]).to(head.dtype)
            heads[k] = self._turn(k, head).to(x.device)
        grads = gradients_of(got, wanted(leaves), heads)
        results = {k: self.cut(direction, k, x) for k, x in got.items()}
        return results | {_GRADIENT + k: self.cut(direction, k, x) for k, x in grads.items()}

    def cut(self, direction: str, name: str, x: Tensor) -> Tensor:
        """Return the part of a result or gradient, laid out as the reference's."""
        return self._turn(name, x.detach()).cpu()[self._index(direction, name)]

    def _index(self, direction: str, name: str) -> Any:
        return self.part.get(direction, {}).get(name, ...)

    def _named(self, results: Any) -> dict[str, Tensor]:
        return dict(zip(self.outputs, results if isinstance(results, tuple) else (results,)))

    def _drawn(self, name: str, like: Tensor) -> Tensor:
        g = torch.Generator().manual_seed(1 + self.outputs.index(name))
        return torch.randn(like.shape, generator=g)

    def exact(self, direction: str, **options: Any) -> dict[str, Tensor]:
        """Return the results, and if asked for the gradients, of the part in float64; kept."""
        key = direction, *sorted(options.items())
        if key not in self.known:
            seen = {
                k: x if x is None else x[self._index(direction, k)].double()
                for k, x in self.inputs.items()
            }
            leaves = _leaves(seen, self.fixed)
            with torch.set_grad_enabled(direction == BOTH):
                results = self._named(self.reference(**leaves, **options))
            self.known[key] = {k: x.detach() for k, x in results.items()}
            if direction == BOTH:
                heads = {k: self._drawn(k, x) for k, x in results.items()}
                grads = gradients_of(results, wanted(leaves), heads)
                self.known[key] |= {_GRADIENT + k: x for k, x in grads.items()}
        return self.known[key]


def _leaves(inputs: Mapping[str, Any], fixed: tuple[str, ...]) -> dict[str, Any]:
    return {
        k: x if x is None else x.detach().requires_grad_(k not in fixed) for k, x in inputs.items()
    }


def wanted(leaves: Mapping[str, Any]) -> dict[str, Tensor]:
    """Return those that require gradients."""
    return {k: x for k, x in leaves.items() if x is not None and x.requires_grad}
