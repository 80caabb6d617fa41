"""``gamba stress``: a short run, limits that can fail, and failing cases that are made smaller."""

import json

import hypothesis
import pytest
import torch
from helpers import assert_rel_rms
from ops.stress import model_case as stress_model

from gamba_warp import cli
from gamba_warp.kernels.cases import conv, raster, scan
from gamba_warp.kernels.cases.random_case import RandomCase, run_case
from gamba_warp.kernels.selective_scan import selective_scan_fn, selective_scan_state
from gamba_warp.kernels.selective_scan.reference import selective_scan_reference
from gamba_warp.kernels.stress import run as stress

CPU = torch.device("cpu")
OPS = {module.OP.name: module.OP for module in (scan, conv, raster, stress_model)}


def exit_code(*arguments):
    with pytest.raises(SystemExit) as caught:
        cli.main(["stress", *map(str, arguments)])
    return caught.value.code


@pytest.fixture
def broken_scan(monkeypatch):
    """The scan's output off by 1e-4 of itself, where there is a gate."""
    right = scan.selective_scan

    def wrong(*arguments, **options):
        result = right(*arguments, **options)
        if arguments[6] is None:
            return result
        if isinstance(result, tuple):
            return result[0] * (1 + 1e-4), result[1]
        return result * (1 + 1e-4)

    monkeypatch.setattr(scan, "selective_scan", wrong)


# Small but for these: each kind is run, and each of a few dtypes and layouts.
SMALL = {
    "scan": dict(length=65, channels=5, states=3, use_z=True, use_D=True, softplus=True, last=True),
    "conv": dict(length=33, channels=5, width=4, silu=True, use_bias=True, use_state=True),
    "raster": dict(num=30, width=17, height=9, channels=3, use_quats=True, mode="RGB+D"),
    "model": dict(patches=2, width=8, state_size=2, camera_token=True),
}


@pytest.mark.parametrize(
    ("name", "kind"),
    [(name, kind) for name in ("scan", "conv", "raster") for kind in OPS[name].kinds]
    + [("model", kind) for kind in ("uniform", "long steps", "saturated heads")],
)
def test_every_kind_passes(name, kind):
    op = OPS[name]
    fixed = {k: v[-1] if isinstance(v, tuple) else v for k, v in op.kinds[kind].items()}
    case = RandomCase(name, kind, 1, op.fit(op.plain | SMALL[name] | fixed))
    outcome = run_case(op, case, CPU)
    assert outcome.failure() is None, (outcome.failure(), case)


@pytest.mark.parametrize("name", OPS)
def test_a_short_run_passes_and_is_the_same_again(name):
    runs = []
    for _ in range(2):
        run = stress.StressRun([OPS[name]], CPU, seed=0)
        run.run(3 if name == "model" else 6, 1e9)
        assert run.failures == []
        rows = [{k: v for k, v in row.items() if k != "seconds"} for row in run.document()["rows"]]
        runs.append(rows)
    assert runs[0] == runs[1] and sum(row["cases"] for row in runs[0]) >= 3


def test_an_error_of_the_image_is_caught_and_a_flip_is_not(monkeypatch):
    """A thousandth more of one Gaussian's colour fails; a cut moved within rounding passes."""
    right = raster.rasterization
    case = RandomCase("raster", "uniform", 1, raster.OP.plain | dict(
        num=40, width=17, height=23, channels=3, use_quats=True
    ))  # fmt: skip

    def run(**changed):
        def other(**x):
            for name, factor in changed.items():
                x[name] = x[name] * factor
            return right(**x)

        monkeypatch.setattr(raster, "rasterization", other)
        return run_case(raster.OP, case, CPU).failure()

    assert run() is None
    # a few rounding errors of alpha_min: pixels on it fall on the other side
    assert run(alpha_min=1 + 2e-7) is None
    assert run(alpha_min=1.01)["what"] == "limit"
    brighter = torch.ones(40, 1)
    brighter[7] = 1.001
    assert run(colors=brighter)["what"] == "limit"


def test_poison_that_leaks_is_a_failure(monkeypatch):
    case = RandomCase("raster", "not finite", 1, raster.OP.plain | dict(
        num=30, width=9, height=9, poison=4, use_quats=True
    ))  # fmt: skip
    assert run_case(raster.OP, case, CPU).failure() is None
    right = raster.rasterization

    def leaking(**x):
        renders, alphas, meta = right(**x)
        return renders * (1 + 1e-6 * (x["means"].shape[-2] > 30)), alphas, meta

    monkeypatch.setattr(raster, "rasterization", leaking)
    assert "changed by Gaussians" in run_case(raster.OP, case, CPU).faults[0]


def test_model_with_a_small_error_fails(monkeypatch):
    options = stress_model.OP.plain | dict(patches=2, width=8, state_size=2, camera_token=True)
    case = RandomCase("model", "uniform", 1, options)
    assert run_case(stress_model.OP, case, CPU).failure() is None
    monkeypatch.setattr(
        "gamba_warp.model.parts.prefix.selective_scan_state",
        lambda *a, **k: (1 + 1e-3) * selective_scan_state(*a, **k),
    )
    assert run_case(stress_model.OP, case, CPU).failure()["what"] == "limit"


@pytest.mark.parametrize("op", OPS.values(), ids=OPS)
def test_what_is_drawn_fits_and_is_data(op):
    """Also that the kinds are drawn, and that a case that fits is not changed again."""
    seen = set()

    @hypothesis.seed(1)
    @hypothesis.settings(max_examples=300, database=None, deadline=None)
    @hypothesis.given(stress.cases_of(op))
    def look(case):
        seen.add(case.kind)
        assert op.fit(case.options) == case.options
        assert case.options.keys() == op.plain.keys() and json.dumps(case)

    look()
    assert len(seen) > 0.8 * len(op.kinds)


def test_a_small_error_is_caught_and_reported(monkeypatch, tmp_path, broken_scan, capsys):
    """And nothing is written but into the folder of the results."""
    monkeypatch.setattr(stress, "_SHRINK", 0.0)
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    assert exit_code("scan", "--cases", 60, "--out", tmp_path) == 1
    assert not [*(tmp_path / "here").iterdir()]
    document = json.loads((tmp_path / "stress.json").read_text())
    (failure,) = document["failures"]  # the first of the scan; the convolution goes on
    assert failure["text"].startswith("scan, ") and "times its limit off" in failure["text"]
    assert run_case(scan.OP, RandomCase(**failure["case"]), CPU).failure()["what"] == "limit"
    assert sum(row["failures"] for row in document["rows"]) == 1
    assert "## Failures" in (tmp_path / "stress.md").read_text()
    assert failure["text"] in capsys.readouterr().out


@pytest.mark.parametrize("value, what", [(float("nan"), "not finite"), (None, "fault")])
def test_not_finite_and_exceptions_are_failures(monkeypatch, value, what):
    right = scan.selective_scan

    def wrong(*arguments, **options):
        if value is None:
            raise RuntimeError("no launch")
        return right(*arguments, **options) * value

    monkeypatch.setattr(scan, "selective_scan", wrong)
    case = RandomCase("scan", "uniform", 1, scan.OP.plain | {"length": 9})
    outcome = run_case(scan.OP, case, CPU)
    assert outcome.failure()["what"] == what
    assert (outcome.nonfinite >= 9) == (value is not None)


def test_two_runs_that_differ_are_a_failure(monkeypatch):
    right, count = scan.selective_scan, iter(range(100))
    monkeypatch.setattr(scan, "selective_scan", lambda *a, **k: right(*a, **k) + next(count) * 1e-8)
    plain = scan.OP.plain | {"length": 9}
    outcome = run_case(scan.OP, RandomCase("scan", "uniform", 1, plain), CPU)
    assert outcome.faults == ["two runs differ in out"]


def test_interrupted_keeps_what_was_found(tmp_path, monkeypatch, capsys):
    right, count = scan.selective_scan, iter(range(100))

    def interrupted(*arguments, **options):
        if next(count) == 6:
            raise KeyboardInterrupt
        return right(*arguments, **options)

    monkeypatch.setattr(scan, "selective_scan", interrupted)
    assert exit_code("scan", "--cases", 24, "--out", tmp_path) == 130
    document = json.loads((tmp_path / "stress.json").read_text())
    assert document["interrupted"] and 0 < sum(row["cases"] for row in document["rows"]) < 24
    assert "interrupted" in capsys.readouterr().out


def test_constant_input_matrix_sums_its_gradient_in_float32():
    """Found by this command: tokens and repeated groups were summed in bfloat16 and float16."""
    torch.manual_seed(0)
    u, delta = torch.randn(1, 6, 400), 0.1 * torch.rand(1, 6, 400)
    A, B, C = -torch.rand(6, 3), torch.rand(6, 3), torch.rand(1, 2, 3, 400)
    grads = []
    for dtype in (torch.float64, torch.float16, torch.bfloat16):
        x = [t.to(torch.bfloat16).to(dtype).requires_grad_() for t in (u, delta, B, C)]
        if dtype == torch.float64:
            wide = x[2].expand(1, 400, 6, 3)
            tokens = x[3].permute(0, 3, 1, 2)
            y, _ = selective_scan_reference(x[0].mT, x[1].mT, A.double(), wide, tokens)
        else:
            y = selective_scan_fn(x[0], x[1], A, x[2], x[3]).mT
        v = (torch.arange(400) * 7 % 9 - 4)[:, None]  # exact in every dtype
        grads.append(torch.autograd.grad((y * v).sum(), x[2:]))
    for got in grads[1:]:
        for name, a, b in zip("BC", got, grads[0]):
            # one rounding of the result: evenly spread over half the distance of two numbers
            assert_rel_rms(a, b, 0.3 * torch.finfo(a.dtype).eps, f"gradient of {name}")
