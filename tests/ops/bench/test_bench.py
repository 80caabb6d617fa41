"""``gamba bench``: records, refusals, reports, and the cases."""

import json
import math

import pytest
import torch
from helpers import on_threads, rel_rms
from helpers.refusals import refused_command

from gamba_warp import cli
from gamba_warp.commands import machine
from gamba_warp.kernels.bench import conv, measure, raster, scan
from gamba_warp.kernels.bench.measure import NotInstalled, Table
from gamba_warp.kernels.bench.report import markdown
from gamba_warp.kernels.cases import conv as conv_cases
from gamba_warp.kernels.cases import scan as scan_cases
from gamba_warp.kernels.cases.case import BOTH, Error, compare
from gamba_warp.kernels.cases.raster import work_of
from gamba_warp.kernels.cases.scan import make_inputs, scan_case
from gamba_warp.kernels.selective_scan.reference import selective_scan_reference
from gamba_warp.measure import models

QUICK = measure.Settings(torch.device("cpu"), "quick", threads=1)
# DESIGN's schema, and what it leaves to us.
SCHEMA = set(
    "op case variant device dtype direction ms_p20 ms_p50 ms_p80 jit_ms rel_rms_error max_error "
    "peer peer_ms work".split()
)
TIMES = ("ms_p20", "ms_p50", "ms_p80", "cpu_ms", "jit_ms")


@pytest.fixture(autouse=True)
def _three_rounds(monkeypatch):
    """Three rounds of everything; torch's threads as before."""
    monkeypatch.setitem(measure.LEVELS, "quick", measure.Level(0.0, 3, 3))
    with on_threads(torch.get_num_threads()):
        yield


def variant(name="ours", run=lambda: None, error=1e-8, **options):
    found = Error(error, error, "out")
    return measure.Variant(name, run, lambda: found, oracle="a loop", **options)


def case(*variants, name="one", op="scan"):
    return Table(op, name, lambda settings: list(variants))


def run(*cases):
    return measure.measure(cases, QUICK)


def measured(suite, name, settings=QUICK):
    """Return the records of the case of that name."""
    found = [c for c in suite.tables(settings) if c.name == name]
    return measure.measure(found, settings)["records"]


def stub(monkeypatch, *cases):
    """Makes ``gamba bench scan`` run these cases."""
    module = type("M", (), {"tables": lambda _: list(cases)})
    monkeypatch.setattr(machine, "load_suite", lambda op: module)


def test_records_have_the_schema_and_are_json():
    calls = []
    own = variant(run=lambda: calls.append("ours"), work=lambda: {"pairs": 7}, default=True)
    peer = variant("slow", run=lambda: calls.append("slow"), peer=True, rounds=1)
    document = run(case(own, peer))
    assert json.loads(json.dumps(document, allow_nan=False)) == document
    ours, slow = document["records"]
    assert SCHEMA <= ours.keys() and SCHEMA <= slow.keys()
    assert ours["status"] == "ok" and ours["work"] == {"pairs": 7} and ours["rounds"] == 3
    assert 0 <= ours["ms_p20"] <= ours["ms_p50"] <= ours["ms_p80"] and ours["cpu_ms"] >= 0
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
    row = next(line for line in markdown(document).splitlines() if "wrong" in line)
    assert "check failed" in row


def test_a_wrong_kernel_is_caught(monkeypatch):
    """A thousandth too much in one channel of the scan's output, and in the convolution's."""

    def off(function, at):
        def wrong(*arguments, **options):
            out = function(*arguments, **options)
            return out * torch.where(torch.arange(out.shape[-1]) == at, 1.001, 1.0)

        return wrong

    cpu, inputs = torch.device("cpu"), make_inputs(1, 40, 4)
    for right, status in ((True, "ok"), (False, "check failed")):
        if not right:
            monkeypatch.setattr(scan_cases, "selective_scan", off(scan_cases.selective_scan, 1))
        made = scan_case(inputs, cpu, 40)
        silu = conv_cases.silu if right else off(conv_cases.silu, 3)
        other = conv_cases.conv_case(cpu, (1, 30, 8, 4), silu)
        records = run(case(*measure.pair(made, "x"), *measure.pair(other, "y")))["records"]
        assert len(records) == 4 and all(r["status"].startswith(status) for r in records)


def raises(error):
    def function():
        raise error

    return function


def test_what_raises_is_recorded_and_the_rest_goes_on():
    missing = variant("missing", raises(NotInstalled("mambapy")), peer=True)
    broken = variant("broken", raises(RuntimeError("no such\nkernel")))
    large = Table("scan", "two", lambda settings: raises(MemoryError("too big"))())
    last = case(variant("last"), name="three")
    document = run(case(missing, broken, variant("fine")), large, last)
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

    second = case(variant("b", stop), variant("c"), name="two")
    stub(monkeypatch, case(variant("a")), second, case(variant("d")))
    assert machine.bench_command(("scan",), quick=True, out=tmp_path) == 130
    assert "interrupted" in capsys.readouterr().out
    document = json.loads((tmp_path / "bench.json").read_text())
    assert document["interrupted"] and "interrupted" in (tmp_path / "bench.md").read_text()
    rounds = {r["variant"]: r["rounds"] for r in document["records"]}
    assert rounds == {"a": 3, "b": 2, "c": 2}


@pytest.mark.parametrize(
    "arguments, reason",
    [
        (["scan", "--only", "two"], "--only two: no such case; there are one"),
        (["scan", "--out", "{}/file"], "cannot write into {}/file"),
        (["scan", "--out", "{}/file/deep"], "cannot write into {}/file/deep"),
    ],
)
def test_bad_input_is_one_line_and_code_2(monkeypatch, tmp_path, capsys, arguments, reason):
    (tmp_path / "file").write_text("x")
    stub(monkeypatch, case(variant("must not run", raises(AssertionError()))))
    words = [a.format(tmp_path) for a in arguments]
    refused_command(capsys, "bench", words, reason.format(tmp_path))


def test_failures_give_code_1(monkeypatch, tmp_path, capsys):
    stub(monkeypatch, case(variant("bad", error=1.0)))
    assert machine.bench_command(("scan",), quick=True, out=tmp_path) == 1
    assert "bad, forward: check failed" in capsys.readouterr().out
    stub(monkeypatch, case(variant("absent", raises(NotInstalled("gsplat")), peer=True)))
    assert machine.bench_command(("scan",), quick=True, out=tmp_path) == 0


def test_a_busy_machine_is_told():
    """Wall time beside CPU time."""
    import time

    document = run(case(variant("idle", lambda: time.sleep(0.02)), variant("b"), variant("c")))
    record = document["records"][0]
    assert record["cpu_ms"] < 0.5 * record["ms_p50"]
    record |= {"ms_p20": record["ms_p50"], "ms_p80": record["ms_p50"]}  # steady also under load
    load = "{} and {}".format(*(f"{load:.1f}" for load in document["machine"]["load"]))
    assert "The machine was busy: " in (page := markdown(document)) and f"load was {load}" in page
    record |= {"ms_p20": 1.0, "ms_p80": 1.5}
    assert markdown(document).count("(unsteady)") == page.count("(unsteady)") + 1
    for record in document["records"]:
        record["cpu_ms"] = record["ms_p50"]
    assert "busy" not in markdown(document)


def test_compare_of_tensors():
    want = {"a": torch.tensor([3.0, 4.0]), "b": torch.zeros(2)}
    got = {"a": torch.tensor([3.0, 4.5]), "b": torch.tensor([0.0, 1e-3])}
    error = compare(got, want)
    assert error.worst == "a" and error.maximum == pytest.approx(0.125)
    assert error.rel_rms == pytest.approx(rel_rms(got["a"], want["a"]))
    assert compare(got | {"b": torch.tensor([0.0, math.nan])}, want).rel_rms == math.inf
    assert compare(got | {"b": torch.zeros(3)}, want).worst == "b"
    assert compare({"a": torch.zeros(0)}, {"a": torch.zeros(0)}).rel_rms == 0


@pytest.mark.parametrize("groups", [1, 2])
def test_a_part_of_the_scan_is_the_truth_of_the_whole(groups):
    """The oracle on some tokens and channels finds no error in the reference run on all."""
    inputs = make_inputs(2, 30, 12, states=3, groups=groups)
    state = torch.randn(2, 12, 3)
    made = scan_case(inputs, torch.device("cpu"), 20, 4, initial_state=state)

    def reference(**inputs):
        inputs = {k: x.double() for k, x in inputs.items()}
        start = state.double()
        return selective_scan_reference(**inputs, delta_softplus=True, initial_state=start)[0]

    made.function = reference
    assert made.check("forward").rel_rms < 1e-15
    assert made.check(BOTH).rel_rms < 1e-7  # gradients come back in float32
    assert "4 of 12 channels, first 20 of 30 tokens" in made.oracle(BOTH)


def test_quick_scan_and_conv_from_the_command_line(tmp_path, capsys):
    code = cli.run("bench", ["scan", "conv", "--quick", "--threads", "2", "--out", str(tmp_path)])
    document = json.loads((tmp_path / "bench.json").read_text())
    records = document["records"]
    assert code == 0, [r["status"] for r in records if r["status"] != "ok"]
    assert {r["op"] for r in records} == {"scan", "conv"}
    assert all(r["rel_rms_error"] < 5e-2 for r in records)
    loop = next(r for r in records if r["variant"] == "torch loop, 256 x 64")
    ours = next(r for r in records if r["variant"] == "256 x 64")
    assert ours["peer"] == loop["variant"] and ours["peer_ms"] > ours["ms_p50"]
    names = {"bench.json", "bench.md", "bench-scan.svg", "bench-conv.svg"}
    assert names == {p.name for p in tmp_path.iterdir()}
    assert (tmp_path / "bench.md").read_text() == markdown(document)
    assert "wrote" in capsys.readouterr().out


def test_the_scene_and_its_crop():
    """The rasterizer is right on the oracle's crop; a wrong colour is seen."""
    scene = raster.make_scene(QUICK, 2, count=300, size=64)
    assert scene.check(BOTH).rel_rms < 1e-4
    wrong = raster.make_scene(QUICK, 2, count=300, size=64, exact={"alpha_min": 0.2})
    assert wrong.check("forward").rel_rms > 1e-2
    counts = work_of(scene, BOTH)
    assert counts["pairs"] > 100 and counts["tiles"] == 16 and counts["gaussians"] == 300


@pytest.mark.parametrize(
    "suite, name",
    [
        *((raster, name) for name in ("one call", "skipping", "harmonics")),
        (scan, "length"),
        (conv, "knobs"),
        (models, "backbone"),
        (models, "skipping"),
        (models, "mixers"),
        (machine.load_suite("step"), "batch"),
    ],
)
def test_cases_run(suite, name):
    records = measured(suite, name)
    assert records and all(r["status"] == "ok" for r in records), records
    if name == "skipping" and suite is raster:
        blocks = {(r["variant"], r["direction"]): r["work"]["blocks_traversed"] for r in records}
        for scene in ("few large", "many small"):
            assert blocks[f"{scene}: all on", BOTH] < blocks[f"{scene}: all off", BOTH]
    if name == "backbone":
        assert all(0 < r["rel_rms_error"] < 1e-7 for r in records)
    if name == "length":
        short, long = (r["work"]["saved_bytes"] for r in records if r["direction"] == BOTH)
        assert long == 4 * short
