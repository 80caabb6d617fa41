"""Packs of views: bit-identical, atomic; damage of one object does not affect others."""

import json
import os
import pickle
import struct
import zlib

import numpy as np
import pytest
import torch
from helpers import micro
from helpers.disk import full_at
from helpers.refusals import refused
from PIL import Image

from gamba_warp import cli
from gamba_warp.cameras import orbit
from gamba_warp.data import packs
from gamba_warp.data.dataset import open_dataset, splits_of
from gamba_warp.errors import UserError
from gamba_warp.files import PART
from gamba_warp.train.sources import pack as writer
from gamba_warp.train.sources.pack import PackSettings, write_pack

UIDS = ["a", "b/c", "d"]
WIDTH, HEIGHT, VIEWS = 14, 10, 3


def write_object(folder, seed, depth=None):
    """Write views of noise, with different fields of view and poses."""
    rng = np.random.default_rng(seed)
    folder.mkdir(parents=True)
    frames = []
    for v in range(VIEWS):
        Image.fromarray(rng.integers(0, 256, (HEIGHT, WIDTH, 4), np.uint8)).save(
            folder / f"{v}.png"
        )
        viewmat = orbit(torch.tensor([37.0 * v + seed]), 10.0 + v, 1.7)[0].double()
        frame = {"file_path": f"{v}.png", "transform_matrix": micro.to_opengl(viewmat).tolist()}
        frame |= {"w": WIDTH, "h": HEIGHT, "fl_x": 11.3 + v, "cx": 6.7, "cy": 5.1}
        for key in ("depth", "back") if depth else ():
            steps = rng.integers(0, 9000, (HEIGHT, WIDTH))
            name = f"{key}{v}.{'png' if depth == 'uint16' else 'tiff'}"
            made = steps.astype(np.uint16) if depth == "uint16" else (steps / 7).astype(np.float32)
            Image.fromarray(made).save(folder / name)
            frame[f"{key}_file_path"] = name
        frames.append(frame)
    values = {"name": f"Thing {seed}", "attribution": {"creator": "me"}, "depth_unit": 1e-4 / 3}
    (folder / "transforms.json").write_text(json.dumps({**values, "frames": frames}))


@pytest.fixture
def data(tmp_path):
    root = tmp_path / "data"
    for seed, (uid, depth) in enumerate(zip(UIDS, ("uint16", None, "float32"))):
        write_object(root / uid, seed, depth)
    split = {"version": 1, "train": UIDS[:2], "val": [], "test": UIDS[2:]}
    (root / "split.json").write_text(json.dumps(split))
    return root


def packed(data, out, **settings):
    done = write_pack(data, out, PackSettings(**{"size": 6, **settings}), 2)
    assert not done.failures
    return done


def assert_same(got, want):
    assert (got.uid, got.name, got.attribution) == (want.uid, want.name, want.attribution)
    for name in ("images", "depths", "backs"):
        a, b = getattr(got, name), getattr(want, name)
        assert (a is None) == (b is None), name
        assert a is None or (a.dtype == b.dtype and torch.equal(a, b)), name
    assert torch.equal(got.cameras.viewmats, want.cameras.viewmats)
    assert torch.equal(got.cameras.Ks, want.cameras.Ks)
    assert (got.cameras.width, got.cameras.height) == (want.cameras.width, want.cameras.height)


def test_a_pack_says_how_its_meshes_were_placed(data, tmp_path):
    path = data / "a" / "transforms.json"
    placed = {
        "applied_transform": [[0, 0, 2, 1], [1, 0, 0, 0.1], [0, 1, 0, -3]],
        "applied_scale": 4,
    }
    path.write_text(json.dumps(json.loads(path.read_text()) | placed))
    packed(data, tmp_path / "pack")
    pack = open_dataset(tmp_path / "pack")
    got = pack.files("a").placement
    assert got.transform[:3].tolist() == placed["applied_transform"] and got.scale == 4
    assert pack.files("d").placement is None
    assert splits_of(tmp_path / "pack", UIDS) == splits_of(data, UIDS)


SHARDS = pytest.mark.parametrize("shards", ["arrays", "webdataset"])


@SHARDS
@pytest.mark.parametrize("size", [6, 10, None])
def test_a_pack_gives_the_bits_of_the_files(data, tmp_path, size, shards):
    packed(data, tmp_path / "pack", size=size, shards=shards)
    files, pack = open_dataset(data), open_dataset(tmp_path / "pack")
    assert (pack.uids, pack.layout, pack.packed_size) == (files.uids, "pack", size)
    assert not pack.check()
    for uid in files.uids:
        for views in (None, [2, 0], [1, 1]):
            assert_same(pack.load(uid, views, size), files.load(uid, views, size))
        assert_same(pack.load(uid, [1, 2], size, 1), files.load(uid, [1, 2], size, 1))
        if size is None:  # other sizes are made from the pack's pictures
            assert_same(pack.load(uid, [1, 2], 7), files.load(uid, [1, 2], 7))
    for name in ("train", "test"):
        assert open_dataset(tmp_path / "pack", name).uids == open_dataset(data, name).uids
    refused("split val", open_dataset, tmp_path / "pack", "val")


def test_a_pack_is_joined_cached_and_sent_to_processes(data, tmp_path):
    packed(data, tmp_path / "pack")
    files = open_dataset(data)
    both = open_dataset(tmp_path / "pack", cache=True).joined("more", files)
    both.load("a", size=6)
    assert both.uids == [*UIDS, *(f"more/{uid}" for uid in UIDS)]
    sent = pickle.loads(pickle.dumps(both))
    for uid in UIDS:
        want = files.load(uid, size=6)
        assert_same(both.load(uid, size=6), want)
        assert torch.equal(sent.load(f"more/{uid}", size=6).images, want.images)
        assert torch.equal(sent.load(uid, size=6).images, want.images)


def test_training_on_a_pack_is_training_on_the_files(tmp_path):
    data = micro.write_dataset(tmp_path / "clouds")
    packed(data, tmp_path / "pack", size=micro.SIZE)
    for root in (data, tmp_path / "pack"):
        assert micro.run(root, tmp_path / f"run-{root.name}", length={"steps": 3}) == 0
    assert micro.same_weights(
        *(tmp_path / f"run-{n}/model.safetensors" for n in ("clouds", "pack"))
    )


def test_the_command_goes_on_where_it_was_stopped(data, tmp_path, monkeypatch, capsys):
    out = tmp_path / "pack"
    real, calls = writer._block, []

    def block(dataset, uid, *rest):
        if uid == "d" and not calls:
            calls.append(1)
            raise KeyboardInterrupt
        return real(dataset, uid, *rest)

    monkeypatch.setattr(writer, "_block", block)
    words = [str(data), str(out), "--size", "6", "--shard-mb", "1", "--workers", "1"]
    monkeypatch.setattr(writer, "_take_bytes", lambda blocks, limit: iter([next(blocks)]))
    assert cli.run("data pack", words) == 130
    refused("unfinished pack", open_dataset, out)
    first = (out / "shard-00000.bin").stat().st_mtime_ns
    (out / "shard-00007.bin").write_bytes(b"of a killed run")
    assert cli.run("data pack", words) == 0
    assert "2 objects already in" in capsys.readouterr().out
    assert sorted(p.name for p in out.glob("shard*")) == [f"shard-0000{n}.bin" for n in range(3)]
    assert (out / "shard-00000.bin").stat().st_mtime_ns == first
    for uid in UIDS:
        assert_same(open_dataset(out).load(uid, size=6), open_dataset(data).load(uid, size=6))
    assert cli.run("data pack", [*words[:3], "7"]) == 2
    error = capsys.readouterr().err
    assert error.splitlines()[-1] == f"gamba: {out}: holds a pack of --size 6, not 7"


def test_objects_that_are_new_or_lost_are_packed_again(data, tmp_path):
    out = tmp_path / "pack"
    packed(data, out)
    write_object(data / "new", 9)
    assert (packed(data, out).written, packed(data, out).written) == (1, 0)
    (out / "shard-00000.bin").unlink()
    assert packed(data, out).written == 3
    assert_same(open_dataset(out).load("a", size=6), open_dataset(data).load("a", size=6))


@SHARDS
@pytest.mark.parametrize("room", [0, 3000, 9000])
def test_a_full_disk_is_one_line_and_leaves_nothing_half_written(data, tmp_path, room, shards):
    out = tmp_path / "pack"
    with full_at(room), pytest.raises(UserError) as caught:
        write_pack(data, out, PackSettings(size=10, shards=shards), 1)
    assert "cannot write" in str(caught.value) and "\n" not in str(caught.value)
    left = [p for p in out.rglob("*") if p.name != ".lock"]
    assert not left, "the disk was full in the first shard, so nothing of it is there"
    assert not [p for p in tmp_path.rglob("*") if p.name.startswith(PART)]
    packed(data, out, size=10, shards=shards)
    assert len(open_dataset(out)) == 3


def test_a_full_disk_under_the_index_leaves_the_pack_as_it_was(data, tmp_path, monkeypatch):
    out = tmp_path / "pack"
    packed(data, out)
    before = {p.name: p.read_bytes() for p in out.iterdir()}
    write_object(data / "new", 9)

    def full(*arguments):
        raise UserError("cannot write it: No space left on device")

    monkeypatch.setattr(writer, "write_text", full)
    refused("No space left", packed, data, out)
    assert {p.name: p.read_bytes() for p in out.iterdir()} == before


def test_views_without_alpha_are_packed_and_told(data, tmp_path, capsys):
    for path in data.rglob("[0-9].png"):
        Image.open(path).convert("RGB").save(path)
    assert cli.run("data pack", [str(data), str(tmp_path / "pack"), "--size", "6"]) == 0
    said = capsys.readouterr().err
    assert f"warning: {data}: no picture has an alpha channel or a mask" in said


def test_objects_that_cannot_be_read_are_left_out_and_told(data, tmp_path, capsys):
    (data / "b/c/1.png").write_bytes(b"no picture")
    out = tmp_path / "pack"
    assert cli.run("data pack", [str(data), str(out), "--size", "6"]) == 1
    said = capsys.readouterr()
    assert "packed 2 objects" in said.out and "failed: b/c: " in said.err
    assert "warning" not in said.err
    assert open_dataset(out).uids == ["a", "d"]
    with pytest.raises(UserError, match="no object can be packed"):
        write_pack(data / "b", tmp_path / "other", PackSettings(), 1)


def test_other_folders_are_refused(data, tmp_path):
    refused(r"holds other files \(a\)", packed, data, data)
    assert not (data / packs.INDEX).exists()


# Damage. ``b/c`` lies between the others in one shard; each case damages only it.


def index_of(out):
    return json.loads((out / packs.INDEX).read_text())


def edit(out, number=1, top=None, **changes):
    values = index_of(out)
    values["objects"][number] |= changes
    (out / packs.INDEX).write_text(json.dumps(values | (top or {})))


def flip(out, byte):
    with (out / "shard-00000.bin").open("r+b") as file:
        file.seek(byte)
        value = file.read(1)[0]
        file.seek(byte)
        file.write(bytes([value ^ 4]))


def cut(out):
    last = index_of(out)["objects"][2]
    os.truncate(out / "shard-00000.bin", last["backs"] + 2)


def recounted(out, column, value):
    """Write a value into the cameras of the second object, with the matching checksum."""
    entry = index_of(out)["objects"][1]
    path, start = out / "shard-00000.bin", entry["cameras"]
    content = bytearray(path.read_bytes())
    content[start + 8 * column : start + 8 * column + 8] = struct.pack("<d", value)
    path.write_bytes(content)
    edit(out, crc=zlib.crc32(content[start : start + VIEWS * packs.COLUMNS * 8]))


DAMAGE = {
    "a corrupt picture": (lambda out: flip(out, index_of(out)["objects"][1]["images"] + 70), 1),
    "corrupt cameras": (lambda out: flip(out, index_of(out)["objects"][1]["cameras"] + 9), 1),
    "a corrupt depth": (lambda out: flip(out, index_of(out)["objects"][0]["depths"] + 9), 0),
    "a shard cut short": (cut, 2),
    "an offset outside": (lambda out: edit(out, images=10**9), 1),
    "a negative offset": (lambda out: edit(out, images=-8), 1),
    "more views": (lambda out: edit(out, views=9999), 1),
    "a huge size": (lambda out: edit(out, width=16384, height=16384), 1),
    "another size": (lambda out: edit(out, width=5), 1),
    "no number": (lambda out: edit(out, height="6"), 1),
    "another shard": (lambda out: edit(out, shard="shard-00001.bin"), 1),
    "a shard elsewhere": (lambda out: edit(out, shard="../data/a/0.png"), 1),
    "a depth type": (lambda out: edit(out, 0, depth_type="uint64"), 0),
    "depths that are pictures": (lambda out: edit(out, 2, depths=0), 2),
    "a pose that is none": (lambda out: recounted(out, 0, 7.0), 1),
    "a pose of NaN": (lambda out: recounted(out, 3, float("nan")), 1),
    "a checksum that is none": (lambda out: recounted(out, 25, -1.0), 1),
    "a focal length of 0": (lambda out: recounted(out, 16, 0.0), 1),
}


@pytest.mark.parametrize("name", DAMAGE)
def test_damage_of_an_object_is_one_line_and_its_own(data, tmp_path, name):
    out = tmp_path / "pack"
    packed(data, out)
    damage, spoilt = DAMAGE[name]
    damage(out)
    pack = open_dataset(out)
    pack.check()
    for number, uid in enumerate(UIDS):
        if number != spoilt:
            assert_same(pack.load(uid, size=6), open_dataset(data).load(uid, size=6))
            continue
        message = refused(None, pack.load, uid, size=6)
        assert str(out) in message and len(message) < 400


def test_a_shard_that_is_cut_while_it_is_used_is_no_crash(data, tmp_path):
    packed(data, tmp_path / "pack")
    pack = open_dataset(tmp_path / "pack")
    pack.load("a", size=6)
    os.truncate(tmp_path / "pack" / "shard-00000.bin", 100)
    refused("cut short", pack.load, "a", size=6)


def test_a_bad_object_of_a_pack_is_skipped_in_training(tmp_path):
    data = micro.write_dataset(tmp_path / "clouds", objects=5)
    packed(data, tmp_path / "pack", size=micro.SIZE)
    edit(tmp_path / "pack", 1, images=10**12)
    assert micro.run(tmp_path / "pack", tmp_path / "run", length={"steps": 2}) == 0
    said = micro.lines(tmp_path / "run", "warning")[0]["message"]
    assert "cloudb is left out" in said and "cut short" in said


@pytest.mark.parametrize(
    ("top", "reason"),
    [
        ({"version": 2}, "pack version 2, supported is 1"),
        ({"format": "zip"}, "not the index of a pack"),
        ({"objects": []}, "has no objects"),
        ({"objects": [{"uid": "../a"}]}, "leaves its folder"),
        ({"objects": [{"uid": 3}]}, "not text"),
        ({"objects": 3}, "array"),
        ({"size": 0}, ">= 1"),
    ],
)
def test_a_bad_index_is_one_line(data, tmp_path, top, reason):
    out = tmp_path / "pack"
    packed(data, out)
    edit(out, top=top)
    refused(reason, open_dataset, out)


def test_a_name_twice_is_refused(data, tmp_path):
    out = tmp_path / "pack"
    packed(data, out)
    edit(out, uid="a")
    refused("a occurs twice", open_dataset, out)


def test_webdataset_reads_its_shards(data, tmp_path):
    webdataset = pytest.importorskip("webdataset")
    packed(data, tmp_path / "pack", shards="webdataset")
    shard = str(tmp_path / "pack" / "shard-00000.tar")
    read = webdataset.WebDataset(shard, shardshuffle=False, empty_check=False).decode()
    objects = {sample["json"]["uid"]: sample for sample in read}
    assert sorted(objects) == UIDS
    files = open_dataset(data)
    for uid, sample in objects.items():
        assert np.array_equal(sample["images.npy"], files.pictures(uid, size=6)[0])
        assert np.array_equal(
            sample["cameras.npy"][:, :16].reshape(-1, 4, 4), files.files(uid).camera_to_world
        )
