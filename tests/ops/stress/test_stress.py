"""``gamba stress``: a short run, limits that can fail, and cases that failed once."""

import json
from pathlib import Path

import hypothesis
import pytest
import torch
from helpers import assert_rel_rms

from gamba_warp import cli
from gamba_warp.kernels.cases import conv, raster, scan
from gamba_warp.kernels.cases.random_case import RandomCase, run_case
from gamba_warp.kernels.rasterize.reference import rasterization_reference
from gamba_warp.kernels.selective_scan import selective_scan_fn
from gamba_warp.kernels.selective_scan.reference import selective_scan_reference
from gamba_warp.kernels.stress import run as stress

CPU = torch.device("cpu")
# Cases that failed once.
CORPUS = json.loads(Path(__file__).with_name("corpus.json").read_text())
OPS = {module.OP.name: module.OP for module in (scan, conv, raster)}


def tried(op, kind="uniform", **options):
    """The outcome of a case, plain but for some options."""
    return run_case(op, RandomCase(op.name, kind, 1, op.fit(op.plain | options)), CPU)


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
        out, *last = result if isinstance(result, tuple) else (result,)
        return (out * (1 + 1e-4), *last) if last else out * (1 + 1e-4)

    monkeypatch.setattr(scan, "selective_scan", wrong)


# Small but for these: each kind is run, and each of a few dtypes and layouts.
SMALL = {
    "scan": dict(length=65, channels=5, states=3, use_z=True, use_D=True, softplus=True, last=True),
    "conv": dict(length=33, channels=5, width=4, silu=True, use_bias=True, use_state=True),
    "raster": dict(num=30, width=17, height=9, channels=3, use_quats=True, mode="RGB+D"),
}


@pytest.mark.parametrize("name, kind", [(name, kind) for name in OPS for kind in OPS[name].kinds])
def test_every_kind_passes(name, kind):
    fixed = OPS[name].kinds[kind].items()
    fixed = {k: v[-1] if isinstance(v, tuple) else v for k, v in fixed}
    assert tried(OPS[name], kind, **SMALL[name] | fixed).failure() is None


@pytest.mark.parametrize("name", OPS)
def test_a_short_run_passes_and_is_the_same_again(name):
    runs = []
    for _ in range(2):
        run = stress.StressRun([OPS[name]], CPU, seed=0)
        run.run(6, 1e9)
        assert run.failures == []
        rows = run.document()["rows"]
        runs.append([{k: v for k, v in row.items() if k != "seconds"} for row in rows])
    assert runs[0] == runs[1] and sum(row["cases"] for row in runs[0]) >= 3


def test_an_error_of_the_image_is_caught_and_a_flip_is_not(monkeypatch):
    """A thousandth more of one Gaussian's colour fails; a cut moved within rounding passes."""
    right = raster.rasterization
    options = dict(num=40, width=17, height=23, channels=3, use_quats=True)

    def run(**changed):
        def other(**x):
            for name, factor in changed.items():
                x[name] = x[name] * factor
            return right(**x)

        monkeypatch.setattr(raster, "rasterization", other)
        return tried(raster.OP, **options).failure()

    assert run() is None
    # a few rounding errors of alpha_min: pixels on it fall on the other side
    assert run(alpha_min=1 + 2e-7) is None
    assert run(alpha_min=1.01)["what"] == "limit"
    brighter = torch.ones(40, 1)
    brighter[7] = 1.001
    assert run(colors=brighter)["what"] == "limit"


def test_poison_that_leaks_is_a_failure(monkeypatch):
    options = dict(kind="not finite", num=30, width=9, height=9, poison=4, use_quats=True)
    assert tried(raster.OP, **options).failure() is None
    right = raster.rasterization

    def leaking(**x):
        renders, alphas, meta = right(**x)
        return renders * (1 + 1e-6 * (x["means"].shape[-2] > 30)), alphas, meta

    monkeypatch.setattr(raster, "rasterization", leaking)
    assert "changed by Gaussians" in tried(raster.OP, **options).faults[0]


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
    outcome = tried(scan.OP, length=9)
    assert outcome.failure()["what"] == what
    assert (outcome.nonfinite >= 9) == (value is not None)


def test_two_runs_that_differ_are_a_failure(monkeypatch):
    right, count = scan.selective_scan, iter(range(100))
    monkeypatch.setattr(scan, "selective_scan", lambda *a, **k: right(*a, **k) + next(count) * 1e-8)
    assert tried(scan.OP, length=9).faults == ["two runs differ in out"]


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


@pytest.mark.parametrize("name", CORPUS)
def test_cases_that_failed_once_pass(name):
    case = RandomCase(**CORPUS[name])
    outcome = run_case(OPS[case.op], case, CPU)
    assert outcome.comparisons and outcome.failure() is None, outcome.failure()


@pytest.mark.parametrize("name", [name for name in CORPUS if name.startswith("raster")])
def test_examples_of_the_rasterizer_pass_on_cuda(from_ptx, name):
    from_ptx()
    test_cases_that_failed_once_pass(name)


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
