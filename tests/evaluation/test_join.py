"""Reports of --shard i/n, joined: equal to that of the undivided evaluation."""

import json
import shutil

import pytest
import trimesh
from helpers import micro
from helpers.refusals import refused
from helpers.views import evaluated

from gamba_warp import cli
from gamba_warp.data import gso
from gamba_warp.eval.join.join import join_reports
from gamba_warp.formats.ply import save_ply

pytestmark = pytest.mark.usefixtures("one_thread")
NAMES = ["a", "a-b", "b", "c", "d"]
SHARDS = ["0/2", "1/2"]


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    """Five objects with predictions, of which one is missing, and one has no picture of a view."""
    root = tmp_path_factory.mktemp("join")
    for folder in ("pred", "truth", "other"):
        (root / folder).mkdir()
    for seed, name in enumerate(NAMES):
        micro.write_object(root / "data" / name, micro.cloud(seed), views=3)
        box = trimesh.creation.box((1.0, 0.5 + 0.1 * seed, 0.4))
        box.export(root / "truth" / f"{name}.ply")
        if name != "c":
            save_ply(root / "pred" / f"{name}.ply", micro.cloud(seed + 1))
            box.apply_scale(1 + 0.1 * seed).export(root / "other" / f"{name}.ply")
    micro.write_object(root / "data" / "seen", micro.cloud(9), views=3)
    split = {"version": 2, "train": ["seen"], "test": NAMES}
    (root / "data" / "split.json").write_text(json.dumps(split))
    (root / "data" / "d" / "001.png").write_bytes(b"no picture")
    return root


def views(world, out, *more):
    words = ["--checkpoint", world / "pred", "--data", world / "data", "--device", "cpu"]
    return evaluated("eval-views", out, *words, "--no-lpips", "--sheet", 0, "--strips", 0, *more)


def shapes(world, out, *more):
    words = [world / "other", world / "truth", "--points", 300, "--baseline", world / "truth"]
    return evaluated("eval-geometry", out, *words, *more)


def timeless(report):
    """Leave out times, which differ."""
    if isinstance(report, dict):
        return {key: timeless(value) for key, value in report.items() if key != "seconds"}
    return [timeless(value) for value in report] if isinstance(report, list) else report


@pytest.fixture(scope="module", params=["views", "shapes"])
def both(request, world, tmp_path_factory):
    """A folder with the undivided report, "whole", and one of each shard, "0" and "1"."""
    folder = tmp_path_factory.mktemp(request.param)
    evaluate = {"views": views, "shapes": shapes}[request.param]
    code, _ = evaluate(world, folder / "whole")
    assert code == 1  # of the missing prediction
    for number, shard in enumerate(SHARDS):
        evaluate(world, folder / str(number), "--shard", shard)
    return folder


def parts(folder):
    return [folder / "1", folder / "0" / "report.json"]


def test_the_joined_report_is_the_undivided_one(both, tmp_path, capsys):
    assert cli.run("eval-join", [*map(str, parts(both)), "--out", str(tmp_path / "out")]) == 1
    said = capsys.readouterr()
    assert "c" in said.err and "evaluated" in said.out and "not joined" not in said.out
    whole, joined = (
        json.loads((folder / "report.json").read_text())
        for folder in (both / "whole", tmp_path / "out")
    )
    assert timeless(joined) == timeless(whole)
    assert joined["num_ok"] >= 3 and joined["num_failed"] >= 1
    for name in ("objects.csv", "table.md", "table.tex"):
        assert (tmp_path / "out" / name).exists() == (both / "whole" / name).exists()
    assert (tmp_path / "out" / "table.md").read_text() == (both / "whole" / "table.md").read_text()


def changed(folder, target, change):
    """Copy the reports of both shards; ``change`` edits that of the second one."""
    for number in range(2):
        shutil.copytree(folder / str(number), target / str(number))
    path = target / "1" / "report.json"
    report = json.loads(path.read_text())
    change(report)
    path.write_text(json.dumps(report))
    return [target / "0", target / "1"]


CHANGES = {
    "another protocol": (lambda r: r["protocol"].update(name="other"), "protocol differ in name"),
    "another version": (lambda r: r["versions"].update(torch="1.0"), "versions differ in torch"),
    "an object twice": (lambda r: r["objects"][0].update(name="a"), "both have the object a"),
    "the same shard": (lambda r: r.update(shard="0/2"), "the shard 0/2 twice"),
    "another division": (lambda r: r.update(shard="1/3"), "of two divisions"),
    "no shard": (lambda r: r.pop("shard"), "not a report of --shard"),
    "a bad shard": (lambda r: r.update(shard="2/2"), "expected i/n"),
    "interrupted": (lambda r: r.update(interrupted=True), "was interrupted"),
    "a record that is none": (lambda r: r["objects"][0].clear(), "an object without a name"),
    "a record without numbers": (
        lambda r: r.update(objects=[{"name": "x", "status": "ok"}], protocol={}, baselines={}),
        "protocol differ|not reports",
    ),
    "no objects": (lambda r: r.update(objects=3), "array"),
}


@pytest.mark.parametrize("name", CHANGES)
def test_reports_that_do_not_belong_together_are_one_line(both, tmp_path, name):
    change, reason = CHANGES[name]
    refused(reason, join_reports, changed(both, tmp_path, change))


def test_a_missing_shard_is_named(both):
    refused("missing: the reports of --shard 1/2", join_reports, [both / "0"])
    refused("not a report of --shard", join_reports, [both / "whole"])


def test_records_that_are_none_are_one_line(both, tmp_path):
    paths = changed(both, tmp_path, lambda report: report["objects"][0].update(status="ok"))
    for path in paths:
        report = json.loads((path / "report.json").read_text())
        report["objects"] = [{"name": f"x{path.name}", "status": "ok", "psnr": "high"}]
        (path / "report.json").write_text(json.dumps(report))
    refused(None, join_reports, paths)


def test_the_list_of_gso_is_joined(world, tmp_path, monkeypatch):
    monkeypatch.setattr(gso, "SIZE", 24)
    own = tmp_path / "own.txt"
    own.write_text("a\nb\nabsent\nd\n")
    options = ["--protocol", "gso", "--objects", own, "--no-baselines"]
    views(world, tmp_path / "whole", *options)
    for number, shard in enumerate(SHARDS):
        views(world, tmp_path / str(number), *options, "--shard", shard)
    joined = join_reports([tmp_path / "0", tmp_path / "1"]).report
    whole = json.loads((tmp_path / "whole" / "report.json").read_text())
    assert timeless(joined) == timeless(whole)
    assert [r["name"] for r in joined["objects"]] == ["a", "absent", "b", "d"]


def test_pictures_that_are_not_joined_are_named(both, tmp_path, capsys):
    paths = changed(both, tmp_path, lambda report: None)
    (paths[0] / "strips").mkdir()
    (paths[1] / "contact_sheet.png").write_bytes(b"")
    assert cli.run("eval-join", [*map(str, paths), "--json"]) == 1
    said = capsys.readouterr()
    assert "not joined, in the folders of the shards: contact_sheet.png, strips\n" in said.err


def test_options_that_cannot_be_divided(world, tmp_path, capsys):
    for options in (["--shard", "2/2"], ["--shard", "x"], ["--shard", "7/9"]):
        assert views(world, tmp_path / "v", *options)[0] == 2
        assert shapes(world, tmp_path / "s", *options)[0] == 2
    capsys.readouterr()
    for evaluate, option in ((views, ["--ceiling", "1"]), (shapes, ["--sensitivity"])):
        assert evaluate(world, tmp_path / "o", "--shard", "0/2", *option)[0] == 2
        said = capsys.readouterr().err
        assert said.count("\n") == 1 and {"--shard", option[0]} <= {*said.replace(":", "").split()}
