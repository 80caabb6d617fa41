"""The scan at full length, on ordinary and on hostile inputs, against float64."""

import math

import pytest
import torch
import torch.nn.functional as F
from helpers import assert_rel_rms, on_threads
from helpers.scan import compare, every_discretization, leaves, make, of_squares

from gamba_warp.kernels.selective_scan import reference, selective_scan
from gamba_warp.kernels.selective_scan.reference import EXACT, Off

PIECE = 256
# CUDA has no other form for slow decays, and rounds each to float32 (CUDA.md, Exponential).
ROUNDED = 2.0**-24
TINY = 1e-30  # below, decays held at 2^-126 and numbers flushed to 0 are all that is seen


def oracle(
    u, delta, A, B, C, D, z, delta_bias, initial_state, off=EXACT, discretization="mamba", **options
):
    """The scan in float64, pieces of tokens side by side: from 0, then from their first states."""
    step = F.softplus(delta + delta_bias, threshold=1e9) * (1 - off.step)
    f, g = reference.discretize(step[..., None] * A, discretization)
    f = f * (1 - off.decay)
    w = g * (step * u)[..., None] * B
    pad = -u.shape[1] % PIECE
    cut = (1, -1, PIECE, *f.shape[2:])
    f = F.pad(f, (0, 0, 0, 0, 0, pad), value=1.0).reshape(cut)
    w = F.pad(w, (0, 0, 0, 0, 0, pad)).reshape(cut)
    local, decay, h, p = [], [], torch.zeros_like(f[:, :, 0]), torch.ones_like(f[:, :, 0])
    for t in range(PIECE):
        h, p = f[:, :, t] * h + w[:, :, t], f[:, :, t] * p
        local.append(h)
        decay.append(p)
    starts, last = [], initial_state
    for piece in range(f.shape[1]):
        starts.append(last)
        last = decay[-1][:, piece] * last + local[-1][:, piece]
    start = torch.stack(starts, 1)[:, :, None]
    states = torch.stack(local, 2) + torch.stack(decay, 2) * start
    states = states.reshape(1, -1, *states.shape[3:])[:, : u.shape[1]]
    y = (states * C).sum(-1) + D * u
    return y * F.silu(z), last


# Changes of a problem's inputs.
KINDS = {
    "random": lambda x: {},
    "steps off": lambda x: {"delta": x["delta"] - 100},
    "steps at 20": lambda x: {"delta": 20 - x["delta_bias"] + 1e-3 * x["delta"]},
    "steps on": lambda x: {"delta": x["delta"] + 100},
    "slow": lambda x: {"A": torch.full_like(x["A"], -1e-6)},
    "growing": lambda x: {"A": torch.full_like(x["A"], 1e-6)},
    # chunks with slow decays and chunks with others, in any order
    "slow at times": lambda x: {"A": 1e-3 * x["A"], "delta": x["delta"] + 8 * turns(x, 150)},
    "fast": lambda x: {"A": torch.full_like(x["A"], -1e4)},
    "constant": lambda x: {name: torch.ones_like(x[name]) for name in "uB"},
    "alternating": lambda x: {"u": 1 - 2 * turns(x, 1), "B": torch.ones_like(x["B"])},
}


def turns(x, tokens):
    """Steps of 0 and 1, each of so many tokens; shaped as ``u``."""
    odd = torch.arange(x["u"].shape[1]) // tokens % 2
    return odd.float()[:, None].expand_as(x["u"]).contiguous()


def problem(kind, length, channels=16, states=2):
    torch.manual_seed(0)
    inputs = make(1, length, channels, states)
    bias = torch.empty(channels).uniform_(-6.9, -2.3).exp()
    inputs["delta_bias"] = bias + torch.log(-torch.expm1(-bias))
    inputs["delta"] = 0.5 * torch.randn(1, length, channels)
    inputs["A"] = -torch.arange(1.0, states + 1).repeat(channels, 1)
    return inputs | KINDS[kind](inputs)


def check(kind, length, threads):
    # measured below 1e-6; with f in float32 up to 4e-4
    gradient = 2e-6 if kind in ("slow", "growing") else 1e-5
    with on_threads(threads):
        limits = 1e-6, gradient, 1e-6
        compare(problem(kind, length), *limits, exact=oracle, tiny=TINY, decays=ROUNDED)


@every_discretization
def test_oracle_is_the_reference(discretization):
    inputs = {k: v.double() for k, v in make(1, 600, 5, 3).items()}
    options = {"discretization": discretization, "off": Off(1e-3, 1e-4)}
    got, last = oracle(**inputs, **options)
    want, want_last = reference.selective_scan_reference(**inputs, delta_softplus=True, **options)
    assert_rel_rms(got, want, 1e-13, "out")
    assert_rel_rms(last, want_last, 1e-13, "last state")


# On two threads these few channels are cut into segments, on one they are not.
both = pytest.mark.parametrize("threads", [1, 2])


@pytest.mark.parametrize("kind", KINDS)
def test_at_the_papers_length(kind):
    check(kind, 16961, 2)


@pytest.mark.parametrize("kind, threads", [("random", 2), ("slow", 1), ("slow", 2)])
def test_at_65536_tokens(kind, threads):
    """The error of a state that forgets nothing does not grow with the number of tokens."""
    check(kind, 65536, threads)


@both
@every_discretization
def test_slow_decays_of_every_discretization(discretization, threads):
    inputs = problem("slow", 2000, channels=5)
    inputs["A"] *= torch.tensor([1.0, 300.0])
    # measured below 2e-7; with decays rounded to float32 2e-6
    options = {"exact": oracle, "discretization": discretization, "decays": ROUNDED}
    ones = (torch.ones_like, torch.ones_like)
    with on_threads(threads):
        compare(inputs, 5e-7, 2e-6, 5e-7, alone=True, cotangents=ones, **options)


def constant(length):
    """Every token is the same, so all roundings of a decay are equal, and the gradients of delta
    and delta_bias are sums that nearly cancel. One channel of the five is fast.
    """
    torch.manual_seed(0)
    inputs = make(1, length, 5, 3)
    inputs["A"] = -torch.arange(1.0, 4.0).repeat(5, 1)
    step = torch.tensor([1e-3, 1.7e-3, 2.9e-3, 0.5, 7e-3])
    inputs["delta_bias"] = step + torch.log(-torch.expm1(-step))
    inputs["delta"] = torch.zeros_like(inputs["delta"])
    return inputs | {k: torch.ones_like(inputs[k]) for k in ("u", "B", "C", "z")}


@both
@pytest.mark.parametrize(
    "discretization, length", [("mamba", 16961), ("mamba", 4003), ("bilinear", 4003), ("zoh", 4003)]
)
def test_a_constant_input_beside_a_fast_channel(discretization, length, threads):
    """A fast channel may not take from the slow ones beside it what float32 can hold of f - 1.

    Measured below 1e-7 and, in sums over all tokens, 1.7e-6. With f alone: outputs and states up
    to 3e-5, the gradients of delta and delta_bias up to 8e-5, at 4,003 tokens 2e-6 and 8e-6.
    """
    sums = (torch.ones_like, torch.zeros_like)
    options = {"exact": oracle, "discretization": discretization, "decays": ROUNDED}
    with on_threads(threads):
        compare(constant(length), 5e-7, 3e-6, 5e-7, alone=True, cotangents=sums, **options)


@every_discretization
def test_a_fast_channel_has_the_same_bits_beside_slow_ones(discretization):
    """The recurrence of slow decays leaves the arithmetic of channels that are not slow."""
    results = []
    for slowest in (0.3, 1e-3):
        inputs = constant(333)
        inputs["delta_bias"] = torch.full((16,), -1.0)
        inputs["delta_bias"][:15] = math.log(math.expm1(slowest))
        for name, x in inputs.items():
            if x.shape[-1] == 5 and name != "delta_bias":
                inputs[name] = x[..., [3] * 16].contiguous()
        inputs["A"] = -torch.arange(1.0, 4.0).repeat(16, 1)
        inputs["initial_state"] = torch.ones(1, 16, 3)
        found = dict(zip(("out", *inputs), of_squares(inputs, discretization=discretization)))
        results.append([found[k][..., 15] for k in ("out", "u", "delta", "z")])
    assert all(map(torch.equal, *results))


def test_equal_terms_of_a_sum():
    """Equal additions round to the same side; dD must not add a sequence's tokens in a row."""
    u = (0.1 + torch.rand(20)).expand(1, 20000, 20).contiguous()
    D = torch.ones(20, requires_grad=True)
    ones = torch.ones(1, 20000, 1, 1)
    out = selective_scan(u, torch.full_like(u, 0.01), -torch.ones(20, 1), ones, ones, D)
    (got,) = torch.autograd.grad(out.sum(), D)
    # two levels of 8 equal additions round by less than 6 * 2^-24; in a row it was 1e-6 and more
    assert_rel_rms(got, 20000 * u[0, 0].double(), 4e-7, "D")


def test_zero_input_gives_zero():
    inputs = problem("random", 1000)
    inputs["u"].zero_()
    inputs["initial_state"].zero_()
    assert not selective_scan(**inputs, delta_softplus=True).any()


def test_denormal_input_stays_finite():
    inputs = problem("random", 1000)
    inputs["u"] *= 1e-39
    inputs["initial_state"].zero_()
    mine = leaves(inputs)
    out = selective_scan(**mine, delta_softplus=True)
    assert torch.isfinite(out).all() and out.abs().max() < 1e-36
    for name, grad in zip(mine, torch.autograd.grad(out.sum(), [*mine.values()])):
        assert torch.isfinite(grad).all(), name
