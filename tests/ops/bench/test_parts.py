"""The parts of a run: what the profiler's times are summed to, and how they are shown."""

import xml.etree.ElementTree as ET

import pytest
import torch
from lab.studies import parts
from lab.studies.__main__ import load_study, study
from lab.studies.draw import bars
from lab.studies.show import charts_of, markdown, page
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
    return Case("step", "parts", "What takes time.", lambda: [variant], "parts")


def test_parts_are_a_table_and_a_chart():
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
    (svg,) = charts_of("parts", document["records"])
    widths = [float(r.get("width", 0)) for r in ET.fromstring(svg).iter("rect")]
    assert widths[0] == 355.0 and widths[1] == pytest.approx(355 * 4 / 5.5, abs=0.1)
    assert "<td" in page([document]) and "not attributed" in page([document])


def test_bars_of_nothing_are_no_chart():
    assert bars({}, "ms") == bars({"a": {}}, "ms") == bars({"a": {"b": 0.0}}, "ms") == ""


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


@pytest.mark.parametrize(("op", "name"), [("step", "precision"), ("model", "precision")])
def test_bfloat16_products_have_their_error_on_the_chart(op, name):
    records = measured(op, name)
    assert [r["status"] for r in records] == ["ok"] * 4
    for full, lower in zip(records[::2], records[1::2]):
        assert full["rel_rms_error"] < 1e-5 and lower["rel_rms_error"] > full["rel_rms_error"]
        assert full["work"]["psnr_to_float32"] > lower["work"]["psnr_to_float32"] > 30
    assert "bfloat16" in charts_of(name, records)[0]


def test_losses_and_optimizer_are_checked_before_they_are_timed():
    records = measured("step", "SSIM", "optimizer")
    assert len(records) == 13 and all(r["status"] == "ok" for r in records), records
    ours = [r for r in records if r["variant"].startswith("ours")]
    assert all(r["rel_rms_error"] < 1e-5 and r["peer"].startswith("kornia") for r in ours)


def test_dropped_patches_are_exact_and_counted():
    records = measured("step", "background")
    assert [r["status"] for r in records] == ["ok"] * 4
    assert all(r["rel_rms_error"] < 1e-5 for r in records)
    tokens = {r["parameters"]["series"]: r["work"]["tokens"] for r in records}
    assert tokens["all patches"] == 4 * 4 * 16 and tokens["object's patches"] == 4 * 20
    charts = charts_of("background", records)
    labels = ("milliseconds, forward", "memory, MiB, forward", "tokens of a batch")
    assert [sum(label in chart for chart in charts) for label in labels] == [2, 2, 1]
    assert all("all patches" in chart and "object&#39;s patches" in chart for chart in charts)


def test_a_step_on_a_folder_that_is_not_there_is_one_line(tmp_path):
    with pytest.raises(UserError, match="no such folder"):
        study(("step",), quick=True, out=tmp_path, data=tmp_path / "none")
