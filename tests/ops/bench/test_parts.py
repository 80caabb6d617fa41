"""The parts of a run: what the profiler's times are summed to, and how they are shown."""

import pytest
import torch
from lab.studies import parts
from lab.studies.__main__ import load_study, study
from lab.studies.show import markdown, page
from torch.profiler import record_function

from gamba_warp.errors import UserError
from gamba_warp.kernels.bench.core.case import LEVELS, Case, Level, Settings, Variant
from gamba_warp.kernels.bench.core.measure import measure

QUICK = Settings(torch.device("cpu"), "quick", threads=1)


@pytest.fixture(autouse=True)
def short(monkeypatch):
    """One round of everything, on one thread; torch's threads as before."""
    monkeypatch.setitem(LEVELS, "quick", Level(0.0, 1, 1))
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


def measured(op, *names):
    """The records of a study's cases of these names."""
    return measure([c for c in load_study(op).cases(QUICK) if c.name in names], QUICK)["records"]


def run() -> None:
    """A product and a sine in one region, a large sine in another, and one in none."""
    x = torch.rand(200, 200, requires_grad=True)
    with record_function("outer"):
        y = (x @ x).sin()
        with record_function("inner"):
            z = torch.cat([y] * 40).sin().sum()
    torch.rand(3_000_000).cos()
    z.backward()


def test_parts_are_of_regions_and_kinds_and_their_gradients():
    found = parts.measure_parts(run, ("outer", "inner"), {"outer": {"aten::mm": "products"}}, 3)
    names = {name for name in found if name.startswith(parts.PREFIXES)}
    three = ("products", "outer", "inner")
    assert names == {prefix + name for prefix in parts.PREFIXES for name in three}
    assert all(found[name] > 0 for name in found)
    # The cosine lies in no region, and the large sine's gradient in the inner one.
    assert found[parts.REST] > 0.2
    assert found["backward: inner"] > found["backward: outer"]
    assert sum(found[name] for name in names) < found[parts.WHOLE]


def test_one_rounds_parts_and_the_rest_are_the_whole():
    found = parts.measure_parts(run, ("outer", "inner"), {}, 1)
    whole = found.pop(parts.WHOLE)
    assert sum(found.values()) == pytest.approx(whole, rel=1e-6)


def case(work: dict) -> Case:
    variant = Variant("one & only", lambda: None, None, work=lambda: work)
    return Case("step", "parts", "What takes time.", lambda: [variant])


def test_parts_are_a_table():
    work = {"forward: scan": 1.0, "forward: data": 4.0, "backward: scan": 4.5}
    document = measure([case(work | {parts.REST: 0.5, parts.WHOLE: 10.0})], QUICK)
    lines = markdown([document]).splitlines()
    rows = [line for line in lines if line.startswith("| one & only") and "float32" not in line]
    assert rows == [
        "| one & only | scan | 1 | 4.5 | 55.0% |",
        "| one & only | data | 4 |  | 40.0% |",
        "| one & only | not attributed | 0.5 |  | 5.0% |",
        "| one & only | whole, under the profiler | 10 |  |  |",
    ]
    assert "<td" in page([document]) and "not attributed" in page([document])


def test_a_step_has_its_parts():
    records = measured("step", "parts")
    tiny, lower, rays, _, _ = records
    assert (tiny["variant"], lower["variant"]) == ("tiny", "tiny, bfloat16")
    for record in records:
        assert record["status"] == "ok", record
        found = set(parts.parts_of(record))
        wanted = {"data", "products", "scan", "rasterizer", "SSIM", "optimizer"}
        assert wanted <= found, wanted - found
        assert record["work"]["backward: scan"] > 0 and record["work"]["backward: rasterizer"] > 0
    assert rays["work"]["drawn"] > tiny["work"]["drawn"] > 0


def test_a_step_on_a_folder_that_is_not_there_is_one_line(tmp_path):
    with pytest.raises(UserError, match="no such folder"):
        study(("step",), quick=True, out=tmp_path, data=tmp_path / "none")
