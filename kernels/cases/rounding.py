"""Effect of rounding to float32 on a formula, the basis of every limit (see README.md)."""

from __future__ import annotations

from collections.abc import Callable
from typing import overload

import torch
import torch.nn.functional as F
from torch import Tensor

SAMPLES = 8  # evaluations side by side: one exact, six rounded at random, one rounded to float32
UNIT = 2.0**-24  # half of float32's last bit, relative
# Numbers below 2^-126 may count as 0, and decays are no smaller. A product of several factors may
# be taken in any order, and a partial product of it may underflow.
UNDERFLOW = 2.0**-124


class _Step(torch.autograd.Function):
    """A function of one tensor, and its gradient."""

    @staticmethod
    def forward(ctx, x: Tensor, function: Callable, back: Callable) -> Tensor:
        ctx.back = back
        return function(x)

    @staticmethod
    def backward(ctx, gradient: Tensor):
        return ctx.back(gradient), None, None


class Rounding:
    """Rounds an intermediate result and its gradient, differently in each sample.

    Dimension 0 of every tensor holds the ``SAMPLES``. Sample 0 stays exact. In samples 1 to 6 each
    number is off by a random fraction of its last bit (Monte Carlo arithmetic; Parker 1997); equal
    numbers get the same fraction, since equal steps err equally in float32 too. Sample 7 is rounded
    to float32. Gradients are rounded on their way back in the same way.
    """

    def __init__(self, seed: int, trial: int = 0) -> None:
        self.generator = torch.Generator().manual_seed((seed + 1_000_003 * trial) % 2**32)
        self.salt = torch.randint(2**31, (SAMPLES - 2,), generator=self.generator)
        # An approximation always errs to the same side, in each sample by another fraction.
        self.side = torch.tensor([0.0, *torch.linspace(-1, 1, SAMPLES - 2).tolist(), 0.0])

    def __call__(self, x: Tensor, ulps: float = 1.0, back: float = 1.0) -> Tensor:
        """Rounds the result of an operation, and its gradient.

        Args:
            x: ``[SAMPLES, ..]`` float64.
            ulps: size of the rounding, in last bits.
            back: size of the gradient's rounding, in last bits.
        """
        return _Step.apply(
            x, lambda x: self.rounded(x, ulps), lambda v: self.rounded(v, back, up=False)
        )

    def drift(self, x: Tensor, steps: Tensor) -> Tensor:
        """Rounds ``x [S, .., n]`` as if computed from the last entry to the first; no gradient.

        ``steps [.., n]`` marks the entries that are a step, a rounded product and quotient.
        """
        shape = (SAMPLES - 2, *steps.shape)
        noise = torch.rand(shape, dtype=x.dtype, generator=self.generator) * 4 - 2
        out = x.detach().clone()
        out[1:-1] *= 1 + UNIT * (noise * steps).flip(-1).cumsum(-1).flip(-1)
        return out

    def constant(self, value: float | Tensor) -> Tensor:
        """Rounds a number that is not differentiated, to ``[SAMPLES, 1]``."""
        return self.rounded(torch.full((SAMPLES, 1), float(value), dtype=torch.float64), 1.0)

    def stored(self, x: Tensor, dtype: torch.dtype) -> Tensor:
        """Returns ``x`` unchanged, but rounds its gradient on this path to ``dtype``."""
        return self(x, 0.0, torch.finfo(dtype).eps / 2 / UNIT)

    def exp(self, x: Tensor, ulps: float) -> Tensor:
        """Computes the exponential of ``x``, with a relative error of |x| times ``ulps``."""
        fraction = self.side.double().view(-1, *[1] * (x.dim() - 1))
        x = x + x.abs() * fraction * (ulps * UNIT)
        return self._mapped(self(x), torch.exp, lambda _, y: y, 1.0)

    def softplus(self, x: Tensor, ulps: float) -> Tensor:
        """Computes log(1 + e^x), and its slope, the sigmoid, to ``ulps``."""
        zero = torch.zeros((), dtype=x.dtype)
        return self._mapped(x, lambda v: torch.logaddexp(v, zero), lambda v, _: v.sigmoid(), ulps)

    def sum(self, x: Tensor, dim: int) -> Tensor:
        """Adds up a dimension; rounds as ``added`` does, and not the total."""
        dim %= x.dim()
        shape = x.shape
        return _Step.apply(
            x, lambda x: self.added(x, (dim,)), lambda v: v.unsqueeze(dim).expand(shape)
        )

    def share(self, x: Tensor, *shape: int) -> Tensor:
        """Expands ``x`` to a shape (-1 keeps a size); its gradient is a sum as of ``added``."""
        sizes = tuple(a if b < 0 else b for a, b in zip(x.shape, shape, strict=True))
        dims = tuple(d for d, (a, b) in enumerate(zip(x.shape, sizes)) if a != b)
        shape = x.shape
        return _Step.apply(
            x, lambda x: x.expand(sizes), lambda v: self.added(v, dims).reshape(shape)
        )

    def sigmoid(self, x: Tensor, ulps: float) -> Tensor:
        """Computes 1 / (1 + e^-x) to ``ulps``."""
        return self._mapped(x, torch.sigmoid, lambda _, y: y * (1 - y), ulps)

    def _mapped(self, x: Tensor, function: Callable, slope: Callable, ulps: float) -> Tensor:
        with torch.no_grad():
            y = self.rounded(function(x), ulps)
            rate = self.rounded(slope(x, y), ulps)
        return _Step.apply(x, lambda _: y, lambda v: self.rounded(v * rate, 1.0, up=False))

    def rounded(self, x: Tensor, ulps: float, up: bool = True) -> Tensor:
        """Rounds as the call does, without a gradient.

        With ``up``, half of the samples err upwards where numbers underflow, as decays do that are
        held at the smallest normal number.
        """
        out = x.clone()
        part = x[1:-1]
        out[1:-1] += self._noise(part) * part.abs() * (ulps * UNIT)
        out += self.underflow(x, up)
        out[-1] = x[-1].float().to(x.dtype)
        return out

    def added(self, x: Tensor, dims: tuple[int, ...]) -> Tensor:
        """Add dimensions two by two, with the rounding of the partial sums; no gradient.

        Each addition in float32 is off by up to half the last bit of its result, evenly spread, but
        exact where a term is 0. n additions are independent, so they are off by the root of a third
        of their squares' sum together. Samples 1 to 6 are off by this, to either side, and drop the
        terms that may count as 0; sample 7 is added in float32. The caller rounds the total.
        """
        if not dims:
            return x.clone()
        x = x.movedim(dims, tuple(range(-len(dims), 0))).flatten(-len(dims))
        squares, rounded = torch.zeros_like(x.sum(-1)), x[-1].float()
        small = torch.where(x[1:-1].abs() < UNDERFLOW, x[1:-1], 0.0)
        small[2:4].clamp_(
            min=0.0
        )  # all terms, or the terms of one sign, which may be the smaller ones
        small[4:].clamp_(max=0.0)
        dropped = small.sum(-1)
        while x.shape[-1] > 1:
            if x.shape[-1] % 2:
                x, rounded = F.pad(x, (0, 1)), F.pad(rounded, (0, 1))
            even, odd = x[..., ::2], x[..., 1::2]
            x, rounded = even + odd, rounded[..., ::2] + rounded[..., 1::2]
            if x.shape[-1] > 1:
                squares += torch.where((even != 0) & (odd != 0), x, 0.0).square().sum(-1)
        total = x.sum(-1)
        side = self._noise(total[1:-1]).sign()
        total[1:-1] += side * UNIT * (squares[1:-1] / 3).sqrt() - dropped
        total[-1] = rounded.sum(-1).double()
        return total

    def underflow(self, x: Tensor, up: bool = False) -> Tensor | float:
        """Draw the error where ``x`` is tiny; ``up`` is as in ``rounded``."""
        small = x[1:-1].abs() < 2.0**-100
        if not small.any():
            return 0.0
        noise = torch.rand(small.shape, dtype=x.dtype, generator=self.generator)
        signed = len(small) // 2 if up else len(small)
        noise[:signed] = noise[:signed] * 2 - 1
        lost = torch.zeros_like(x)
        lost[1:-1] = torch.where(small, noise * UNDERFLOW, 0.0)
        return lost

    def _noise(self, x: Tensor) -> Tensor:
        """Hashes each number's float32 bits, with its sample, to a number in ±1."""
        bits = x.float().contiguous().view(torch.int32).long()
        bits ^= self.salt.view(-1, *[1] * (x.dim() - 1))
        for multiplier in (0x2545F4914F6CDD1D, 0x5851F42D4C957F2D):
            bits *= multiplier
            bits ^= bits >> 31
        return (bits & 0xFFFFFF).double().mul_(2.0**-23).sub_(1.0)


@overload
def samples_of(x: Tensor) -> Tensor: ...
@overload
def samples_of(x: None) -> None: ...
def samples_of(x: Tensor | None) -> Tensor | None:
    """Makes a float64 leaf ``[SAMPLES, ..]`` on the CPU, with the same number in each sample."""
    if x is None:
        return None
    x = x.detach().cpu().double()
    return x.expand(SAMPLES, *x.shape).clone().requires_grad_()
