"""``make study WHAT=growth``: slopes, what grows faster than its work, and what the words mean."""

import json
import math
import xml.etree.ElementTree as ET
from types import SimpleNamespace

import pytest
import torch
from lab.figures import growth as writer
from lab.studies import growth, show
from lab.studies.__main__ import GROUPS, STUDIES
from lab.studies.draw import growth_picture
from lab.studies.show import charts_of, markdown, page
from lab.studies.slopes import growth_lines, growth_table, growths, slope

from gamba_warp.commands.machine import SUITES
from gamba_warp.errors import UserError
from gamba_warp.kernels.bench.cases.raster_scene import Scene, orbit_cameras, shell
from gamba_warp.kernels.bench.core.case import Case, Settings, Variant
from gamba_warp.measure import suites
from gamba_warp.measure.suites import check_document

QUICK = Settings(torch.device("cpu"), "quick", threads=1)
SIZES = (1024, 4096, 16384, 65536)


def record(size, ms, units, peak=None, direction="forward", spread=0.01, axis="growth L"):
    return {
        **{"op": "growth-scan", "case": "L", "direction": direction, "dtype": "float32"},
        **{"axis": axis, "status": "ok", "variant": f"L {size}", "ms_p50": ms},
        **{"ms_p20": ms * (1 - spread), "ms_p80": ms * (1 + spread)},
        **{"parameters": {"L": size, "unit": "elements"}},
        **{"work": {"units": units} | ({} if peak is None else {"peak_bytes": peak})},
    }


def law(exponent, bend=lambda size: 1.0, **more):
    return [
        record(size, 1e-3 * size**exponent * bend(size), 7 * size, 100 * size, **more)
        for size in SIZES
    ]


def test_slope_of_a_power_law_and_of_noise_around_it():
    assert slope({s: 3 * s**1.25 for s in SIZES}) == pytest.approx(1.25)
    assert slope({4: 5.0, 8: 5.0}) == 0
    assert slope({4: 5.0}) is None and slope({}) is None
    # Least squares by hand: the logarithms to base 2 are (0, 0), (1, 2), (2, 1).
    assert slope({1: 1.0, 2: 4.0, 4: 2.0}) == pytest.approx(0.5)
    assert slope({1e300: 1.0, math.nextafter(1e300, 2e300): 2.0}) is None


def test_what_grows_as_its_work_is_not_named():
    time_, memory = growths(law(1.0))
    assert (time_.figure, memory.figure) == ("time", "memory")
    assert time_.slope == pytest.approx(1) and time_.work_slope == pytest.approx(1)
    assert not time_.faster and not memory.faster
    assert time_.text() == (
        "forward, float32, time over L grows no faster than its work (elements)."
    )
    assert growth_lines(law(1.0)) == ["Nothing here grows faster than its work."]
    assert growth_lines(law(0.4)) == ["Nothing here grows faster than its work."]


def test_what_grows_faster_is_named_in_a_sentence():
    records = law(1.0) + law(1.2, direction="forward+backward")
    said = growth_lines(records)
    assert said == [
        "forward+backward, float32, time over L grows faster than its work (elements): from 1,024 "
        "to 65,536 its slope is 1.20 and that of the work 1.00, so that one costs 2.30 times as "
        "much.",
        "Nothing else here grows faster than its work.",
    ]
    header, rows = growth_table(records)
    assert [row[:3] for row in rows] == [
        [direction, "float32", figure]
        for direction in ("forward", "forward+backward")
        for figure in ("time", "memory")
    ]
    assert rows[2][4:] == ["1.20", "1.00 (elements)", "x 2.30 from 1,024 on, faster"]
    assert len(header) == len(rows[0])


def test_a_bend_at_the_end_is_seen_where_the_fitted_slope_hides_it():
    """A fixed cost at small sizes makes the whole slope less than 1, the last step is too dear."""
    bend = {1024: 40.0, 4096: 4.0, 16384: 1.0, 65536: 1.8}
    (time_, _) = growths(law(1.0, bend.__getitem__))
    assert time_.slope < 1 and time_.faster and time_.cheapest == 16384
    assert time_.dearer == pytest.approx(1.8)
    assert time_.end_slopes[0] == pytest.approx(1 + math.log(1.8, 4))


def test_noise_is_not_growth():
    bend = {1024: 1.0, 4096: 1.0, 16384: 1.0, 65536: 1.3}
    (time_, _) = growths(law(1.0, bend.__getitem__, spread=0.2))
    assert time_.dearer == pytest.approx(1.3) and not time_.faster
    (time_, _) = growths(law(1.0, bend.__getitem__, spread=0.05))
    assert time_.faster
    # Memory has no spread, but a heap takes more than is asked for: small amounts say nothing.
    for scale, faster in ((1.0, False), (100.0, True)):
        bytes_ = [record(size, 1.0, size, scale * size**1.05) for size in SIZES]
        assert growths(bytes_)[1].faster == faster
    slightly = {1024: 1.0, 4096: 1.0, 16384: 1.0, 65536: 1.05}
    (time_, _) = growths(law(1.0, slightly.__getitem__, spread=0.0))
    assert not time_.faster


def test_strange_numbers_do_no_harm():
    records = law(1.0) + [record(1e299, 1e-299, 1e299), record(True, 1.0, 1), record("x", 1.0, -1)]
    records += [record(2e299, 1e299, 1e-299), record(7, 1.0, 0) | {"status": "failed: no"}]
    assert len(growths(records)) == 2 and growth_table(records) and charts_of("L", records)
    assert growths([]) == [] and growths(law(1.0)[:1]) == [] and growth_lines([]) == []
    assert growth_lines([r | {"axis": None} for r in law(1.0)]) == []


def texts(svg):
    nodes = ET.fromstring(svg).iter()
    return ["".join(node.itertext()) for node in nodes if node.tag.endswith(("text", "tspan"))]


def test_charts_show_lines_slopes_and_the_work():
    records = law(1.0) + law(1.2, direction="forward+backward")
    time_, memory = charts_of("L", records)
    assert {"forward 1.00", "forward+backward 1.20", "elements 1.00"} <= set(texts(time_))
    assert "line guide" in time_ and "MiB at the peak" in texts(memory)
    # The picture is a file of its own: it has its name space, its colours and a title a chart.
    picture = growth_picture([{"records": records}])
    assert ET.fromstring(picture).tag == "{http://www.w3.org/2000/svg}svg"
    assert texts(picture).count("growth-scan: L") == 2 and "--s0:" in picture
    assert growth_picture([{"records": []}]) == ""


def test_words_name_parts():
    def chosen(*what):
        return suites.choose(what, STUDIES, GROUPS)

    assert chosen("growth") == ["growth-scan", "growth-raster", "growth-errors"]
    assert chosen("growth-errors", "step") == ["step", "growth-errors"]
    assert suites.choose(["all"], SUITES, {"all": tuple(SUITES)}) == list(SUITES)
    with pytest.raises(UserError, match="unknown case 'growht'.* growth-scan,.* and growth"):
        chosen("growht")


def test_only_measures_the_cases_that_are_named():
    def case(name):
        build = [Variant("a", lambda: None, None)].copy
        return Case("growth-scan", name, "A text.", build)

    module = SimpleNamespace(cases=lambda s: [case("L"), case("D")], targets=lambda s: [])
    found = suites.run_suites({"growth-scan": module}, QUICK, ("D",))
    assert [r["case"] for r in found["records"]] == ["D"]
    with pytest.raises(UserError, match="--only M: no such case; there are L; D"):
        suites.run_suites({"growth-scan": module}, QUICK, ("L", "M"))


@pytest.mark.parametrize("op, only", [(growth.SCAN, ("L", "N")), (growth.RASTER, ("Gaussians",))])
def test_a_run_of_small_sizes(op, only, tmp_path):
    found = suites.run_suites({op: growth}, QUICK, only)
    assert not suites.failed_records(found)
    check_document(json.loads(json.dumps(found, allow_nan=False)))
    for r in found["records"]:
        sizes = r["parameters"]
        if op == growth.SCAN:
            assert r["work"]["units"] == math.prod(sizes[k] for k in "BLDN")
        else:
            assert r["work"]["units"] == r["work"]["pairs"] + sizes["views"] * sizes["N"]
    for name in only:
        assert f"{op}: {name}" in markdown([found]) and f"{op}: {name}" in page([found])
    assert "grows faster than its work" in show.summary(found)
    suites.write_document(found, tmp_path)
    again = suites.read_document(tmp_path / "bench.json")
    (path,) = show.write_pages([again, again], tmp_path / "joined.json")
    assert suites.read_document(path)["records"] == again["records"]
    (path,) = show.write_pages([again], tmp_path / "growth.svg")
    assert ET.fromstring(path.read_text(encoding="utf-8")) is not None
    with pytest.raises(UserError, match="no cases of growth"):
        show.write_pages([again | {"records": []}], tmp_path / "none.svg")


def test_results_of_two_machines_are_not_joined():
    one = suites.run_suites({}, QUICK)
    other = one | {"machine": one["machine"] | {"cpu": "another"}}
    with pytest.raises(UserError, match="cpu is .* and another"):
        show.join([one, other])
    with pytest.raises(UserError, match="different levels"):
        show.join([one, one | {"settings": {"level": "full", "peers": False}}])


def test_the_oracle_of_many_gaussians_sees_all_that_reach_the_crop(monkeypatch):
    scene = Scene(shell(3000, 2), *orbit_cameras(1, 96), 96, torch.device("cpu"))
    for backward, limit in ((False, 1e-5), (True, 1e-4)):
        near = growth.near_crop(scene, backward)
        assert 0 < near.sum() < len(near)
        # Measured below 3e-7 and 1e-6, as with the oracle of all Gaussians.
        assert growth.check_near(scene, backward).rel_rms < limit
    few = growth.near_crop(scene, False) & (torch.arange(3000) % 20 != 0)
    monkeypatch.setattr(growth, "near_crop", lambda *arguments: few)
    assert growth.check_near(scene, False).rel_rms > 1e-2


def test_the_page_of_growth_shows_the_results():
    document = suites.read_document(writer.RESULTS)
    text = writer.PAGE.read_text(encoding="utf-8")
    assert writer.page_of(text, document) == text, "run: make figures"
    for name, path in writer.PICTURES.items():
        picture = growth_picture([writer.split(document)[name]])
        shown = path.read_text(encoding="utf-8") if path.exists() else ""
        assert shown == picture, "run: make figures"
    for r in document["records"]:
        assert r["status"] == "ok", (r["case"], r["variant"], r["status"])
    with pytest.raises(ValueError, match="no mark"):
        writer.page_of("", document)
