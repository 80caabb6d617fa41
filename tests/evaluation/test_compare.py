"""``gamba compare``: several methods' reports in one table."""

import copy
import json
import runpy
from pathlib import Path

import numpy as np
import pytest

from gamba_warp.cli import run
from gamba_warp.eval.averages import bootstrap

ROOT = Path(__file__).parents[2]
UIDS = ("a", "b", "c", "d")


def views_report(offset=0.0, uids=UIDS):
    """Make a report like eval-views, with the fields that are read."""
    objects = [
        {
            **{"name": uid, "status": "ok", "truth_sha256": f"{uid}0", "views": [0, 1]},
            **{"psnr": 20.0 + offset + i * (1 + offset), "ssim": 0.8, "lpips": None},
            "mask_iou": 0.5,
        }
        for i, uid in enumerate(UIDS)
        if uid in uids
    ]
    protocol = {"max_psnr": 100.0, "reference": 0, "split": "test", "lpips": None}
    return {"protocol": protocol | {"source": {"kind": "images"}}, "objects": objects}


def shapes_report(offset=0.0, kind="mesh", voxels=128):
    objects = [
        {
            **{"name": uid, "status": "ok", "gt_sha256": f"{uid}1", "kind": kind},
            **{"chamfer": 0.05 + 0.01 * offset, "iou": None if i == 0 else 0.4 + 0.1 * i},
        }
        for i, uid in enumerate(UIDS)
    ]
    protocol = {"occupancy": "solid", "frame": "gt", "surface": {"voxels": voxels}}
    return {"protocol": protocol, "objects": objects}


class Files:
    """Writes reports, and runs the command on them."""

    def __init__(self, folder, capsys):
        self.folder, self.capsys = folder, capsys

    def add(self, name, report):
        path = self.folder / f"{name}.json"
        path.write_text(json.dumps(report))
        return path

    def run(self, *words):
        code = run("compare", [*map(str, words), "--out", str(self.folder / "out")])
        said = self.capsys.readouterr()
        path = self.folder / "out" / "compare.json"
        return code, said, json.loads(path.read_text()) if path.exists() else None


@pytest.fixture
def files(tmp_path, capsys):
    return Files(tmp_path, capsys)


def test_means_intervals_and_paired_differences(files):
    words = [
        f"ours={files.add('one', views_report())}",
        f"ours={files.add('two', shapes_report())}",
    ]
    words.append(f"theirs={files.add('three', views_report(1.0))}")
    code, said, joined = files.run(*words, "--json")
    assert code == 0 and json.loads(said.out) == joined
    code, said, joined = files.run(*words)
    ours, theirs = joined["rows"]
    assert ours["psnr"]["mean"] == 21.5 and theirs["psnr"]["mean"] == 24
    known = bootstrap(np.array([20.0, 21, 22, 23]), lambda drawn: drawn.mean(-1))
    assert ours["psnr"]["interval"] == known
    assert theirs["lpips"] is None and theirs["chamfer"] is None
    (difference,) = joined["differences"]
    assert difference["name"] == "theirs - ours"
    assert difference["psnr"]["mean"] == 2.5 and difference["psnr"]["interval"][0] > 1
    assert joined["common"]["iou"] == ["b", "c", "d"] and len(joined["common"]["chamfer"]) == 4
    lines = {line.split("|")[1].strip(): line for line in said.out.splitlines() if "|" in line}
    assert "24.00 [" in lines["theirs"] and lines["theirs"].count(" - ") == 2
    assert "Volume IoU: 3 objects" in said.out
    assert said.out == (files.folder / "out" / "compare.md").read_text()


def test_methods_are_compared_by_their_shapes_alone(files):
    """All metrics of shapes, paired by object, in the protocol's unit."""
    reports = []
    for offset in (0.0, 0.5, -1.0):
        report = change(shapes_report(offset), thresholds=[0.01, 0.5], unit=2.0)
        for i, record in enumerate(report["objects"]):
            record["fscore"] = {"0.01": 0.3 + 0.1 * i, "0.5": 0.9 + 0.1 * offset * (i == 1)}
            record |= {"accuracy": 0.1, "completeness": 0.2, "normal_consistency": None}
        reports.append(report)
    reports[2]["objects"][0] = {"name": "a", "status": "failed", "reason": "the mesh has no area"}
    names = ("x", "y_1", "z")
    words = [f"{name}={files.add(name, report)}" for name, report in zip(names, reports)]
    code, said, joined = files.run(*words)
    assert code == 0 and joined["common"]["fscore.0.5"] == ["b", "c", "d"]
    second, third = joined["differences"]
    assert second["fscore.0.5"]["mean"] == pytest.approx(0.05 / 3)
    assert second["fscore.0.5"]["interval"] == pytest.approx([0, 0.05 / 3 * 3])
    assert third["chamfer"]["mean"] == pytest.approx(-0.01)
    assert joined["rows"][0]["fscore.0.01"]["mean"] == pytest.approx(0.5)
    head, *_ = said.out.splitlines()
    assert "Chamfer" in head and "Volume IoU" in head and "PSNR" not in head
    assert "true shape is 2." in said.out and "z lacks 1 object (a: the mesh" in said.out
    more = said.out.partition("Further metrics")[2]
    assert "F-score at 0.5 ↑" in more and "+0.0167 [" in more and "normals" not in more


def test_what_a_method_lacks_counts_for_none_and_is_named(files):
    lacking = views_report(1.0, uids=("a", "b", "c"))
    lacking["objects"].append({"name": "d", "status": "failed", "reason": "no image of view 3"})
    first = files.add("one", views_report(uids=("b", "c", "d")))
    code, said, joined = files.run(f"x={first}", f"y={files.add('two', lacking)}")
    assert code == 0 and joined["common"]["psnr"] == ["b", "c"]
    assert joined["rows"][0]["psnr"]["mean"] == 21.5
    missing = {"x": {"a": "not in its report"}, "y": {"d": "no image of view 3"}}
    assert joined["missing"]["eval-views"] == missing
    assert "y lacks 1 object (d: no image of view 3)" in said.out


def change(report, **values):
    changed = copy.deepcopy(report)
    changed["protocol"] |= values
    return changed


def other_gt(report):
    changed = copy.deepcopy(report)
    changed["objects"][1] |= {"truth_sha256": "other", "gt_sha256": "other"}
    return changed


def test_other_grounds_are_further_metrics(files):
    """Images without alpha have no such figures, and an older report lacks them too."""
    hazy = change(views_report(1.0), grounds={"black": 0.0, "grey": 0.5})
    for record in hazy["objects"]:
        record |= {"psnr_black": record["psnr"] - 4, "psnr_grey": None, "lpips_black": 0.25}
    first = files.add("one", views_report())
    code, said, joined = files.run(f"old={first}", f"hazy={files.add('two', hazy)}")
    assert code == 0
    lines = said.out.partition("Further metrics")[2].splitlines()
    assert "PSNR on black ↑" in lines[2] and "grey" not in lines[2] and lines[4].count(" - ") == 2
    assert "20.00 [" in lines[5] and "0.250 [" in lines[5]
    assert joined["rows"][1]["psnr_black"]["mean"] == 20
    assert "on black" not in files.run(f"old={first}")[1].out


V, S = views_report(), shapes_report()


@pytest.mark.parametrize(
    "one, other, said",
    [
        (V, change(V, reference=2), "reference is 2, not 0"),
        (V, change(V, size=64), "size is 64, not absent"),
        (change(V, lpips="A"), change(V, lpips="B"), "lpips is B, not A"),
        (V, other_gt(V), "b has another ground truth"),
        (S, change(S, occupancy="parity"), "occupancy is parity, not solid"),
        (S, other_gt(S), "b has another ground truth"),
        (shapes_report(kind="gaussians"), shapes_report(0, "gaussians", 64), "surface.voxels"),
        (V, views_report(uids=()), "no object was evaluated for all methods"),
        (V, {"protocol": {}, "objects": []}, "not a report of gamba eval-views"),
        (V, {"objects": []}, "protocol"),
        (V, change(V) | {"objects": [{"name": "a", "status": "ok"}]}, "truth_sha256"),
        (V, change(V) | {"objects": V["objects"] * 2}, "a duplicate one"),
        (V, [], "two.json"),
    ],
)
def test_what_cannot_stand_in_one_table_is_refused(files, one, other, said):
    first, second = files.add("one", one), files.add("two", other)
    code, streams, joined = files.run(f"x={first}", f"y={second}")
    assert code == 2 and joined is None
    assert said in streams.err and streams.err.count("\n") == 1, streams.err


def test_what_only_places_a_methods_files_may_differ(files):
    gaussians = change(shapes_report(kind="gaussians", voxels=64), frame="reference")
    views = change(V, lpips="VGG16", split="all", distance=2.0, resize_images=True)
    reports = {"x-views": V, "x-shapes": S, "y-views": views, "y-shapes": gaussians}
    words = [f"{name[0]}={files.add(name, report)}" for name, report in reports.items()]
    code, said, _ = files.run(*words)
    assert code == 0 and "Images of y were resized" in said.out


@pytest.mark.parametrize(
    "words, said",
    [
        (["x"], "x: expected NAME="),
        (["=report.json"], "expected NAME="),
        (["a|b=report.json"], "no '|'"),
        (["x=nowhere.json"], "nowhere.json"),
        (["x={0}", "x={0}"], "x already has a report of eval-views"),
        (["x={0}", "--against", "z"], "--against z: expected one of x"),
        ([f"x{i}={{0}}" for i in range(51)], "at most 50"),
        ([], "NAME=REPORT"),
    ],
)
def test_bad_arguments_are_one_line(files, words, said):
    path = files.add("one", V)
    code, streams, joined = files.run(*(word.format(path) for word in words))
    assert code == 2 and joined is None
    assert said in streams.err and streams.err.count("\n") == 1


def test_the_worked_example(tmp_path, capsys):
    """docs/examples/compare_methods.py, with one object, three views and coarse shapes."""
    if not (ROOT / "starter" / "data").is_dir():
        pytest.skip("the starter set is in a checkout alone")
    example = runpy.run_path(str(ROOT / "docs/examples/compare_methods.py"))
    words = f"--out {tmp_path} --objects 1 --views 3 --points 1000 --voxels 24 --lpips off"
    example["main"](words.split())
    joined = json.loads((tmp_path / "compare.json").read_text())
    rows = {row["name"]: row for row in joined["rows"]}
    assert list(rows) == ["shipped", "retrieval", "billboard", "hull"]
    assert all(row["psnr"]["mean"] > 10 for row in rows.values())
    assert rows["billboard"]["chamfer"] is None and rows["hull"]["iou"]["mean"] > 0.1
    # The baselines' files give what the evaluation of the model said of the baselines themselves.
    report = json.loads((tmp_path / "shipped" / "report.json").read_text())
    for name in ("retrieval", "billboard"):
        expected = report["baselines"][name]["psnr"]
        assert abs(rows[name]["psnr"]["mean"] - expected) < 0.01  # roundings to 8 bits
    hull = json.loads((tmp_path / "hull-views" / "report.json").read_text())
    assert hull["objects"][0]["images"]["matched_by"] == "camera"
    capsys.readouterr()
