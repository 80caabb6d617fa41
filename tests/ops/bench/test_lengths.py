"""``make study WHAT=lengths``: the crossing of two lines, the limits of a series, its memory."""

import json
import xml.etree.ElementTree as ET
from functools import partial
from types import SimpleNamespace

import pytest
import torch
from lab.studies import lengths
from lab.studies.crossing import crossings
from lab.studies.lengths import ATTENTION, BOTH, MAMBA, Bench, Line, Sizes
from lab.studies.show import charts_of, markdown, page, summary, with_crossings

from gamba_warp.kernels.bench.core.case import Case, Settings
from gamba_warp.measure import suites
from gamba_warp.measure.suites import check_document

QUICK = Settings(torch.device("cpu"), "quick", threads=1)
SIZES = Sizes((40, 97), 64, 60.0)  # 97 is no whole number of chunks or segments


def record(series, length, ms, peak=None, **more):
    return {
        **{"op": "lengths", "case": "forward", "direction": "forward", "dtype": "float32"},
        **{"axis": "lengths", "status": "ok", "variant": f"{series} {length}", "ms_p50": ms},
        **{"parameters": {"L": length, "series": series}},
        **{"work": {} if peak is None else {"peak_bytes": peak}},
        **more,
    }


def powers(a, b, where=(1024, 2048, 4096, 8192)):
    return [
        record(name, L, line(L), peak=1000 * L * (3 if name == "a" else 2))
        for L in where
        for name, line in (("a", a), ("b", b))
    ]


def test_power_laws_cross_where_they_do():
    """2 L against L²/1500: straight on logarithmic axes, so L* = 3000 to rounding."""
    time_, memory = crossings(powers(lambda L: 2.0 * L, lambda L: L * L / 1500))
    assert time_.figure == "time" and time_.cheaper == "a"
    assert time_.at == pytest.approx(3000) and time_.value == pytest.approx(6000)
    assert "L* = 3,000; beyond it a costs less than b" in time_.text()
    assert memory.at is None and memory.cheaper == "b"
    assert memory.text().endswith("b costs less at every L from 1,024 to 8,192.")


def test_the_last_of_several_crossings_counts_and_only_common_lengths():
    values = {1024: (1, 2), 2048: (2, 1), 4096: (3, 6), 8192: (5, 20)}
    records = [
        record(name, L, float(pair[i])) for L, pair in values.items() for i, name in enumerate("ab")
    ]
    (found,) = crossings(records)
    assert 2048 < found.at < 4096 and found.cheaper == "a"
    records[-1] |= {"status": "stopped: too slow"}
    (found,) = crossings(records)
    assert found.lengths == (1024, 4096)
    assert crossings(records[:1]) == [] and crossings([]) == []
    # A stranger's file: numbers of any size, and what is no figure.
    strange = [record("a", 1, 1e-300), record("b", 1, 1e300), record("a", 10**200, 1e300)]
    strange += [record("b", 10**200, 1e-300), record("b", True, 1.0, -5), record("c", "x", 1.0)]
    (found,) = crossings(strange)
    assert found.at == pytest.approx(1e100, rel=1e-6) and found.cheaper == "b"


def test_the_page_draws_the_crossing():
    records = powers(lambda L: 2.0 * L, lambda L: L * L / 1500)
    charts = charts_of("forward", records)
    assert len(charts) == 2
    time_, memory = (ET.fromstring(svg) for svg in charts)
    texts = ["".join(node.itertext()) for node in time_.iter() if node.tag in ("text", "tspan")]
    assert "L* = 3,000" in texts and {"a", "b", "crossing"} <= set(texts)
    assert not any("L*" in "".join(node.itertext()) for node in memory.iter())


@pytest.mark.parametrize("name", [MAMBA, ATTENTION])
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16], ids=str)
def test_both_blocks_agree_with_float64(name, dtype):
    bench = Bench(QUICK, SIZES, dtype)
    half = dtype != torch.float32
    for length in SIZES.lengths:
        limits = (
            (lengths.HALF_LIMITS["forward"], lengths.HALF_LIMITS[BOTH])
            if half
            else (lengths.LIMIT, lengths.BACKWARD_LIMIT)
        )
        assert bench.check(name, length).rel_rms < limits[0]
        assert bench.check_step(name, length).rel_rms < limits[1]


def test_the_check_sees_an_attention_that_forgets_a_token(monkeypatch):
    real = torch.nn.functional.scaled_dot_product_attention

    def forgets(q, k, v, attn_mask=None):
        return real(q, k[:, :, :-1], v[:, :, :-1])

    bench = Bench(QUICK, SIZES, torch.float32)
    monkeypatch.setattr(torch.nn.functional, "scaled_dot_product_attention", forgets)
    assert bench.check(ATTENTION, 97).rel_rms > lengths.LIMIT
    assert bench.check_step(ATTENTION, 97).rel_rms > lengths.BACKWARD_LIMIT


def test_a_step_trains_and_leaves_the_weights():
    bench = Bench(QUICK, SIZES, torch.float32)
    for name, block in bench.blocks.items():
        before = [p.detach().clone() for p in block.parameters()]
        bench.step(name, 40)
        assert bench.optimizers[name].state  # AdamW has its moments: it was run
        assert all(torch.equal(a, b) for a, b in zip(before, block.parameters()))


def test_a_fused_kernel_is_used(monkeypatch):
    """No L x L matrix: twice the length takes twice the memory, not four times."""
    bench = Bench(QUICK, Sizes((2048, 4096), 64, 60.0), torch.float32)
    line = Line(ATTENTION, "forward", bench)
    peaks = []
    for length in (2048, 4096):
        line.run(length)
        line.check(length)
        peaks.append(line.work(length).get("peak_bytes"))
    if None in peaks:
        pytest.skip("no count of resident memory here")
    assert peaks[1] < 3 * peaks[0] < 3 * 2048 * 2048 * 4


class Slow(Bench):
    """Two made-up blocks, on a clock of their own: a takes L ms, b L²/16 ms, and known memory.

    The first call of each length takes a second more, as if something was compiled.
    """

    def __init__(self, sizes):
        self.sizes, self.device, self.dtype = sizes, torch.device("cpu"), torch.float32
        self.now, self.called = 0.0, set()
        self.blocks = {"a": torch.nn.Linear(1, 1), "b": torch.nn.Linear(1, 1)}

    def forward(self, name, length):
        self.now += 1e-3 * (length if name == "a" else length**2 / 16)
        self.now += (name, length) not in self.called
        self.called.add((name, length))
        return torch.ones(length * 2**20)  # 4 MiB a token

    def check(self, name, length):
        return lengths.Error(0.0, 0.0, "")


def document(monkeypatch, sizes):
    slow = Slow(sizes)
    monkeypatch.setattr(lengths, "Bench", lambda *arguments: slow)
    monkeypatch.setattr(lengths, "time", SimpleNamespace(perf_counter=lambda: slow.now))
    build = partial(lengths.lines, QUICK, sizes, "forward", torch.float32)
    case = Case("lengths", "forward, float32", "A text.", build, "lengths")
    module = type("Suite", (), {"cases": lambda s: [case]})
    return with_crossings(suites.run_suites({"lengths": module}, QUICK))


def test_a_series_ends_at_its_limit_and_says_so(monkeypatch):
    found = document(monkeypatch, Sizes((4, 8, 16, 32, 64), 8, 0.017))
    status = {r["variant"]: r["status"] for r in found["records"]}
    # 32 tokens would be the first length over 17 ms, so it is not begun.
    assert [status[f"{name}, L {L}"] for name in "ab" for L in (4, 8, 16)] == ["ok"] * 6
    stopped = {text for text in status.values() if text != "ok"}
    limits = {f"stopped: L 32 would take {seconds} s, limit 0.017 s" for seconds in (0.032, 0.064)}
    assert stopped == limits
    assert sum(text != "ok" for text in status.values()) == 4
    assert not suites.failed_records(found)
    check_document(json.loads(json.dumps(found, allow_nan=False)))
    assert found["crossings"][0]["lengths"] == (4, 16)
    text = summary(found)
    assert "stopped: L 32 would take 0.064 s" in text
    assert "lengths: forward, float32, memory" in text
    assert "stopped: L 32 would" in markdown([found]) and "<svg" in page([found])


def test_known_memory_is_seen_and_ends_a_series(monkeypatch):
    line = Line("a", "forward", Slow(Sizes((4, 8, 16), 8, 60.0)))
    line.run(8)
    line.check(8)
    if not line.work(8):
        pytest.skip("no count of resident memory here")
    assert 0.98 < line.work(8)["peak_bytes"] / (8 * 2**22) < 1.2
    monkeypatch.setattr(lengths, "free_bytes", lambda device: 90 * 2**20)
    with pytest.raises(lengths.Stopped, match="L 16 may need 0.1 GiB, 0.1 are free"):
        line.run(16)
    line.run(8)  # what was measured goes on


def test_running_out_of_memory_ends_a_series(monkeypatch):
    line = Line("a", "forward", Slow(Sizes((4, 8, 16), 8, 60.0)))

    def exhausted(name, length):
        raise RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried 9 bytes")

    monkeypatch.setattr(line.bench, "forward", exhausted)
    for length in (8, 16):
        with pytest.raises(lengths.Stopped, match="not enough memory at L 8"):
            line.run(length)
