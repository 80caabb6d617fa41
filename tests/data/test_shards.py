"""Shards of views: they equal the files; damage of one object does not affect others."""

import io
import json
import os
import tarfile
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import micro
from helpers.disk import full_at
from helpers.images import bytes_of
from helpers.refusals import refused
from helpers.views import to_opengl
from hostile import seeds
from PIL import Image

from gamba_warp import cli
from gamba_warp.cameras import orbit
from gamba_warp.data.dataset import open_dataset
from gamba_warp.errors import FileWarning

pytest.importorskip("webdataset")

from gamba_warp.train.data.shards import INDEX, Shards, dataset_of, shards_at  # noqa: E402
from gamba_warp.train.sources.pack import write_pack  # noqa: E402

UIDS = ["a", "b/c.v2", "d 1%"]
WIDTH, HEIGHT, VIEWS = 14, 10, 3


def write_object(folder, seed, depth=None):
    """Write views of noise, with different fields of view and poses."""
    rng = np.random.default_rng(seed)
    folder.mkdir(parents=True)
    frames = []
    for v in range(VIEWS):
        image = Image.fromarray(rng.integers(0, 256, (HEIGHT, WIDTH, 4), np.uint8))
        image.save(folder / f"{v}.png")
        viewmat = orbit(torch.tensor([37.0 * v + seed]), 10.0 + v, 1.7)[0].double()
        frame = {"file_path": f"{v}.png", "transform_matrix": to_opengl(viewmat).tolist()}
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
    micro.write_split(root, train=UIDS[:2], test=UIDS[2:])
    return root


def packed(data, out, *options):
    counts, failures = write_pack(data, out, *options)
    assert not failures
    return counts


def opened(out):
    """Read all objects of a folder of shards: the uids and ``load`` of a dataset."""
    found = {}
    for split in (path.stem.removeprefix("shards-") for path in out.glob("shards-*.json")):
        made = Shards(str(out), split).first(99)
        found |= {uid: made for uid in made.uids}
    return sorted(found), lambda uid, *options: found[uid].load(uid, *options)


def assert_same(got, want):
    assert (got.uid, got.name, got.attribution) == (want.uid, want.name, want.attribution)
    for name in ("images", "depths", "backs"):
        a, b = getattr(got, name), getattr(want, name)
        assert (a is None) == (b is None), name
        assert a is None or (a.dtype == b.dtype and torch.equal(a, b)), name
    assert torch.equal(got.cameras.viewmats, want.cameras.viewmats)
    assert torch.equal(got.cameras.Ks, want.cameras.Ks)
    assert (got.cameras.width, got.cameras.height) == (want.cameras.width, want.cameras.height)


@pytest.mark.parametrize("size", [6, 10, None])
def test_shards_give_the_bits_of_the_files(data, tmp_path, size):
    counts = packed(data, tmp_path / "pack", size, 1000, 2)
    assert counts == {"train-00000.tar": 2, "test-00000.tar": 1}
    files, (uids, load) = open_dataset(data), opened(tmp_path / "pack")
    assert uids == files.uids
    for uid in uids:
        for views in (None, [2, 0], [1, 1]):
            assert_same(load(uid, views, size), files.load(uid, views, size))
        assert_same(load(uid, [1, 2], size, 1), files.load(uid, [1, 2], size, 1))
        if size is None:  # other sizes are made from the same images
            assert_same(load(uid, [1, 2], 7), files.load(uid, [1, 2], 7))
    assert shards_at(tmp_path / "pack") == str(tmp_path / "pack") and not shards_at(data)
    refused("shards, which only gamba train reads", open_dataset, tmp_path / "pack")


def test_shards_keep_the_bytes_of_the_images(data, tmp_path, monkeypatch):
    packed(data, tmp_path / "pack")
    content = {path.name: path.read_bytes() for path in (tmp_path / "pack").iterdir()}
    monkeypatch.setattr(time, "time", lambda: 2e9)
    packed(data, tmp_path / "pack")
    assert content == {path.name: path.read_bytes() for path in (tmp_path / "pack").iterdir()}
    with tarfile.open(tmp_path / "pack" / "train-00000.tar") as tar:
        found = {member.name: tar.extractfile(member).read() for member in tar}
    assert found["a.001.png"] == (data / "a/1.png").read_bytes()
    assert found["a.001.depth.png"] == (data / "a/depth1.png").read_bytes()
    assert found["b/c%2Ev2.002.png"] == (data / "b/c.v2/2.png").read_bytes()


def test_a_tar_ends_with_the_object_that_exceeds_its_size(data, tmp_path):
    packed(data, tmp_path / "pack", None, 1e-3)
    names = ["test-00000.tar", "train-00000.tar", "train-00001.tar"]
    assert sorted(p.name for p in (tmp_path / "pack").glob("*.tar")) == names
    made = Shards(str(tmp_path / "pack"), "train")
    assert made.count == 2 and [Path(url).name for url in made.urls] == names[1:]


@pytest.mark.parametrize("layout", ["gobjaverse", "openlrm", "nerf", "blender", "masks"])
@pytest.mark.parametrize("size", [None, 6])
def test_every_layout_can_be_packed(tmp_path, layout, size):
    for name, content in seeds.datasets()[layout].items():
        path = tmp_path / "data" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
    packed(tmp_path / "data", tmp_path / "pack", size)
    files, (uids, load) = open_dataset(tmp_path / "data"), opened(tmp_path / "pack")
    assert uids == files.uids
    for uid in uids:
        assert_same(load(uid, None, size), files.load(uid, size=size))


@pytest.mark.parametrize("room", [0, 3000, 9000])
def test_a_full_disk_is_one_line_and_leaves_nothing(data, tmp_path, room):
    with full_at(room):
        refused("cannot write", write_pack, data, tmp_path / "pack", 10)
    assert not [path for path in tmp_path.iterdir() if path != data]


def test_views_without_alpha_are_packed_and_told(data, tmp_path, capsys):
    for path in data.rglob("[0-9].png"):
        Image.open(path).convert("RGB").save(path)
    assert cli.run("data pack", [str(data), str(tmp_path / "pack"), "--size", "6"]) == 0
    said = capsys.readouterr().err
    assert f"warning: {data}: no image has an alpha channel or a mask" in said


def test_objects_that_cannot_be_read_are_left_out_and_told(data, tmp_path, capsys):
    (data / "b/c.v2/1.png").write_bytes(b"no image")
    out = tmp_path / "pack"
    assert cli.run("data pack", [str(data), str(out)]) == 1
    said = capsys.readouterr()
    assert "packed 2 objects into 2 shards" in said.out and "failed: b/c.v2: " in said.err
    assert opened(out)[0] == ["a", "d 1%"]
    refused("no object can be packed", write_pack, data / "b", tmp_path / "other")


def test_other_folders_are_refused(data, tmp_path):
    refused("holds other files; give another folder", packed, data, data)
    packed(data, tmp_path / "pack", None, 1e-3)
    packed(data, tmp_path / "pack")
    assert len([*(tmp_path / "pack").glob("train-*.tar")]) == 1, "older shards are replaced"


def rewritten(out, change):
    """Write the first tar anew: ``change`` maps its members, [(TarInfo, content)], to others."""
    path = out / "train-00000.tar"
    with tarfile.open(path) as tar:
        members = [(member, tar.extractfile(member).read()) for member in tar]
    with tarfile.open(path, "w", format=tarfile.GNU_FORMAT) as tar:
        for member, content in change(members):
            member.size = len(content)
            tar.addfile(member, io.BytesIO(content))


def changed(suffix, content):
    """Change members of the object ``a`` whose names have this suffix."""

    def change(members):
        for member, known in members:
            own = member.name == f"a.{suffix}"
            yield member, (content(known) if callable(content) else content) if own else known

    return change


def in_frame(**values):
    """Change the first frame of the object's document."""

    def change(content):
        document = json.loads(content)
        document["frames"][0] |= values
        return json.dumps(document).encode()

    return changed("json", change)


@pytest.mark.parametrize(
    "change, reason",
    [
        (changed("json", b"{"), "not valid JSON"),
        (in_frame(file_path="../a/0.png"), "has no"),
        (in_frame(file_path=3), "no file_path"),
        (in_frame(file_path="json"), "has no 'json'"),
        (in_frame(transform_matrix=[[7] * 4] * 4), "not a rotation"),
        (changed("000.png", bytes_of(Image.new("1", (20000, 20000)))), "megapixels"),
        (changed("000.png", b"no image"), "a.000.png: "),
        (lambda all: [m for m in all if m[0].name != "a.json"], "not valid JSON"),
    ],
)
def test_damage_of_an_object_is_its_own(data, tmp_path, change, reason):
    out = tmp_path / "pack"
    packed(data, out)
    rewritten(out, change)
    from webdataset import WebDataset

    tar = WebDataset(str(out / "train-00000.tar"), shardshuffle=False)
    samples = {sample["__key__"]: sample for sample in tar}
    assert_same(dataset_of(samples["b/c%2Ev2"]).load("b/c.v2"), open_dataset(data).load("b/c.v2"))
    message = refused(reason, dataset_of(samples["a"]).load, "a")
    assert message.startswith(f"{out / 'train-00000.tar'}: a")


def test_files_that_no_document_names_are_told_once_a_tar(data, tmp_path):
    out = tmp_path / "pack"
    packed(data, out)

    def more(members):
        for member, content in members:
            yield member, content
            if member.name.endswith(".json"):
                yield tarfile.TarInfo(member.name.replace(".json", ".txt")), b"x"

    rewritten(out, more)
    with pytest.warns(FileWarning, match=r"train-00000.tar: files that no .json") as told:
        uids, load = opened(out)
        for uid in uids:
            load(uid)
    assert len({str(line.message) for line in told if line.category is FileWarning}) == 1


@pytest.mark.parametrize("damage", ["short", "noise"])
def test_a_tar_that_cannot_be_read_is_one_line(data, tmp_path, damage):
    out = tmp_path / "pack"
    packed(data, out)
    path = out / "train-00000.tar"
    content = path.read_bytes()
    path.write_bytes(content[:-12_000] if damage == "short" else b"noise" * 3000)
    refused(f"the shards cannot be read: {path}: ", Shards(str(out), "train").first, 9)
    path.unlink()
    refused(f"{path}: no such file", Shards, str(out), "train")
    os.mkfifo(path)
    refused(f"{path}: no such file", Shards, str(out), "train")


@pytest.mark.parametrize(
    "change",
    [
        {"shardlist": []},
        {"shardlist": [{"url": "../train-00000.tar", "nsamples": 1}]},
        {"shardlist": [{"url": "/etc/passwd", "nsamples": 1}]},
        {"shardlist": [{"url": "pipe:touch x", "nsamples": 1}]},
        {"shardlist": [{"url": "http://host/a.tar", "nsamples": 1}]},
        {"shardlist": [{"url": "a.tar", "nsamples": 0}]},
        {"shardlist": [{"url": "a.tar", "nsamples": 1e30}]},
    ],
)
def test_an_index_names_plain_tars_beside_it(data, tmp_path, change):
    out = tmp_path / "pack"
    packed(data, out)
    path = out / INDEX.format("train")
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    assert str(path) in refused("shardlist", Shards, str(out), "train")


@pytest.mark.parametrize("source", ["file://host/a", "gs://host/a", "s3://host/a", "http://h/a b"])
def test_other_addresses_are_no_shards(source, tmp_path, monkeypatch):
    refused(f"{source}: only http:// and https:// addresses", shards_at, Path(source))
    monkeypatch.chdir(tmp_path)  # nor is the name of a folder an address
    Path(source).mkdir(parents=True)
    (Path(source) / INDEX.format("train")).write_text("{}")
    assert shards_at(Path(source)) == str(tmp_path / Path(source))


def test_an_address_keeps_its_slashes():
    assert shards_at(Path("https://host:8000/some/shards")) == "https://host:8000/some/shards"
