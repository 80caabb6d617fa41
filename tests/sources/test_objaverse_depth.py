"""``gamba data objaverse --depth``: depth of normal-and-depth files; 0 without a surface."""

import numpy as np
import pytest
from helpers.published.gobjaverse import SIZE, camera, members, write_object, write_tar
from helpers.refusals import refused_command

from gamba_warp.cli import run
from gamba_warp.data.dataset import open_dataset
from gamba_warp.train.sources import objaverse_views
from gamba_warp.train.sources.objaverse_views import depth_steps

VIEWS = 3


def test_what_is_no_surface_is_zero():
    distance = 1.5
    depth = np.array([[np.nan, np.inf, 0.0, 0.6], [1.5, 2.3, 2.4, -1.0]], np.float32)
    got = depth_steps(depth, distance)
    # The object's cube reaches 0.866 to both sides of its centre.
    assert got.dtype == np.uint16 and got.tolist() == [[0, 0, 0, 0], [15000, 23000, 0, 0]]
    assert depth_steps(np.array([[1.43217]], np.float32), distance).tolist() == [[14322]]


def test_without_the_package_it_is_one_line(tmp_path, monkeypatch, capsys):
    write_object(tmp_path / "set" / "0" / "1", "readme", VIEWS)
    monkeypatch.setattr(objaverse_views, "find_spec", lambda name: None)
    words = [str(tmp_path / "out"), "--source", str(tmp_path / "set"), "--depth"]
    said = "gamba: --depth: needs the package OpenEXR: pip install OpenEXR"
    refused_command(capsys, "data objaverse", words, said)
    assert not (tmp_path / "out").exists()


def write_exr(path, depth, names="RGBA"):
    import OpenEXR

    kind = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    normal = np.full_like(depth, 0.5)
    channels = {name: depth if name == "A" else normal for name in names}
    OpenEXR.File(kind, channels).write(str(path))


def test_published_files_of_a_folder_and_of_a_tar(tmp_path, capsys):
    pytest.importorskip("OpenEXR", reason="the package OpenEXR is not installed")
    files = {n.replace("5/", "6/", 1): data for n, data in members("5", VIEWS).items()}
    write_object(tmp_path / "set" / "0" / "5", "readme", VIEWS)
    for number in range(VIEWS):
        depth = np.full((SIZE, SIZE), np.nan, np.float32)
        depth[8:24, 8:24] = camera(number)["distance"] - 0.25
        path = tmp_path / f"set/0/5/campos_512_v4/{number:05d}/{number:05d}_nd.exr"
        write_exr(path, depth)
        files[f"6/campos_512_v4/{number:05d}/{number:05d}_nd.exr"] = path.read_bytes()
    write_tar(tmp_path / "set" / "0" / "6.tar", files)
    words = [str(tmp_path / "out"), "--source", str(tmp_path / "set"), "--min-views", "1"]
    assert run("data objaverse", words) == 0
    assert open_dataset(tmp_path / "out").load("0/5").depths is None
    assert run("data objaverse", [*words, "--depth"]) == 0  # added to existing objects
    assert "2 objects put into" in capsys.readouterr().out
    for uid in ("0/5", "0/6"):
        views = open_dataset(tmp_path / "out").load(uid)
        assert views.depths.shape == (VIEWS, SIZE, SIZE)
        for number in range(VIEWS):
            want = camera(number)["distance"] - 0.25
            assert views.depths[number, 12, 12].item() == pytest.approx(want, abs=1e-4)
            assert views.depths[number, 2, 2] == 0
        assert {p.name for p in (tmp_path / "out" / uid).iterdir()} == {"campos_512_v4", "depth"}


@pytest.mark.parametrize(
    "break_it, reason",
    [
        (lambda path: path.write_bytes(b"no exr"), "00001_nd.exr: cannot be read"),
        (lambda path: path.unlink(), "00001_nd.exr: no such file"),
        (lambda path: write_exr(path, np.ones((4, 4), np.float32), "RGB"), "no fourth channel"),
    ],
)
def test_bad_depth_leaves_its_object_out(tmp_path, capsys, break_it, reason):
    pytest.importorskip("OpenEXR", reason="the package OpenEXR is not installed")
    write_object(tmp_path / "set" / "0" / "5", "readme", VIEWS)
    for number in range(VIEWS):
        path = tmp_path / f"set/0/5/campos_512_v4/{number:05d}/{number:05d}_nd.exr"
        write_exr(path, np.ones((SIZE, SIZE), np.float32))
    break_it(tmp_path / "set/0/5/campos_512_v4/00001/00001_nd.exr")
    words = [str(tmp_path / "out"), "--source", str(tmp_path / "set"), "--min-views", "1"]
    assert run("data objaverse", [*words, "--depth"]) == 1
    error = capsys.readouterr().err
    assert reason in error and "left out: 0/5: " in error
    assert not list((tmp_path / "out").rglob("campos_512_v4"))
