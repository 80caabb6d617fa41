"""The limits of ``gamba stress``: cases that failed once, and what rounding is said to do."""

import json
import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from ops.stress import model_case as model

from gamba_warp.kernels.cases import conv, raster, scan
from gamba_warp.kernels.cases.random_case import Comparison, Outcome, RandomCase, judge, run_case
from gamba_warp.kernels.cases.rounding import SAMPLES, UNDERFLOW, Rounding, samples_of
from gamba_warp.kernels.cases.scan_oracle import states
from gamba_warp.kernels.rasterize.reference import rasterization_reference

CPU = torch.device("cpu")
OPS = {module.OP.name: module.OP for module in (conv, scan, raster, model)}
# Cases that failed once.
CORPUS = json.loads(Path(__file__).with_name("corpus.json").read_text())


@pytest.mark.parametrize("name", CORPUS)
def test_cases_that_failed_once_pass(name):
    case = RandomCase(**CORPUS[name])
    outcome = run_case(OPS[case.op], case, CPU)
    assert outcome.comparisons and outcome.failure() is None, outcome.failure()


@pytest.mark.parametrize("name", [name for name in CORPUS if name.startswith("raster")])
def test_examples_of_the_rasterizer_pass_on_cuda(from_ptx, name):
    from_ptx()
    test_cases_that_failed_once_pass(name)


def spread_of(samples):
    """The rms of each sample's difference from the first."""
    return (samples[1:] - samples[0]).square().flatten(1).mean(1).sqrt()


@pytest.mark.parametrize("sign", [0.0, 1.0], ids=["either sign", "one sign"])
@pytest.mark.parametrize("backward", [False, True])
def test_a_sum_is_off_as_one_in_float32(sign, backward):
    g = torch.Generator().manual_seed(0)
    values = torch.randn(400, 130, generator=g)
    values = sign * values.abs() + (1 - sign) * values
    r = Rounding(0)
    if backward:
        leaf = torch.zeros(SAMPLES, 400, 1, dtype=torch.float64, requires_grad=True)
        cotangent = values.double().expand(SAMPLES, -1, -1)
        (total,) = torch.autograd.grad(r.share(leaf, -1, -1, 130), leaf, cotangent)
        total = total[..., 0]
    else:
        total = r.sum(values.double().expand(SAMPLES, -1, -1).clone(), -1)
    assert (total[0] - values.double().sum(-1)).abs().max() < 1e-12
    folded = values
    while folded.shape[-1] > 1:
        folded = torch.nn.functional.pad(folded, (0, folded.shape[-1] % 2))
        folded = folded[:, ::2] + folded[:, 1::2]
    real = (folded[:, 0].double() - total[0]).square().mean().sqrt()
    # the last addition is the caller's to round; a last bit is between UNIT and 2 UNIT of a number
    assert ((spread_of(total) / real > 0.5) & (spread_of(total) / real < 2)).all()


def test_additions_of_nothing_are_exact():
    values = torch.zeros(SAMPLES, 5, 130, dtype=torch.float64)
    values[:, torch.arange(5), 7 * torch.arange(5)] = 0.75
    assert (Rounding(0).sum(values, -1) == 0.75).all()


def test_small_terms_of_a_sum_may_count_as_nothing():
    values = torch.full((SAMPLES, 500), 0.9 * 2.0**-126, dtype=torch.float64)
    spread = spread_of(Rounding(0).sum(values, -1)[:, None])[:-1]
    assert (spread[:4] >= 0.99 * values[0].sum()).all()
    values = torch.full((SAMPLES, 500), 2.0**-123, dtype=torch.float64)
    spread = spread_of(Rounding(0).sum(values, -1)[:, None])
    assert (spread < 1e-6 * values[0].sum()).all()


@pytest.mark.parametrize(
    "ratios, fails",
    [((0.9,), False), ((1.2, 0.5, 0.6, 1.1, 0.4), False), ((1.2, 0.5, 1.1, 1.1, 0.4), True)],
)
def test_most_trials_decide(ratios, fails):
    seen = []

    def evaluate(case, device, trial):
        seen.append(trial)
        return Outcome([Comparison("out", 1e-7, ratios[trial])])

    op = replace(raster.OP, evaluate=evaluate)
    outcome = run_case(op, RandomCase("raster", "uniform", 0, {}), CPU)
    assert (outcome.failure() is not None) == fails and seen == [*range(len(ratios))]


@pytest.mark.parametrize("noise, ratios, at, fails, trials", [
    (True, (0.7, 1.1), 30, False, 31),  # until a trial has a limit that is wide enough
    (True, (0.7, 1.1), 70, True, 50),
    (True, (0.7, 0.9), 2, True, 5),  # noise within its limit makes no case steep
    (False, (0.7, 1.1), 2, True, 5),
    (False, (0.1, 1.1), 30, False, 31),  # limits that differ by trial
    (False, (0.1, 0.9), 2, True, 5),
])  # fmt: skip
def test_the_widest_limit_counts_for_steep_cases_alone(noise, ratios, at, fails, trials):
    seen = []

    def evaluate(case, device, trial):
        seen.append(trial)
        other = Comparison("gradient of u", 20.0, ratios[trial == 1], noise=noise)
        return Outcome([Comparison("out", 1e-7, 0.9 if trial == at else 4.0), other])

    outcome = run_case(replace(raster.OP, evaluate=evaluate), RandomCase("raster", "x", 0, {}), CPU)
    assert (outcome.failure() is not None) == fails and outcome.steep == (trials > 5)
    assert seen == [*range(trials)]


@pytest.mark.parametrize("off, noise", [(0.3, False), (0.7, True)])
def test_a_result_without_a_certain_digit_is_noise(off, noise):
    """The part decides in which the error is worst."""
    samples = torch.ones(SAMPLES, 2, 50, dtype=torch.float64)
    samples[1, 0] += off
    samples[1, 1] += 0.9 - off  # the other part, whose error is smaller
    got = torch.ones(2, 50)
    got[0] += 10 * off
    found = judge("out", got, samples, (-1,))
    assert found.ratio == pytest.approx(10 / 8, rel=1e-5) and found.noise == noise


def test_a_fault_in_one_trial_is_a_failure():
    def evaluate(case, device, trial):
        faults = ["two runs differ in out"] if trial == 3 else []
        return Outcome([Comparison("out", 1e-7, 1.2 if trial == 0 else 0.5)], faults)

    outcome = run_case(replace(raster.OP, evaluate=evaluate), RandomCase("raster", "x", 0, {}), CPU)
    assert outcome.faults


def test_trials_round_differently():
    value = torch.full((SAMPLES, 1), 0.7, dtype=torch.float64)
    first, again, other = (Rounding(3, trial)(value) for trial in (0, 0, 1))
    assert torch.equal(first, again) and not (first[1:-1] == other[1:-1]).any()


def test_a_state_keeps_what_its_tokens_round():
    """An alternating input brings states to and fro between two numbers, always rounded alike.

    So float32 never forgets the first state: its rest stays at some last bits over 1 - f.
    """
    channels, length = 256, 600
    g = torch.Generator().manual_seed(0)
    f = (-0.03 - 0.02 * torch.rand(channels, generator=g)).exp()
    w = torch.ones(length, channels)
    w[1::2] = -1
    first = torch.randn(channels, generator=g)
    h, real = first, []
    for row in w:
        h = f * h + row
        real.append(h.double())
    all_tokens = (SAMPLES, 1, length, channels, 1)
    f, w, first = (t.double().view(-1, channels, 1) for t in (f, w, first))
    first = first.expand(SAMPLES, 1, -1, -1)
    samples = states(f.expand(all_tokens), w.expand(all_tokens), first, Rounding(0))[:, 0, ..., 0]
    last = samples[0, -100:]  # two tokens together cancel the input
    mean = lambda h: (h[..., -100:, :] - last).mean(-2).square().mean(-1).sqrt()  # noqa: E731
    fractions = mean(samples)[1:-1] / mean(torch.stack(real))
    assert ((fractions > 0.4) & (fractions < 2.5)).all(), fractions


def test_the_slope_of_a_decay_may_lose_a_small_product():
    """(dh f) h with dh f below 2^-126 and h of any earlier token, near or far."""
    length = 15
    f = samples_of(torch.full((1, length, 1, 1), math.exp(-0.01)))
    with torch.no_grad():
        f[:, :, -1] = 2.0**-100
    w = torch.zeros(SAMPLES, 1, length, 1, 1, dtype=torch.float64)
    for token in range(length - 1):
        inputs = w.clone()
        inputs[:, :, token] = 1e4
        h = states(f, inputs, torch.zeros(SAMPLES, 1, 1, 1, dtype=torch.float64), Rounding(0))
        (df,) = torch.autograd.grad(h[:, :, -1].sum() * 2.0**-30, f)
        lost = (df * f)[:, 0, -1, 0, 0].detach()
        spread = (lost[1:] - lost[0]).abs().max()
        assert 0.1 < spread / (1e4 * UNDERFLOW) < 1.1, token


def test_a_gradient_that_is_not_finite_beside_poison_is_a_failure(monkeypatch):
    """Only numbers beyond the dtype's range may be infinite, and only those of the right row."""
    case = RandomCase(**CORPUS["raster-gradient-beyond-float16"])
    right = raster.gradients_of
    for row in range(9):

        def leaking(results, leaves, cotangents, row=row):
            grads = right(results, leaves, cotangents)
            if len(leaves["means"]) == 9:  # with the Gaussian that is not finite
                grads["scales"][row, 1] = torch.inf
            return grads

        monkeypatch.setattr(raster, "gradients_of", leaking)
        failure = run_case(raster.OP, case, CPU).failure()
        assert failure and "gradient of scales not finite" in failure["name"], row


@pytest.mark.parametrize("kind", ["needles", "all sizes", "huge on screen"])
def test_the_reference_in_float32_is_far_off(monkeypatch, kind):
    """So limits come from a formula in the kernels' order: README.md, "Formulas of their own"."""

    def by_reference(render_mode, rasterize_mode, sh_degree, skip, radius_clip, **x):
        colors, _, alphas = rasterization_reference(**x)
        return colors, alphas, None

    options = dict(num=30, width=17, height=13, channels=3, use_quats=True)
    case = RandomCase("raster", kind, 1, raster.OP.plain | options)
    assert raster.evaluate(case, CPU).worst.ratio < 0.5
    monkeypatch.setattr(raster, "rasterization", by_reference)
    assert raster.evaluate(case, CPU).worst.ratio > 100
