"""``gamba stress``: a short run, limits that can fail, small reproducers, and what it refuses."""

import json
import math
import random

import pytest
import torch
from helpers import assert_rel_rms

from gamba_warp import cli
from gamba_warp.kernels.causal_conv1d.reference import causal_conv1d_reference
from gamba_warp.kernels.rasterize.reference import rasterization_reference
from gamba_warp.kernels.selective_scan import selective_scan_fn, selective_scan_state
from gamba_warp.kernels.selective_scan.reference import selective_scan_reference
from gamba_warp.kernels.stress.cases import conv, raster, scan
from gamba_warp.kernels.stress.core.case import Case, draw_cases, run_case, shrink
from gamba_warp.kernels.stress.core.rounding import Rounding, samples_of
from gamba_warp.kernels.stress.oracles import scan as oracle
from gamba_warp.measure import stress as stress_model
from gamba_warp.measure import stress_run

CPU = torch.device("cpu")
OPS = {op.name: op for op in stress_run.choose_ops(("all",))}
SHORT = {"scan": 18, "conv": 11, "raster": 19, "model": 3}  # cases; but for the model each kind


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


@pytest.mark.parametrize("name", SHORT)
def test_short_run(name):
    cases = draw_cases([OPS[name]], seed=0)
    for _ in range(SHORT[name]):
        op, case = next(cases)
        outcome = run_case(op, case, CPU)
        assert outcome.failure() is None, (outcome.failure(), case)


@pytest.mark.parametrize("discretization", scan.DISCRETIZATIONS)
def test_scan_oracle_is_the_reference(discretization):
    case = Case("scan", "uniform", 5, scan.OP.valid(scan.OP.plain | dict(
        batch=2, length=29, channels=6, states=3, groups=2, use_D=True, use_z=True, use_bias=True,
        use_state=True, softplus=True,
    )))  # fmt: skip
    inputs = scan.build(case, CPU)
    samples = {k: samples_of(x) for k, x in inputs.items()}
    out, last = oracle.scan(samples, True, discretization, Rounding(0))
    doubles = {k: x.detach().double().requires_grad_() for k, x in inputs.items()}
    want, want_last = selective_scan_reference(
        **doubles, delta_softplus=True, discretization=discretization
    )
    v, v_last = torch.randn_like(want), torch.randn_like(want_last)
    grads = torch.autograd.grad((out * v).sum() + (last * v_last).sum(), [*samples.values()])
    wants = torch.autograd.grad((want * v).sum() + (want_last * v_last).sum(), [*doubles.values()])
    pairs = [("out", out, want), ("last", last, want_last)]
    for name, got, expected in (*pairs, *zip(inputs, grads, wants)):
        # float64, and a softplus that is the identity above 20 in the reference
        assert_rel_rms(got[0], expected, 1e-12, name)
        spread = (got[1:] - got[0]).abs().amax() / expected.abs().amax()
        assert 1e-8 < spread < 1e-5, f"{name}: the samples are {spread:.1e} off"


def test_conv_oracle_is_the_reference():
    case = Case("conv", "normal", 5, conv.OP.plain | dict(
        batch=2, length=9, channels=6, width=4, silu=True, use_bias=True, use_state=True
    ))  # fmt: skip
    inputs = conv.build(case, CPU)
    samples = {k: samples_of(x) for k, x in inputs.items()}
    got = oracle.conv(samples, True, torch.float32, Rounding(0))
    doubles = {k: x.detach().double() for k, x in inputs.items()}
    want = causal_conv1d_reference(**doubles, activation="silu")
    for name, a, b in zip(("out", "final"), got, want):
        assert_rel_rms(a[0], b, 1e-14, name)


@pytest.mark.parametrize("antialiased", [False, True])
def test_raster_oracle_is_the_reference(antialiased):
    case = Case("raster", "uniform", 3, raster.OP.plain | dict(
        lead="two", views=2, num=20, width=13, height=9, channels=3, backgrounds=True,
        use_quats=True, mode="RGB+D", antialiased=antialiased,
    ))  # fmt: skip
    x = raster.build(case, CPU)
    leaves = {k: t.double().detach().requires_grad_(k != "Ks") for k, t in x.items()}
    samples, picture = raster.truth(case, x)
    renders, alphas = picture.blended.split([4, 1], -1)
    color, depth, alpha = rasterization_reference(
        **leaves, width=13, height=9, antialiased=antialiased
    )
    want = torch.cat([color, depth], -1)
    assert_rel_rms(renders[0], want, 1e-12, "renders")
    assert_rel_rms(alphas[0], alpha, 1e-12, "alphas")
    assert alphas[0].mean() > 0.1 and picture.undecided.double().mean() < 0.02
    v, v_alpha = torch.randn_like(want), torch.randn_like(alpha)
    del leaves["Ks"]
    total = (renders * v).sum() + (alphas * v_alpha).sum()
    grads = torch.autograd.grad(total, [samples[k] for k in leaves])
    wants = torch.autograd.grad((want * v).sum() + (alpha * v_alpha).sum(), [*leaves.values()])
    for name, got, expected in zip(leaves, grads, wants):
        assert_rel_rms(got[0], expected, 1e-10, name)
        spread = (got[1:] - got[0]).abs().amax() / expected.abs().amax()
        assert 1e-8 < spread < 1e-4, f"{name}: the samples are {spread:.1e} off"


def test_an_error_of_the_picture_is_caught_and_a_flip_is_not(monkeypatch):
    """A thousandth more of one Gaussian's colour fails; a cut moved within rounding passes."""
    right = raster.rasterization
    case = Case("raster", "uniform", 1, raster.OP.plain | dict(
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
    case = Case("raster", "not finite", 1, raster.OP.plain | dict(
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
    case = Case("model", "uniform", 1, options)
    assert run_case(stress_model.OP, case, CPU).failure() is None
    monkeypatch.setattr(
        "gamba_warp.model.parts.block.selective_scan_state",
        lambda *a, **k: (1 + 1e-3) * selective_scan_state(*a, **k),
    )
    assert run_case(stress_model.OP, case, CPU).failure()["what"] == "limit"


def test_same_seed_same_cases():
    ops = list(OPS.values())
    first, again, other = (draw_cases(ops, seed) for seed in (3, 3, 4))
    for _ in range(40):
        case = next(first)[1]
        assert case == next(again)[1] != next(other)[1]
        op = OPS[case.op]
        assert op.valid(case.options) == case.options, "shrinking would change it"
        assert case.options.keys() == op.plain.keys()
        json.dumps(vars(case))


@pytest.mark.parametrize("op", OPS.values(), ids=lambda op: op.name)
def test_every_kind_draws_what_a_file_may_hold(op):
    for kind in op.kinds:
        options = op.draw(random.Random(1), kind)
        for name, allowed in op.choices.items():
            assert options[name] in allowed and op.plain[name] in allowed, (kind, name)


def test_a_failing_case_is_made_small(broken_scan):
    options = scan.OP.plain | dict(
        length=40, channels=5, states=4, groups=5, use_z=True, use_D=True, last=True, softplus=True,
        layout="part", batch=2, A="wide",
    )  # fmt: skip
    case = Case("scan", "long", 1, scan.OP.valid(options))
    small, outcome, tried = shrink(scan.OP, case, CPU, seconds=120)
    assert outcome.failure()["what"] == "limit" and tried < 60
    changed = {k for k, v in small.options.items() if v != scan.OP.plain[k]}
    assert changed == {"use_z"} and small.kind == "uniform"


def test_a_small_error_is_caught_written_and_replayed(tmp_path, broken_scan, capsys):
    code = exit_code("scan", "--cases", 24, "--out", tmp_path, "--shrink-seconds", 1)
    assert code == 1
    path = next(tmp_path.glob("failure-scan-*.json"))
    content = json.loads(path.read_text())
    options = content["case"]["options"]
    assert content["failure"]["what"] == "limit" and options["use_z"]
    assert len(path.read_text()) < 2000
    summary = json.loads((tmp_path / "stress.json").read_text())
    assert summary["failures"] and sum(row["failures"] for row in summary["rows"]) > 0
    assert "## Failures" in (tmp_path / "stress.md").read_text()
    assert exit_code("--replay", path) == 1
    assert "fails" in capsys.readouterr().out


def test_a_mended_error_passes_its_replay(tmp_path, capsys):
    case = Case("scan", "uniform", 1, scan.OP.plain)
    content = stress_run.reproducer(case, run_case(scan.OP, case, CPU))
    path = tmp_path / "case.json"
    path.write_text(json.dumps(content))
    assert exit_code("--replay", path) == 0
    assert "passes" in capsys.readouterr().out


@pytest.mark.parametrize("value, what", [(float("nan"), "not finite"), (None, "fault")])
def test_not_finite_and_exceptions_are_failures(monkeypatch, value, what):
    right = scan.selective_scan

    def wrong(*arguments, **options):
        if value is None:
            raise RuntimeError("no launch")
        return right(*arguments, **options) * value

    monkeypatch.setattr(scan, "selective_scan", wrong)
    case = Case("scan", "uniform", 1, scan.OP.plain | {"length": 9})
    outcome = run_case(scan.OP, case, CPU)
    assert outcome.failure()["what"] == what
    assert (outcome.nonfinite >= 9) == (value is not None)
    small, found, _ = shrink(scan.OP, case, CPU, seconds=2)
    assert found.failure()["what"] == what and small.options["length"] <= 1


def test_two_runs_that_differ_are_a_failure(monkeypatch):
    right, count = scan.selective_scan, iter(range(100))
    monkeypatch.setattr(scan, "selective_scan", lambda *a, **k: right(*a, **k) + next(count) * 1e-8)
    outcome = run_case(scan.OP, Case("scan", "uniform", 1, scan.OP.plain | {"length": 9}), CPU)
    assert outcome.faults == ["two runs differ in out"]


def test_interrupted_keeps_what_was_found(tmp_path, monkeypatch, capsys):
    right, count = scan.selective_scan, iter(range(100))

    def interrupted(*arguments, **options):
        if next(count) == 6:
            raise KeyboardInterrupt
        return right(*arguments, **options)

    monkeypatch.setattr(scan, "selective_scan", interrupted)
    assert exit_code("scan", "--cases", 24, "--out", tmp_path) == 130
    summary = json.loads((tmp_path / "stress.json").read_text())
    assert summary["interrupted"] and 0 < sum(row["cases"] for row in summary["rows"]) < 50
    assert "interrupted" in capsys.readouterr().out


GOOD = {
    "format": "gamba_warp.stress.1",
    "case": {"op": "scan", "kind": "uniform", "seed": 1, "options": scan.OP.plain},
}


@pytest.mark.parametrize(
    "content, reason",
    [
        (None, "No such file"),
        ("{", "not valid JSON"),
        ("[]", "not a case"),
        (GOOD | {"format": "gamba_warp.stress.9"}, "format is not"),
        (GOOD | {"case": {}}, "Object missing required field `op`"),
        (GOOD | {"case": GOOD["case"] | {"op": "sort"}}, "no case 'sort, uniform'"),
        (GOOD | {"case": GOOD["case"] | {"options": {}}}, "no option 'A'"),
        ({"options": {"speed": 1}}, "an unknown option 'speed'"),
        ({"options": {"length": "9"}}, "option 'length' is '9'"),
        ({"options": {"length": -1}}, "option 'length' is -1"),
        ({"options": {"dtype": "int8"}}, "option 'dtype' is 'int8'"),
        ({"options": {"groups": 7}}, "do not fit"),
        ({"options": {"length": 10**6}}, "'length' is 1000000, and 125000 is the nearest"),
        ({"options": {"length": 10**6, "states": 16}}, "'length' is 1000000"),  # was endless
        ({"options": {"length": 0, "batch": 10**6, "channels": 10**6}}, "do not fit"),
        ({"seed": -1}, "seed is not in 0 to 2147483647"),
        ({"kind": "x" * 10**5}, "no case 'scan, xxx"),
        ("[" * 10**5, "nested deeper than 32 levels"),
    ],
)
def test_bad_files_are_told_in_one_line(tmp_path, capsys, content, reason):
    path = tmp_path / "case.json"
    if isinstance(content, dict):
        if "options" in content:
            options = scan.OP.plain | content["options"]
            content = GOOD | {"case": GOOD["case"] | {"options": options}}
        elif "format" not in content:
            content = GOOD | {"case": GOOD["case"] | content}
        content = json.dumps(content)
    if content is not None:
        path.write_text(content)
    assert exit_code("--replay", path) == 2
    captured = capsys.readouterr()
    assert captured.out == "" and captured.err.count("\n") == 1
    assert captured.err.startswith(f"gamba: {path}: ") and reason in captured.err


@pytest.mark.parametrize("op", OPS.values(), ids=OPS)
def test_no_options_take_much_memory_or_no_end(op):
    sizes = [name for name, value in op.plain.items() if type(value) is int]
    for chosen in ([], *([name] for name in sizes), sizes[:1], sizes[1:]):
        for other in (0, 10**6):
            options = op.plain | dict.fromkeys(sizes, other) | dict.fromkeys(chosen, 10**6)
            fitting = op.valid(options)
            names = ("batch", "views", "length", "channels", "states", "num", "width", "height")
            product = math.prod(max(1, fitting.get(name, 1)) for name in names)
            assert product <= 500_000 and op.valid(fitting) == fitting


@pytest.mark.parametrize(
    "arguments, reason",
    [
        (["sort"], "unknown 'sort'"),
        (["--cases", "0"], "--cases 0: must be at least 1"),
        (["--minutes", "0"], "--minutes 0.0: must be above 0"),
        (["--threads", "0"], "--threads 0: must be at least 1"),
    ],
)
def test_bad_options_are_told_in_one_line(capsys, arguments, reason):
    assert exit_code(*arguments) == 2
    captured = capsys.readouterr()
    assert captured.err.count("\n") == 1 and reason in captured.err


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
