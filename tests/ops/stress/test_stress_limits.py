"""The limits of ``gamba stress``: cases that failed once, and what rounding is said to do."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from gamba_warp.kernels.cases import conv, raster, scan
from gamba_warp.kernels.cases.random_case import Comparison, Outcome, RandomCase, judge, run_case
from gamba_warp.kernels.cases.rounding import SAMPLES, Rounding
from gamba_warp.kernels.rasterize.reference import rasterization_reference
from gamba_warp.measure import stress as model

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
