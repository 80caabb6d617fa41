"""Protocol ``gso`` of both evaluations: options, list and missing objects."""

import json

import pytest
import trimesh
from helpers import micro
from helpers.refusals import refused, refused_command
from helpers.views import eval_views, evaluated

from gamba_warp.data import gso
from gamba_warp.formats.ply import save_ply

THERE = gso.NAMES[:2]
PLAIN = ("--protocol", "gso", "--no-baselines", "--sheet", 0, "--strips", 0)
COARSE = ("--points", 256, "--views", 8, "--pixels", 32, "--voxels", 24)


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    root = tmp_path_factory.mktemp("gso")
    for seed, name in enumerate((*THERE, "not of the list")):
        micro.write_object(root / "views" / name, micro.cloud(seed))
        (root / "pred").mkdir(exist_ok=True)
        save_ply(root / "pred" / f"{name}.ply", micro.cloud(seed))
    for name in THERE:
        (root / "meshes" / name).mkdir(parents=True)
        trimesh.creation.box().export(root / "meshes" / name / "model.obj")
    micro.write_split(root / "views", test=[*THERE, "not of the list"])
    entries = [{"model": f"{name}/model.obj", "uid": name} for name in THERE]
    (root / "meshes" / "catalogue.json").write_text(json.dumps({"objects": entries}))
    return root


def test_views(data, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(gso, "SIZE", 24)  # 512 pixels take a minute
    code, report = eval_views(data / "pred", data / "views", tmp_path, *PLAIN)
    protocol = report["protocol"]
    assert code == 1  # 58 are missing
    assert (protocol["size"], protocol["reference"], protocol["views"]) == (24, 0, None)
    assert protocol["uids"] == list(THERE) and protocol["split"] == "test"
    said = protocol["evaluation"]
    assert (said["name"], said["evaluated"], len(said["missing"])) == ("gso", 2, 58)
    assert said["others"] == ["not of the list"] and "elevation 0" in said["input"]
    assert {f["name"] for f in report["failures"]} == set(gso.NAMES) - set(THERE)
    printed = capsys.readouterr()
    assert f"failed: {gso.NAMES[2]}: an object of --protocol gso" in printed.err
    assert printed.err.count("failed: ") == report["num_failed"] == 58
    assert "\n2 evaluated, 58 failed;" in printed.out
    assert [r["status"] for r in report["objects"]].count("failed") == 58


def test_another_list_of_objects(data, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(gso, "SIZE", 24)
    own = tmp_path / "own.txt"
    own.write_text(f"not of the list\n\n{THERE[1]}\nabsent\n")
    places = data / "pred", data / "views", tmp_path / "out"
    code, report = eval_views(*places, *PLAIN, "--objects", own)
    said = report["protocol"]["evaluation"]
    assert code == 1 and said["missing"] == ["absent"] and said["objects"] == 3
    assert report["protocol"]["uids"] == [THERE[1], "not of the list"]
    assert said["list"] == "given by --objects" and said["others"] == [THERE[0]]
    words = [data / "pred", data / "meshes", "--protocol", "gso", "--data", data / "views"]
    own.write_text(f"{THERE[0]}\n")
    _, found = evaluated("eval-geometry", tmp_path / "shapes", *words, *COARSE, "--objects", own)
    assert (found["evaluation"]["objects"], found["evaluation"]["evaluated"]) == (1, 1)
    capsys.readouterr()
    refusals = {b"": "contains no names", b"a\na\n": "a occurs twice", b"\xff": "not UTF-8"}
    refusals |= {b"../x\n": "leaves its folder", b"a/b\n": "not a plain file name"}
    for text, reason in refusals.items():
        own.write_bytes(text)
        refused(reason, gso.names_of, own)
    own_objects = "--limit: --protocol gso has its own objects"
    refused_command(capsys, "eval-geometry", [*words, "--limit", 1], own_objects)
    words = ["--checkpoint", str(data / "pred"), "--data", str(data / "views")]
    said = "--objects: needs --protocol gso"
    refused_command(capsys, "eval-views", [*words, "--objects", own], said)


def test_its_options_are_its_own(data, capsys):
    words = ["--checkpoint", str(data / "pred"), "--data", str(data / "views"), "--protocol", "gso"]
    for option, value in (("--size", "64"), ("--reference", "1"), ("--split", "all")):
        said = f"--protocol gso: has its own {option}"
        refused_command(capsys, "eval-views", [*words, option, value], said)
    other = ["--checkpoint", str(data / "pred"), "--data", str(data / "views" / "not of the list")]
    refused_command(capsys, "eval-views", [*other, "--protocol", "gso"])


def test_geometry(data, tmp_path):
    words = [data / "pred", data / "meshes", "--protocol", "gso", "--data", data / "views"]
    code, report = evaluated("eval-geometry", tmp_path, *words, *COARSE)
    protocol = report["protocol"]
    assert code == 1
    assert (protocol["name"], protocol["frame"], protocol["up"]) == ("gso", "reference", "z")
    # Two were compared; of the list 58 are named as missing, and what is not of it has no ground
    # truth.
    assert report["num_ok"] == 2 and report["evaluation"]["evaluated"] == 2
    missing = {f["name"]: f["reason"] for f in report["failures"]}
    assert missing.pop("not of the list") == "no ground truth"
    assert set(missing) == set(gso.NAMES) - set(THERE)
    assert set(missing.values()) == {"no prediction"}
