"""``gamba data objaverse``: copies of G-Objaverse and its lists."""

import gzip
import json

import pytest
from helpers.published.gobjaverse import VIEWS, members, write_object, write_tar
from helpers.refusals import refused, refused_command

from gamba_warp.cli import run
from gamba_warp.data.dataset import open_dataset
from gamba_warp.files import PART
from gamba_warp.train.sources.objaverse_lists import Lists, read_index, read_list, read_quality

# Names of four objects, in G-Objaverse and of Objaverse.
UIDS = {f"0/1001{i}": f"{i}4c6e2b3a1f84f0c9f6d3b2a1c0d9e8f" for i in range(4)}


def write_lists(folder):
    """Write the published lists, of four objects, in their published forms."""
    index = {name: f"000-14{i}/{uid}.glb" for i, (name, uid) in enumerate(UIDS.items())}
    uids = list(UIDS.values())
    lvis = {"Band_Aid": [uids[0]], "Bible": [uids[1], uids[3]], "airplane": ["f" * 32]}
    labels = ["Daily-Used", "Poor-quality", "Furnitures"]
    quality = [{"object_index": f"{u}.glb", "label": n} for u, n in zip(uids, labels)]
    made = {
        "gobjaverse_280k_index_to_objaverse.json": index,
        "gobjaverse_280k.json": list(UIDS),
        "gobjaverse_280k_Poor-quality.json": ["0/10011"],
        "category_annotation.json": quality,
    }
    for name, value in made.items():
        (folder / name).write_text(json.dumps(value))
    packed = gzip.compress(json.dumps(lvis).encode())
    (folder / "lvis-annotations.json.gz").write_bytes(packed)
    (folder / "kiuisobj_v1_merged_80K.csv").write_text(f"000-140,{uids[0]}\n000-142,{uids[2]}\n")
    return folder


@pytest.fixture(scope="module")
def published(tmp_path_factory):
    """Copy with objects as a folder, a tar, a script's folder, and with too few views."""
    root = tmp_path_factory.mktemp("gobjaverse")
    write_object(root / "set" / "0" / "10010", "readme")
    write_object(root / "set" / "0" / "10011", "tar")
    write_object(root / "set" / "0" / "10012", "script")
    write_object(root / "set" / "0" / "10013", "readme", views=3)
    (root / "set" / "notes").mkdir()
    return write_lists(root)


def data(*words):
    return run("data objaverse", [str(word) for word in words])


@pytest.mark.parametrize("copy", [False, True])
def test_a_local_copy_in_all_its_forms(published, tmp_path, capsys, copy):
    out = tmp_path / "out"
    words = [out, "--source", published / "set", *(["--copy"] if copy else [])]
    assert data(*words) == 1
    said = capsys.readouterr()
    assert "left out: 0/10013" in said.err and "3 complete views, --min-views is 40" in said.err
    assert "3 objects put into" in said.out
    found = open_dataset(out)
    assert found.uids == ["0/10010", "0/10011", "0/10012"] and not found.check()
    assert {found.num_views(uid) for uid in found.uids} == {VIEWS}
    first = found.load("0/10010", [5])
    for uid in found.uids[1:]:
        other = found.load(uid, [5])
        assert other.images.equal(first.images)
        assert other.cameras.viewmats.equal(first.cameras.viewmats)
    linked = (out / "0" / "10010" / "campos_512_v4").is_symlink()
    assert linked is not copy
    # Only the files of a tar that are read are unpacked.
    names = {path.name for path in (out / "0" / "10011" / "campos_512_v4" / "00003").iterdir()}
    assert names == {"00003.png", "00003.json"}
    assert not [path for path in out.rglob(f"{PART}*")]
    assert data(*words, "--min-views", 3) == 0
    assert "1 object put into" in capsys.readouterr().out
    assert open_dataset(out).num_views("0/10013") == 3


def test_the_papers_training_set(published, tmp_path, capsys):
    """Objects of LVIS rendered by G-Objaverse, without those of poor quality (paper §4.1)."""
    words = [tmp_path, "--source", published / "set", "--min-views", 3]
    words += ["--index", published / "gobjaverse_280k_index_to_objaverse.json"]
    words += ["--uids", published / "lvis-annotations.json.gz"]
    words += ["--quality", published / "category_annotation.json"]
    assert data(*words) == 0
    assert open_dataset(tmp_path).uids == ["0/10010", "0/10013"]
    record = json.loads((tmp_path / "objaverse.json").read_text())
    assert record["counts"] == {
        "in the source": 4,
        "of them also in lvis-annotations.json.gz": 3,
        "with a category in category_annotation.json": 2,
        "left without Poor-quality": 2,
    }
    assert record["objaverse"] == {name: UIDS[name] for name in ("0/10010", "0/10013")}
    assert "3 of them also in lvis-annotations.json.gz" in capsys.readouterr().out


def test_shards_and_a_run_that_goes_on(published, tmp_path, capsys):
    words = [tmp_path / "out", "--source", published / "set", "--min-views", 3]
    assert data(*words, "--shard", "1/2") == 0
    assert open_dataset(tmp_path / "out").uids == ["0/10011", "0/10013"]
    assert (tmp_path / "out" / "objaverse.1-2.json").exists()
    assert data(*words, "--limit", 2) == 0
    put, empty, following = capsys.readouterr().out.splitlines()[-3:]
    assert "1 object put into" in put and "val and test splits are empty" in empty
    assert following.startswith("next: ")
    assert open_dataset(tmp_path / "out").uids == ["0/10010", "0/10011", "0/10013"]
    # A broken link is made again; foreign files stay.
    link = tmp_path / "out" / "0" / "10010" / "campos_512_v4"
    link.unlink()
    link.symlink_to(tmp_path / "nowhere")
    own = tmp_path / "out" / "0" / "10012" / "own.txt"
    own.parent.mkdir()
    own.write_text("kept")
    assert data(*words) == 1
    assert "left out: 0/10012: cannot write" in capsys.readouterr().err
    assert open_dataset(tmp_path / "out").num_views("0/10010") == VIEWS
    assert own.read_text() == "kept"


def test_lists_in_their_published_forms(published):
    uids = list(UIDS.values())
    assert read_list(published / "gobjaverse_280k.json") == set(UIDS)
    assert read_list(published / "lvis-annotations.json.gz") == {*uids[:2], uids[3], "f" * 32}
    assert read_list(published / "kiuisobj_v1_merged_80K.csv") == {uids[0], uids[2]}
    index = published / "gobjaverse_280k_index_to_objaverse.json"
    assert read_index(index) == UIDS
    assert read_quality(published / "category_annotation.json")[uids[1]] == "Poor-quality"
    poor = (published / "gobjaverse_280k_Poor-quality.json",)
    csv = (published / "kiuisobj_v1_merged_80K.csv",)
    assert Lists(without=poor).choose(UIDS).names == ["0/10010", "0/10012", "0/10013"]
    assert Lists(index, uids=csv).choose(UIDS).names == ["0/10010", "0/10012"]


@pytest.mark.parametrize(
    "words, reason",
    [
        (["--uids", "{}/lvis-annotations.json.gz"], "has names of Objaverse; give --index"),
        (["--quality", "{}/category_annotation.json"], "has names of Objaverse; give --index"),
        (["--uids", "{}/nothing.json"], "nothing.json: No such file"),
        (["--uids", "{}/category_annotation.json"], "category_annotation.json: Expected"),
        (["--index", "{}/category_annotation.json"], "category_annotation.json: Expected"),
        (["--index", "{}/bad.json"], "'a/b' is not of the form 0/10010"),
        (["--uids", "{}/names.txt"], "is not the name of an object"),
        (["--uids", "{}/cut.json.gz"], "cut short"),
        (["--uids", "{}/empty.json"], "names no objects"),
        (["--without", "{}/gobjaverse_280k.json"], "no object is left (4 in the source, 0 left"),
        (["--shard", "2/2"], "--shard 2/2"),
    ],
)
def test_bad_lists_are_one_line(published, tmp_path, capsys, words, reason):
    (published / "bad.json").write_text('{"a/b": "x.glb"}')
    (published / "empty.json").write_text("{}")
    (published / "names.txt").write_text("../../etc/pass wd\n")
    (published / "cut.json.gz").write_bytes(gzip.compress(b"[" + b" " * 10**6 + b"]")[:-20])
    given = [word.format(published) for word in words]
    words = [tmp_path / "out", "--source", published / "set", *given]
    refused_command(capsys, "data objaverse", words, reason)
    assert not list(tmp_path.rglob("campos_512_v4"))


def test_a_list_that_unpacks_to_too_much(tmp_path):
    path = tmp_path / "bomb.json.gz"
    path.write_bytes(gzip.compress(b" " * (65 << 20)))
    refused("bomb.json.gz: is cut short, or unpacks to over 64 MB", read_list, path)


def test_damaged_objects_leave_nothing(tmp_path, capsys):
    source = tmp_path / "set" / "0"
    twice = {**members("7", 3), "copy/campos_512_v4/00000/00000.png": b"x"}
    write_tar(source / "7.tar", twice)
    write_tar(source / "8.tar", {"8/campos_512_v4/../../../00000/00000.png": b"x"})
    (source / "9.tar").write_bytes(b"no tar")
    write_object(source / "6", "readme", views=2)
    (source / "6" / "campos_512_v4" / "00001" / "00001.json").write_text('{"x": [1, 0, 0]}')
    words = [tmp_path / "out", "--source", tmp_path / "set", "--min-views", 1]
    assert data(*words) == 1
    told = capsys.readouterr().err.splitlines()
    reasons = {line.split(": ")[1]: line for line in told if line.startswith("left out: ")}
    assert sorted(reasons) == ["0/6", "0/7", "0/8", "0/9"]
    assert "occurs twice" in reasons["0/7"] and "leaves its folder" in reasons["0/8"]
    assert "00001.json: Object missing required field `y`" in reasons["0/6"]
    assert PART not in reasons["0/6"]
    assert not list((tmp_path / "out").rglob("campos_512_v4"))
    assert data(tmp_path / "set", "--source", tmp_path / "set") == 2
    assert data(tmp_path / "out", "--source", tmp_path / "nowhere") == 2
    assert data(tmp_path / "out", "--source", tmp_path / "out") == 2
