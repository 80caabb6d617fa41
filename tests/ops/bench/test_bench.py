"""gamba bench: what is recorded, what is refused, and what is drawn."""

import json
import math
import mmap
import re
import xml.etree.ElementTree as ET
from dataclasses import replace
from functools import reduce
from operator import getitem

import pytest
import torch
from helpers import rel_rms
from lab.studies import raster as raster_study
from lab.studies import scan as scan_study
from lab.studies import step as step_study
from lab.studies.targets import Key, Target, judge, of_bench

from gamba_warp import cli
from gamba_warp.commands import machine
from gamba_warp.errors import UserError
from gamba_warp.kernels.bench import peers
from gamba_warp.kernels.bench.cases import conv as conv_suite
from gamba_warp.kernels.bench.cases import raster as raster_suite
from gamba_warp.kernels.bench.cases import scan as scan_suite
from gamba_warp.kernels.bench.cases.raster_scene import make_scene
from gamba_warp.kernels.bench.cases.scan_problem import make_inputs, scan_problem
from gamba_warp.kernels.bench.core.case import (
    BOTH,
    Case,
    Error,
    NotInstalled,
    Settings,
    Variant,
    compare,
)
from gamba_warp.kernels.bench.core.measure import measure, peak_bytes, saved_bytes
from gamba_warp.kernels.bench.core.report import markdown, ratio_table, ratios
from gamba_warp.kernels.bench.peers import scan_loop
from gamba_warp.kernels.selective_scan.reference import selective_scan_reference
from gamba_warp.measure import inference, suites
from gamba_warp.measure.inference import without_encoder
from gamba_warp.measure.page import charts_of, page
from gamba_warp.model.config import PRESETS
from gamba_warp.model.gamba import Gamba
from gamba_warp.pages.charts import Axis, Point, Series, chart, pareto

QUICK = Settings(torch.device("cpu"), "quick", threads=1)
# DESIGN's schema, and what it leaves to us.
SCHEMA = set(
    "op case variant device dtype direction ms_p20 ms_p50 ms_p80 jit_ms rel_rms_error max_error "
    "peer peer_ms work".split()
)
TIMES = ("ms_p20", "ms_p50", "ms_p80", "jit_ms")


def variant(name="ours", run=lambda: None, error=1e-8, **options):
    return Variant(name, run, lambda: Error(error, error, "out"), oracle="a loop", **options)


def case(*variants, name="one", axis=None, op="scan"):
    return Case(op, name, "A test.", lambda: list(variants), axis)


def run(*cases):
    return measure(cases, QUICK)


def measured(suite, name, settings=QUICK):
    """The records of the case of that name."""
    return measure([c for c in suite.cases(settings) if c.name == name], settings)["records"]


def stub(monkeypatch, *cases):
    """Makes ``gamba bench scan`` run these cases."""
    module = type("M", (), {"cases": lambda _: list(cases)})
    monkeypatch.setattr(machine, "load_suite", lambda op: module)


def test_records_have_the_schema_and_are_json():
    calls = []
    document = run(
        case(
            variant(run=lambda: calls.append("ours"), work=lambda: {"pairs": 7}, default=True),
            variant("slow", run=lambda: calls.append("slow"), peer=True, rounds=1),
        )
    )
    assert json.loads(json.dumps(document, allow_nan=False)) == document
    ours, slow = document["records"]
    assert SCHEMA <= ours.keys() and SCHEMA <= slow.keys()
    assert ours["status"] == "ok" and ours["work"] == {"pairs": 7} and ours["rounds"] == 3
    assert 0 <= ours["ms_p20"] <= ours["ms_p50"] <= ours["ms_p80"]
    assert ours["rel_rms_error"] == ours["max_error"] == 1e-8
    assert (ours["peer"], ours["peer_ms"]) == ("slow", slow["ms_p50"])
    assert slow["peer"] is None and slow["rounds"] == 1
    assert calls[:4] == ["ours", "slow", "ours", "slow"]  # first calls, then in turn


def test_the_machine_has_no_names_and_no_paths():
    import platform

    text = json.dumps(run()["machine"])
    assert "/" not in text.replace("2026/", "") and "torch" in text
    assert not platform.node() or platform.node() not in text


@pytest.mark.parametrize("error", [2e-5, math.inf, math.nan])
def test_a_failed_check_prints_no_time(error):
    document = run(case(variant("wrong", error=error), variant("right")))
    wrong, right = document["records"]
    assert wrong["status"].startswith("check failed: out") and right["status"] == "ok"
    assert all(wrong[name] is None for name in TIMES) and wrong["rounds"] == 0
    assert all(right[name] is not None for name in TIMES)
    json.dumps(document, allow_nan=False)
    for text in (markdown([document]), page([document])):
        row = next(line for line in re.split(r"\n|</tr>", text) if "wrong" in line)
        assert "check failed" in row


def test_a_wrong_kernel_is_caught(monkeypatch):
    """A thousandth too much in one channel of the scan's output."""
    from gamba_warp.kernels.bench.cases import scan_problem as module

    real = module.selective_scan

    def wrong(*arguments, **options):
        out = real(*arguments, **options)
        return out * torch.where(torch.arange(out.shape[-1]) == 1, 1.001, 1.0)

    inputs = make_inputs(1, 40, 4)
    for function, status in ((real, "ok"), (wrong, "check failed")):
        monkeypatch.setattr(module, "selective_scan", function)
        problem = scan_problem(inputs, torch.device("cpu"), 40)
        records = run(case(*problem.pair("x")))["records"]
        assert all(r["status"].startswith(status) for r in records)


def raises(error):
    def function():
        raise error

    return function


def test_what_raises_is_recorded_and_the_rest_goes_on():
    document = run(
        case(
            variant("missing", raises(NotInstalled("mambapy")), peer=True),
            variant("broken", raises(RuntimeError("no such\nkernel"))),
            variant("fine"),
        ),
        Case("scan", "two", "", raises(MemoryError("too big"))),
        case(variant("last"), name="three"),
    )
    status = {r["variant"]: r["status"] for r in document["records"]}
    assert status == {
        "missing": "not installed: mambapy",
        "broken": "failed: RuntimeError: no such",
        "fine": "ok",
        "all": "failed: MemoryError: too big",
        "last": "ok",
    }


def test_interrupt_keeps_what_was_measured(monkeypatch, tmp_path, capsys):
    count = [0]

    def stop():
        count[0] += 1
        if count[0] == 4:  # first call, two rounds, then
            raise KeyboardInterrupt

    cases = (
        case(variant("a")),
        case(variant("b", stop), variant("c"), name="two"),
        case(variant("d")),
    )
    stub(monkeypatch, *cases)
    assert machine.bench_command(("scan",), quick=True, out=tmp_path) == 130
    assert "interrupted" in capsys.readouterr().out
    document = json.loads((tmp_path / "bench.json").read_text())
    assert document["interrupted"] and "interrupted" in (tmp_path / "bench.md").read_text()
    rounds = {r["variant"]: r["rounds"] for r in document["records"]}
    assert rounds == {"a": 3, "b": 2, "c": 2}


def test_interrupt_before_any_round(monkeypatch):
    document = run(case(variant("a"), variant("b", raises(KeyboardInterrupt()))))
    assert document["interrupted"] and document["records"] == []


@pytest.fixture
def files(tmp_path):
    (tmp_path / "file").write_text("x")
    (tmp_path / "broken.json").write_text('{"format":')
    (tmp_path / "other.json").write_text('{"format": "x"}')
    good = run(case(variant()))
    (tmp_path / "good.json").write_text(json.dumps(good))
    del good["records"][0]["ms_p50"]
    (tmp_path / "half.json").write_text(json.dumps(good))
    return tmp_path


@pytest.mark.parametrize(
    "arguments, reason",
    [
        (["nonsense"], "unknown case 'nonsense'; there are scan, conv, raster"),
        (["scan", "--quick", "--full"], "choose one"),
        (["scan", "--threads", "0"], "--threads 0: must be at least 1"),
        (["scan", "--out", "{}/file"], "cannot write into {}/file"),
        (["scan", "--out", "{}/file/deep"], "cannot write into {}/file/deep"),
        (["scan", "--compare", "{}/none.json"], "{}/none.json: No such file"),
        (["scan", "--compare", "{}/broken.json"], "{}/broken.json: not valid JSON"),
        (["scan", "--compare", "{}/other.json"], "{}/other.json: not a result of"),
        (["scan", "--compare", "{}/half.json"], "{}/half.json: damaged"),
        (["--render", "{}/half.json"], "{}/half.json: damaged"),
        (["--render", "{}/good.json", "--out", "{}/no/x.md"], "cannot write {}/no/x.md"),
    ],
)
def test_bad_input_is_one_line_and_code_2(monkeypatch, files, capsys, arguments, reason):
    stub(monkeypatch, case(variant("must not run", raises(AssertionError()))))
    code = cli.run("bench", [a.format(files) for a in arguments])
    captured = capsys.readouterr()
    assert code == 2 and captured.err.count("\n") == 1 and "Traceback" not in captured.err
    assert reason.format(files) in captured.err


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_cuda_without_a_gpu(tmp_path, capsys):
    assert cli.run("bench", ["scan", "--device", "cuda", "--out", str(tmp_path / "x")]) == 2
    assert capsys.readouterr().err == "gamba: --device cuda: no CUDA device is available\n"
    assert not (tmp_path / "x").exists()


def test_compare_prints_ratios(monkeypatch, tmp_path, capsys):
    old = run(case(variant("a"), variant("gone")))
    stub(monkeypatch, case(variant("a"), variant("new")))
    assert machine.bench_command(("scan",), quick=True, out=tmp_path) == 0
    new = suites.read_document(tmp_path / "bench.json")
    old["records"][0]["ms_p50"] = 2 * new["records"][0]["ms_p50"]
    (record, before, after), *more = ratios(old, new)
    assert record["variant"] == "a" and before == 2 * after and not more
    (tmp_path / "old.json").write_text(json.dumps(old))
    capsys.readouterr()
    machine.bench_command(("scan",), quick=True, out=tmp_path, compare=tmp_path / "old.json")
    assert re.search(r"[\d.]+ x .* ms  scan · one · a · forward · float32", capsys.readouterr().out)
    assert "0.50 x" in ratio_table(old, new)
    old["machine"]["torch"] = "1.0"
    assert "torch was 1.0" in ratio_table(old, new)


def test_failures_give_code_1(monkeypatch, tmp_path, capsys):
    stub(monkeypatch, case(variant("bad", error=1.0)))
    assert machine.bench_command(("scan",), quick=True, out=tmp_path) == 1
    assert "bad, forward: check failed" in capsys.readouterr().out
    stub(monkeypatch, case(variant("absent", raises(NotInstalled("gsplat")), peer=True)))
    assert machine.bench_command(("scan",), quick=True, out=tmp_path) == 0


def test_targets_are_judged():
    records = run(case(variant("a", work=lambda: {"pairs": 4}), variant("b")))["records"]
    records[0]["ms_p50"], records[1]["ms_p50"] = 6.0, 2.0
    a, b = (Key("scan", "one", name) for name in "ab")
    pairs = Key("scan", "one", "a", field="pairs")
    made = [
        Target("ratio", (a,), (b,), at_most=2.5),
        Target("ratio", (a,), (b,), at_least=2.5),
        Target("counts", (a,), (b, pairs), scale=10, at_most=8),
        Target("no such variant", (Key("scan", "one", "c"),), at_most=1),
        Target("no such case", (Key("scan", "two", "a"),), at_most=1),
    ]
    rows = judge(made, records)
    assert [(r["value"], r["reached"]) for r in rows] == [
        (3.0, False),
        (3.0, True),
        (7.5, True),
        (None, None),
    ]
    assert rows[0]["wanted"] == "≤ 2.5" and rows[1]["wanted"] == "≥ 2.5"


@pytest.mark.parametrize("gpu", [None, "H200"])
def test_every_target_names_what_its_suite_measures(gpu):
    """Names only: nothing is run."""
    full = Settings(torch.device("cuda" if gpu else "cpu"), "full", threads=2)
    suites = (scan_suite, conv_suite, raster_suite, raster_study)
    names = {c.name for suite in suites for c in suite.cases(full)} | {inference.CASE}
    document = {"machine": {"gpu": gpu}, "settings": {"level": "full"}, "records": []}
    wanted = of_bench(document)
    wanted += raster_study.targets(full)
    assert raster_study.targets(QUICK) == []
    for target in wanted:
        assert {k.case for k in (*target.times, *target.over)} <= names, target.text
    assert of_bench(document | {"settings": {"level": "quick"}}) == [] and len(wanted) > 15


def test_pareto_front():
    a, b, c, d, e = (Point(*p) for p in [(1, 9), (2, 5), (3, 5), (4, 1), (2, 7)])
    assert pareto([e, d, c, b, a]) == [a, b, d]
    assert pareto([]) == [] and pareto([a, a]) == [a]


@pytest.mark.parametrize("count", [1, 2, 30])
def test_charts_are_whole_svg(count):
    points = [Point(10.0**i % 97 + 1, 1e-7 * (i + 1), f"<{i}>", "default") for i in range(count)]
    svg = chart([Series("a&b", points), Series("front", pareto(points), "steps")], *2 * [Axis("x")])
    root = ET.fromstring(svg)
    numbers = re.findall(r' (?:x|y|cx|cy|x1|x2|y1|y2)="([^"]+)"', svg)
    assert all(math.isfinite(float(n)) for n in numbers)
    assert len(root.findall(".//g")) == count and "&lt;0&gt;" in svg


def test_charts_leave_out_what_they_cannot_place():
    points = [Point(math.nan, 1), Point(1, 0), Point(-1, 1)]
    assert chart([Series("", points)], Axis("x"), Axis("y")) == ""
    assert chart([Series("", [*points, Point(1, 1, "ok")])], Axis("x"), Axis("y")).count("<g>") == 1


@pytest.mark.parametrize(
    "axis, count",
    [("error", 2), ("L", 1), ("skipped", 1), (None, 0)],
)
def test_a_case_has_the_charts_of_its_axis(axis, count):
    made = [
        variant(
            str(length),
            direction=direction,
            default=length == 8,
            parameters={"L": length},
            work=lambda: {"skipped": 0.5, "saved_bytes": 2**20},
        )
        for length in (8, 16)
        for direction in ("forward", "forward+backward")
    ]
    document = run(case(*made, axis=axis))
    svgs = charts_of("one", document["records"])
    assert len(svgs) == count
    for svg in svgs:
        ET.fromstring(svg)
    assert ("Pareto" in "".join(svgs)) == (axis not in ("L", "skipped", None))


def test_render_makes_the_same_files_again(monkeypatch, tmp_path, capsys):
    stub(monkeypatch, case(variant("a", default=True), axis="error"))
    machine.bench_command(("scan",), quick=True, out=tmp_path)
    again = tmp_path / "again"
    source = (tmp_path / "bench.json",)
    assert machine.bench_command(render=source, out=again) == 0
    for name in ("bench.md", "bench.html"):
        assert (again / name).read_text() == (tmp_path / name).read_text()
    assert machine.bench_command(render=source, out=tmp_path / "doc.md") == 0
    assert (tmp_path / "doc.md").read_text() == (tmp_path / "bench.md").read_text()
    assert "://" not in (tmp_path / "bench.html").read_text()


def test_compare_of_tensors():
    want = {"a": torch.tensor([3.0, 4.0]), "b": torch.zeros(2)}
    got = {"a": torch.tensor([3.0, 4.5]), "b": torch.tensor([0.0, 1e-3])}
    error = compare(got, want)
    assert error.worst == "a" and error.maximum == pytest.approx(0.125)
    assert error.rel_rms == pytest.approx(rel_rms(got["a"], want["a"]))
    assert compare(got | {"b": torch.tensor([0.0, math.nan])}, want).rel_rms == math.inf
    assert compare(got | {"b": torch.zeros(3)}, want).worst == "b"
    assert compare({"a": torch.zeros(0)}, {"a": torch.zeros(0)}).rel_rms == 0


def test_saved_bytes_leaves_the_inputs_out():
    x = torch.rand(100, requires_grad=True)
    assert saved_bytes(lambda: x * x, [x]) == 0
    assert saved_bytes(lambda: x.exp() * x, [x]) == 400


def test_peak_bytes():
    """A result of 67 MB, and again when that much was freed just before; then 17 small ones."""
    for run in (
        *[lambda: torch.ones(16 * 2**20)] * 2,
        *[lambda: [torch.ones(2**20) for _ in range(17)]] * 2,
    ):
        peak = peak_bytes(run, torch.device("cpu"))
        assert peak is None or 60e6 < peak < 80e6


@pytest.mark.skipif(not hasattr(mmap, "MADV_HUGEPAGE"), reason="needs Linux")
def test_peak_bytes_counts_no_huge_pages():
    """One byte in each 2 MiB is one small page, also in memory that numpy marked for huge pages."""
    block = mmap.mmap(-1, 64 * 2**20, mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    block.madvise(mmap.MADV_HUGEPAGE)  # numpy does so under each array of 4 MiB or more

    def touch():
        for start in range(0, len(block), 2**21):
            block[start] = 1

    peak = peak_bytes(touch, torch.device("cpu"))
    assert peak is None or peak < 8e6


@pytest.mark.parametrize("groups", [1, 2])
def test_the_scans_corner_is_the_truth_of_the_whole(groups):
    """The oracle on some tokens and channels finds no error in the reference run on all."""
    inputs = make_inputs(2, 30, 12, states=3, groups=groups)
    state = torch.randn(2, 12, 3)
    problem = scan_problem(inputs, torch.device("cpu"), 20, 4, initial_state=state)

    def reference(**inputs):
        inputs = {k: x.double() for k, x in inputs.items()}
        start = state.double()
        return selective_scan_reference(**inputs, delta_softplus=True, initial_state=start)[0]

    problem.function = reference
    assert problem.check("forward").rel_rms < 1e-15
    assert problem.check(BOTH).rel_rms < 1e-7  # gradients come back in float32
    assert "4 of 12 channels, first 20 of 30 tokens" in problem.oracle(BOTH)


def test_the_torch_loop_is_the_formula():
    inputs = {k: x.double() for k, x in make_inputs(2, 20, 8, states=3).items()}
    want, _ = selective_scan_reference(**inputs, delta_softplus=True)
    first = {k: inputs[k].mT for k in ("u", "delta", "B", "C", "z")}
    assert rel_rms(scan_loop(**(inputs | first)).mT, want) < 1e-14


def test_quick_scan_and_conv_from_the_command_line(tmp_path, capsys):
    code = cli.run("bench", ["scan", "conv", "--quick", "--threads", "2", "--out", str(tmp_path)])
    document = suites.read_document(tmp_path / "bench.json")
    records = document["records"]
    assert code == 0, [r["status"] for r in records if r["status"] != "ok"]
    assert {r["op"] for r in records} == {"scan", "conv"}
    assert all(r["rel_rms_error"] < 5e-2 for r in records)
    loop = next(r for r in records if r["variant"] == "torch loop")
    ours = next(r for r in records if r["case"] == loop["case"] and r["variant"] == "default")
    assert ours["peer"] == "torch loop" and ours["peer_ms"] > ours["ms_p50"]
    assert {"bench.json", "bench.md", "bench.html"} == {p.name for p in tmp_path.iterdir()}


def test_the_scene_and_its_crop():
    """The rasterizer is right on the oracle's crop; a wrong colour is seen."""
    scene = make_scene(QUICK, 2, count=300, size=64)
    assert scene.check(BOTH).rel_rms < 1e-4
    wrong = scene.changed(exact={"alpha_min": 0.2})
    assert wrong.check("forward").rel_rms > 1e-2
    counts = scene.work(True)
    assert counts["pairs"] > 100 and counts["tiles"] == 16 and counts["gaussians"] == 300


@pytest.mark.parametrize(
    "suite, name",
    [
        *((raster_suite, name) for name in ("one call", "skipping", "batch", "harmonics")),
        (raster_study, "switches"),
        (raster_study, "large scenes"),
        (scan_study, "exponential"),
    ],
)
def test_cases_run(suite, name):
    records = measured(suite, name)
    assert records and all(r["status"] == "ok" for r in records), records
    if name == "skipping":
        shares = {r["variant"]: r["work"].get("skipped") for r in records}
        assert 0.3 < shares["upstream gradient on half of the picture"] < 0.7
    if name == "exponential":  # the variant reaches check, clock and counts
        error = {r["variant"]: r["rel_rms_error"] for r in records}
        assert error["degree 3"] > 10 * error["degree 5"]


@pytest.mark.parametrize(
    "op, module", [("block", machine.load_suite("block")), ("step", step_study)]
)
def test_model_cases_run(op, module):
    cases = [c for c in module.cases(QUICK) if c.op == op][:1]
    records = measure(cases, QUICK)["records"]
    assert all(r["status"] == "ok" for r in records), records
    if op == "block":
        error = {r["variant"]: r["rel_rms_error"] for r in records}
        assert 0 < error["default"] < 1e-5


def test_every_preset_can_be_measured_without_its_encoder():
    """``one picture`` at the normal level takes all of them; "released" prepends no camera."""
    for name, config in PRESETS.items():
        made = without_encoder(config)
        assert made.encoder == "none" and made.num_gaussians == config.num_gaussians, name
        with torch.device("meta"):
            Gamba(replace(made, depth=1))


def test_unwritable_result_is_one_line(monkeypatch, tmp_path):
    stub(monkeypatch, case(variant()))
    (tmp_path / "bench.md").mkdir()
    with pytest.raises(UserError, match="bench.md"):
        machine.bench_command(("scan",), quick=True, out=tmp_path)
    assert (tmp_path / "bench.json").is_file()


def test_kept_states_are_counted_on_their_own_kernels():
    wide, narrow = measured(scan_study, "boundary spacing")[::-1]
    assert narrow["status"] == wide["status"] == "ok" and wide["is_default"]
    assert narrow["work"]["saved_bytes"] == 2 * wide["work"]["saved_bytes"]


def test_gsplats_harmonics_agree_with_ours():
    pytest.importorskip("gsplat")
    settings = replace(QUICK, peers=True)
    records = [r for r in measured(raster_suite, "harmonics", settings) if r["is_peer"]]
    assert len(records) == 4 and all(r["rel_rms_error"] < 1e-5 for r in records), records


def test_gswarp_is_reported_where_it_is_not():
    scene = make_scene(QUICK, count=8, size=16)
    with pytest.raises(NotInstalled, match="gswarp"):
        scene.forward(peers.gswarp_rasterization)
    with pytest.raises(ValueError, match="alpha_min"):
        scene.changed(options={"alpha_min": 0.1}).forward(peers.gswarp_rasterization)


GONE = object()


@pytest.mark.parametrize(
    "place, value, reason",
    [
        ("records.0.ms_p50", math.nan, "not valid JSON"),
        ("records.0.ms_p50", math.inf, "not valid JSON"),
        ("records.0.ms_p50", "fast", r"got `str` - at `\$.records\[0\].ms_p50`"),
        ("records.0.ms_p20", None, "no times, but its status is ok"),
        ("records.0.ms_p50", 0.0, r"> 0.0 - at `\$.records\[0\].ms_p50`"),
        ("records.0.max_error", 1e308, r"- at `\$.records\[0\].max_error`"),
        ("records.0.parameters.L", [], r"`array` - at `\$.records\[0\].parameters"),
        ("records.0.axis", "a," * 10**4, r"length <= 10000 - at `\$.records\[0\].axis`"),
        ("machine.peers", ["x"], r"got `array` - at `\$.machine.peers`"),
        ("machine.cores", 10**18 * 10**300, r"not valid JSON|machine.cores"),
        ("records.0.work.pairs", "many", r"`str` - at `\$.records\[0\].work"),
        ("records.0.text", GONE, r"required field `text` - at `\$.records\[0\]`"),
        ("records.0", 7, r"got `int` - at `\$.records\[0\]`"),
        ("records", {}, r"got `object` - at `\$.records`"),
        ("machine", GONE, "required field `machine`"),
        ("machine.warp", GONE, r"required field `warp` - at `\$.machine`"),
        ("interrupted", GONE, "required field `interrupted`"),
        ("format", "gamba_warp.bench.0", "not a result of"),
    ],
)
def test_damaged_results_are_refused(tmp_path, place, value, reason):
    document = run(case(variant()))
    path = tmp_path / "x.json"
    path.write_text(json.dumps(document))
    assert suites.read_document(path) == document
    *way, last = (int(name) if name.isdigit() else name for name in place.split("."))
    part = reduce(getitem, way, document)
    if value is GONE:
        del part[last]
    else:
        part[last] = value
    path.write_text(json.dumps(document))
    with pytest.raises(UserError, match=reason):
        suites.read_document(path)


@pytest.mark.parametrize("data", [b"\xff\xfe", b"[" * 10**5, b"", b"null"])
def test_what_is_no_result_is_refused(tmp_path, data):
    (tmp_path / "x.json").write_bytes(data)
    with pytest.raises(UserError, match="not valid JSON|nested deeper|not a result"):
        suites.read_document(tmp_path / "x.json")


def test_a_parameter_that_cannot_be_drawn_is_left_out(tmp_path):
    document = run(case(variant(), axis="L"))
    document["records"][0]["parameters"] = {"L": 5}
    for value in (0, -1, "long", None):
        document["records"][0]["parameters"]["L"] = value
        suites.write_pages([document], tmp_path)
    del document["records"][0]["parameters"]["L"]
    suites.write_pages([document], tmp_path)


def test_saved_time_is_told_by_direction():
    """A variant takes a quarter of its own direction's default."""
    made = [
        variant(name, direction=d, default=name == "all", work=lambda: {"skipped": 0.5})
        for d in ("forward", "forward+backward")
        for name in ("all", "less")
    ]
    records = run(case(*made, axis="skipped"))["records"]
    for record, ms in zip(records, (8.0, 2.0, 80.0, 20.0)):
        record["ms_p50"] = ms
    (svg,) = charts_of("one", records)
    assert svg.count("less: 50, 75") == 2


@pytest.mark.parametrize("low, high", [(75.8, 81.7), (5.1, 5.2), (0.097, 0.099), (88, 150)])
def test_narrow_axes_have_ticks_and_room(low, high):
    axis = Axis("ms")
    svg = chart([Series("", [Point(low, low), Point(high, high)])], axis, axis)
    assert svg.count('text-anchor="middle"') >= 3 and svg.count('text-anchor="end"') >= 3
    left, right = (float(x) for x in re.findall(r'cx="([^"]+)"', svg))
    assert (right - left) / 522 == pytest.approx(math.log10(high / low) / 0.4, rel=0.2)


def test_an_error_of_zero_is_drawn_at_the_bottom():
    document = run(case(variant("all", error=0.0, default=True), variant("part"), axis="error"))
    (svg,) = charts_of("one", document["records"])
    assert "all (error 0): " in svg and svg.count("<g>") == 2
    all_zero = run(case(variant("all", error=0.0), axis="error"))
    assert charts_of("one", all_zero["records"]) == [""]
