"""``make study WHAT=growth-errors``: its float64 truth, its lines, and what it sees."""

import json
import math
import xml.etree.ElementTree as ET

import pytest
import torch
from helpers import assert_rel_rms
from lab.studies import growth_errors
from lab.studies.growth_errors import EPS, KINDS, Problem, Sizes
from lab.studies.show import charts_of
from lab.studies.slopes import ERRORS, growth_table

from gamba_warp.kernels.bench.core.case import Settings
from gamba_warp.kernels.selective_scan.reference import selective_scan_reference
from gamba_warp.measure import suites
from gamba_warp.measure.suites import check_document

QUICK = Settings(torch.device("cpu"), "quick", threads=1)
CPU = torch.device("cpu")
SIZES = Sizes((300, 700), 300)  # no whole number of the oracle's pieces


@pytest.mark.parametrize("kind", KINDS)
def test_the_truth_is_the_reference(kind):
    inputs = {k: x.double() for k, x in growth_errors.make_kind(kind, 600).items()}
    mine, theirs = ({k: x.clone().requires_grad_() for k, x in inputs.items()} for _ in range(2))
    first = torch.randn(16, 4, dtype=torch.float64)
    out, h = growth_errors.truth(mine, first)
    # The reference's softplus is exact only for small arguments; so it gets the steps.
    step = torch.log1p(torch.exp(theirs["delta"] + theirs["delta_bias"]))
    given = {k: x for k, x in theirs.items() if k != "delta_bias"} | {"delta": step}
    want, last = selective_scan_reference(**given, initial_state=first[None])
    assert_rel_rms(out, want, 1e-12, "out")
    assert_rel_rms(h[-1], last[0], 1e-12, "last state")
    v = torch.randn_like(out)
    grads = torch.autograd.grad(out, [*mine.values()], v)
    wants = torch.autograd.grad(want, [*theirs.values()], v)
    for name, got, expected in zip(mine, grads, wants):
        assert_rel_rms(got, expected, 1e-11, f"gradient of {name}")


def test_the_truth_goes_on_from_segment_to_segment(monkeypatch):
    problem = Problem("random", torch.float32, SIZES)
    whole, states = problem.true_forward()
    monkeypatch.setattr(growth_errors, "_SEGMENT", 256)
    again = Problem("random", torch.float32, SIZES)
    cut, cut_states = again.true_forward()
    assert whole.shape == (1, 700, 16) and set(states) == set(SIZES.lengths) == set(cut_states)
    assert_rel_rms(cut, whole, 1e-13, "out")
    for length in SIZES.lengths:
        assert_rel_rms(cut_states[length], states[length], 1e-13, "state")


def test_the_lines_are_those_of_the_readme():
    """With A = -1e-6 nothing is forgotten: T = L. With a constant step T is 1 / (1 - f)."""
    slow = Problem("slow decays", torch.float32, SIZES).lines(700)
    assert slow["ε/2"] == 2.0**-25 == EPS / 2
    assert slow["ε√T/2"] == pytest.approx(2.0**-25 * math.sqrt(700), rel=1e-3)
    assert slow["εT/2"] == pytest.approx(2.0**-25 * 700, rel=1e-3)
    inputs = growth_errors.make_kind("constant", 100)
    inputs["A"] = torch.full_like(inputs["A"], -2.0)
    inputs["delta"].fill_(math.log(math.expm1(0.05)))
    inputs["delta_bias"].zero_()
    f = math.exp(-0.1)
    assert growth_errors.memory_of(inputs, 10**6) == pytest.approx(1 / (1 - f), rel=1e-5)
    assert growth_errors.memory_of(inputs, 3) == pytest.approx(1 + f + f * f, rel=1e-5)
    inputs["A"].zero_()
    assert growth_errors.memory_of(inputs, 123) == 123


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16], ids=str)
def test_errors_are_of_the_rounded_inputs(dtype):
    """A state is float32 whatever the inputs; the output of bfloat16 rounds by 2^-9."""
    found = growth_errors.errors(Problem("random", dtype, SIZES), 300, CPU, True)
    assert set(found) == {"out", "last state", "worst gradient"}
    assert found["last state"].rel_rms < 1e-6
    assert (found["out"].rel_rms < 1e-6) == (dtype == torch.float32)
    assert found["out"].rel_rms < 2**-8


def test_worse_decays_are_seen(monkeypatch):
    """A kernel whose rates are off by 1e-4 of themselves is off by over 5e-6 in every figure."""
    problem = Problem("random", torch.float32, SIZES)
    scan = growth_errors.selective_scan
    monkeypatch.setattr(
        growth_errors,
        "selective_scan",
        lambda A, **given: scan(A=A * (1 + 1e-4), **given),
    )
    for name, error in growth_errors.errors(problem, 300, CPU, True).items():
        assert error.rel_rms > 5e-6, name


def test_a_run_of_small_sizes():
    only = ("constant, float32", "large steps, bfloat16")
    found = suites.run_suites({growth_errors.OP: growth_errors}, QUICK, only)
    assert not suites.failed_records(found)
    check_document(json.loads(json.dumps(found, allow_nan=False)))
    records = [r for r in found["records"] if r["case"] == only[0]]
    assert {r["axis"] for r in records} == {ERRORS}
    assert [r["direction"] for r in records] == ["forward+backward"] * 2 + ["forward"]
    (svg,) = charts_of(only[0], records)
    nodes = [x for x in ET.fromstring(svg).iter() if x.tag in ("text", "tspan")]
    labels = {"".join(x.itertext()) for x in nodes}
    assert {"out", "last state", "worst gradient", "ε/2", "ε√T/2", "εT/2", "4,096"} <= labels
    header, rows = growth_table(records)
    assert header == ["L", *records[0]["work"], "of"]
    assert [row[0] for row in rows] == ["256", "1,024", "4,096", "slope"]
    assert rows[0][-1] in ("u", "delta", "A", "B", "C", "D", "z", "delta_bias")
    assert rows[2][3] == ""  # no gradient at the last length
