"""Benchmark cases of the scan's error over the number of tokens, with theoretical bounds.

Named inputs at 1,024 to 1,048,576 tokens, with gradients up to 131,072 and forward alone above,
against float64 from the same rounded inputs. The lines are those of the scan's README, "Accuracy":
with ε = 2^-24, f of a decay is rounded by at most ε/2, and a state sums as many of these roundings
as it remembers tokens, T: random ones leave ε √T / 2 of h, equal ones ε T / 2.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from gamba_warp.kernels import selective_scan
from gamba_warp.kernels.bench.cases.scan_problem import make_inputs
from gamba_warp.kernels.bench.core.case import Case, Error, Settings, Variant, compare

from .slopes import ERRORS

OP = "growth-errors"
BOTH = "forward+backward"
EPS = 2.0**-24
HALF_LIMIT = 3e-2  # of bfloat16: 8 bits of a number
_CHANNELS, _STATES = 16, 4  # of all problems; the truth of more costs minutes
_PIECE = 256  # tokens that the truth walks one after the other
_SEGMENT = 2**14  # tokens whose factors the truth holds at once
_TINY = 1e-30  # below, float32 has decays held at 2^-126 and numbers that count as 0


@dataclass(frozen=True)
class Sizes:
    """Numbers of tokens: all of them, ascending, and the greatest one with gradients."""

    lengths: tuple[int, ...]
    longest_gradient: int


def sizes_of(settings: Settings) -> Sizes:
    """Return the lengths of a level."""
    if settings.level == "quick":
        return Sizes((256, 1024, 4096), 1024)
    powers = range(10, 21) if settings.level == "full" else (10, 12, 14, 16, 17, 18, 20)
    return Sizes(tuple(2**k for k in powers), 2**17)


KINDS = {
    "random": "Inputs as of a model at its start.",
    "slow decays": "A = -1e-6: no state forgets anything.",
    "constant": "u, B, C and z are 1, and every channel has one step: all roundings are equal.",
    "small steps": "delta near -20 before the softplus: steps near 2e-9.",
    "large steps": "delta near 8 before the softplus: most states forget at once.",
}


def make_kind(kind: str, length: int) -> dict[str, Tensor]:
    """Arguments of ``selective_scan``, float32, one sequence; a shorter one is not its beginning.

    Args:
        kind: key of ``KINDS``.
        length: number of tokens L.
    """
    inputs = make_inputs(1, length, _CHANNELS, _STATES)
    if kind == "slow decays":
        inputs["A"] = torch.full_like(inputs["A"], -1e-6)
    elif kind == "constant":
        inputs["delta"] = torch.zeros_like(inputs["delta"])
        inputs |= {k: torch.ones_like(inputs[k]) for k in ("u", "B", "C", "z")}
    elif kind == "small steps":
        inputs["delta"] -= 20 + inputs["delta_bias"]
    elif kind == "large steps":
        inputs["delta"] += 8 - inputs["delta_bias"]
    return inputs


class _Recurrence(torch.autograd.Function):
    """h_t = f_t h_{t-1} + w_t in float64, in parallel pieces of tokens, and its gradient."""

    @staticmethod
    def forward(ctx: Any, f: Tensor, w: Tensor, first: Tensor) -> Tensor:
        h = _walk(f, w, first)
        ctx.save_for_backward(f, h, first)
        return h

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, ...]:
        f, h, first = ctx.saved_tensors
        # dh_t = own_t + f_{t+1} dh_{t+1}: the same recurrence, from the last token to the first.
        later = torch.cat([f[1:], torch.zeros_like(f[:1])])
        dh = _walk(later.flip(0), grads[0].flip(0), torch.zeros_like(first)).flip(0)
        before = torch.cat([first[None], h[:-1]])
        return dh * before, dh, dh[0] * f[0]


def _walk(f: Tensor, w: Tensor, first: Tensor) -> Tensor:
    """All states ``[L, ...]``: every piece from 0, then its first state's share."""
    length, rest = f.shape[0], f.shape[1:]
    pad = (0, 0) * len(rest) + (0, -length % _PIECE)
    f, w = F.pad(f, pad, value=1.0), F.pad(w, pad)
    f, w = (x.reshape(-1, _PIECE, *rest).transpose(0, 1).contiguous() for x in (f, w))
    h, p = torch.empty_like(f), torch.empty_like(f)
    h[0], p[0] = w[0], f[0]
    for t in range(1, _PIECE):
        torch.addcmul(w[t], f[t], h[t - 1], out=h[t])
        torch.mul(f[t], p[t - 1], out=p[t])
    starts = torch.empty_like(p[-1])
    last = first
    for piece in range(len(starts)):
        starts[piece] = last
        last = p[-1, piece] * last + h[-1, piece]
    return h.addcmul_(p, starts).transpose(0, 1).reshape(-1, *rest)[:length]


def truth(inputs: dict[str, Tensor], first: Tensor) -> tuple[Tensor, Tensor]:
    """The scan of one sequence in float64, equations 1, 2 and 5 of the operator's README.

    Args:
        inputs: as of ``make_kind``, float64.
        first: the state before the first token, ``[D, N]`` float64.

    Returns:
        ``out`` ``[1, L, D]`` and the states after each token ``[L, D, N]``.
    """
    u, z, B, C = (inputs[k][0] for k in ("u", "z", "B", "C"))
    # torch's softplus returns its argument above 20, where float64 still shows a difference.
    step = F.softplus(inputs["delta"][0] + inputs["delta_bias"], threshold=700.0)
    f = torch.exp(step[..., None] * inputs["A"])
    h = _Recurrence.apply(f, (step * u)[..., None] * B[:, None], first)
    y = (h * C[:, None]).sum(-1) + inputs["D"] * u
    return (y * F.silu(z))[None], h


def memory_of(inputs: dict[str, Tensor], length: int) -> float:
    """Tokens that the slowest state remembers, T = Σ_{k<L} f^k with f of its mean step."""
    step = F.softplus((inputs["delta"][0] + inputs["delta_bias"]).double()).mean(0)
    x = (step[:, None] * inputs["A"].double()).max().item()
    return math.expm1(length * x) / math.expm1(x) if x else float(length)


@dataclass
class Problem:
    """Inputs of a kind and dtype at the greatest length, and the truth of their beginnings.

    Attributes:
        kind: key of ``KINDS``.
        dtype: of u, delta, z, B and C.
        sizes: the lengths.
    """

    kind: str
    dtype: torch.dtype
    sizes: Sizes
    inputs: dict[str, Tensor] = field(init=False)
    _truth: tuple[Tensor, dict[int, Tensor]] | None = None

    def __post_init__(self) -> None:
        made = make_kind(self.kind, self.sizes.lengths[-1])
        cast = ("u", "delta", "z", "B", "C")
        self.inputs = {k: x.to(self.dtype if k in cast else None) for k, x in made.items()}

    def first(self, length: int) -> dict[str, Tensor]:
        """The inputs of the first tokens."""
        cut = ("u", "delta", "z", "B", "C")
        return {k: x[:, :length] if k in cut else x for k, x in self.inputs.items()}

    def forward(self, length: int, device: torch.device) -> tuple[Tensor, Tensor]:
        """Output and last state, without gradients."""
        with torch.no_grad():
            own: dict[str, Any] = {k: x.to(device) for k, x in self.first(length).items()}
            return selective_scan(**own, delta_softplus=True, return_last_state=True)

    def cotangent(self, length: int) -> Tensor:
        """Cotangent of the output, ``[1, L, D]``: 1 for constant inputs, otherwise random."""
        shape = (1, length, _CHANNELS)
        if self.kind == "constant":
            return torch.ones(shape, dtype=self.dtype)
        g = torch.Generator().manual_seed(2)
        return torch.randn(shape, generator=g).to(self.dtype)

    def gradients(self, length: int, device: torch.device) -> tuple[dict[str, Tensor], Tensor]:
        """The gradients of all inputs, and the output."""
        leaves = {k: x.to(device).requires_grad_() for k, x in self.first(length).items()}
        given: dict[str, Any] = dict(leaves)
        out = selective_scan(**given, delta_softplus=True)
        back = self.cotangent(length).to(device)
        grads = torch.autograd.grad(out, list(leaves.values()), back)
        return dict(zip(leaves, grads)), out.detach()

    def true_forward(self) -> tuple[Tensor, dict[int, Tensor]]:
        """The truth of all tokens, and the states after each length; kept."""
        if self._truth is None:
            state = torch.zeros(_CHANNELS, _STATES, dtype=torch.float64)
            outs, states, longest = [], {}, self.sizes.lengths[-1]
            with torch.no_grad():
                for start in range(0, longest, _SEGMENT):
                    part = {k: x.double() for k, x in self.inputs.items()}
                    for k in ("u", "delta", "z", "B", "C"):
                        part[k] = self.inputs[k][:, start : start + _SEGMENT].double()
                    out, h = truth(part, state)
                    outs.append(out)
                    state = h[-1]
                    inside = (n for n in self.sizes.lengths if start < n <= start + len(h))
                    states |= {n: h[n - start - 1].clone() for n in inside}
            self._truth = torch.cat(outs, 1), states
        return self._truth

    def true_gradients(self, length: int) -> dict[str, Tensor]:
        """The gradients in float64."""
        leaves = {k: x.double().requires_grad_() for k, x in self.first(length).items()}
        out, _ = truth(leaves, torch.zeros(_CHANNELS, _STATES, dtype=torch.float64))
        grads = torch.autograd.grad(out, list(leaves.values()), self.cotangent(length).double())
        return dict(zip(leaves, grads))

    def lines(self, length: int) -> dict[str, float]:
        """Bounds of the error of h for one rounding of f, random ones and equal ones."""
        memory = memory_of(self.inputs, length)
        return {"ε/2": EPS / 2, "ε√T/2": EPS / 2 * math.sqrt(memory), "εT/2": EPS / 2 * memory}


def errors(problem: Problem, length: int, device: torch.device, backward: bool) -> dict[str, Error]:
    """The relative rms errors of output, last state and, if asked for, the worst gradient."""
    outs, states = problem.true_forward()
    out, last = problem.forward(length, device)
    found = {
        "out": compare({"out": out}, {"out": outs[:, :length]}),
        "last state": compare({"last state": last[0]}, {"last state": states[length]}),
    }
    if backward:
        got, _ = problem.gradients(length, device)
        want = problem.true_gradients(length)
        seen = {k: x for k, x in want.items() if x.abs().max() > _TINY}
        found["worst gradient"] = compare(got, seen)
    return found


def cases(settings: Settings) -> list[Case]:
    """Return the cases: every kind of inputs in float32 and bfloat16."""
    made = []
    for kind, text in KINDS.items():
        for dtype in (torch.float32, torch.bfloat16):
            name = str(dtype).removeprefix("torch.")
            note = "; bfloat16 results round by up to 2^-9" if dtype == torch.bfloat16 else ""
            made.append(
                Case(
                    op=OP,
                    name=f"{kind}, {name}",
                    text=(
                        f"{text} {_CHANNELS} channels, {_STATES} states; inputs are {name}{note}. "
                        "Lines: what one rounding of a decay by ε/2 = 2^-25 leaves, random ones, "
                        "and equal ones, over the T tokens that the slowest state remembers."
                    ),
                    build=partial(variants, settings, kind, dtype),
                    axis=ERRORS,
                )
            )
    return made


def variants(settings: Settings, kind: str, dtype: torch.dtype) -> list[Variant]:
    """Return a variant for every length, with gradients where the level has them."""
    problem = Problem(kind, dtype, sizes_of(settings))
    return [_variant(problem, length, settings.device) for length in problem.sizes.lengths]


def _variant(problem: Problem, length: int, device: torch.device) -> Variant:
    backward = length <= problem.sizes.longest_gradient
    lines, found = problem.lines(length), {}

    def check() -> Error:
        by_name = errors(problem, length, device, backward)
        found.update({name: error.rel_rms for name, error in by_name.items()})
        worst = by_name.get("worst gradient")
        if worst is not None:
            made.parameters["worst"] = worst.worst
        return max(by_name.values(), key=lambda error: error.rel_rms)

    made = Variant(
        name=f"L {length:,}",
        run=partial(problem.gradients if backward else problem.forward, length, device),
        check=check,
        # On CUDA decays err by up to 2^-22 at every token (CUDA.md): eight times ε/2.
        limit=HALF_LIMIT if problem.dtype == torch.bfloat16 else 1e-5 + 8 * lines["εT/2"],
        oracle="float64 from the same inputs, all tokens",
        direction=BOTH if backward else "forward",
        dtype=str(problem.dtype).removeprefix("torch."),
        rounds=1,
        parameters={"L": length, "D": _CHANNELS, "N": _STATES},
        work=lambda: found | lines,
    )
    return made
