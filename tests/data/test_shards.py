"""Shards of views: bit-identical, atomic; damage of one object does not affect others."""

import io
import json
import os
import pickle
import tarfile

import numpy as np
import pytest
import torch
from helpers import micro
from helpers.disk import full_at
from helpers.refusals import refused
from hostile import seeds
from PIL import Image

from gamba_warp import cli
from gamba_warp.cameras import orbit
from gamba_warp.data import shards
from gamba_warp.data.dataset import open_dataset, splits_of
from gamba_warp.errors import UserError
from gamba_warp.files import PART
from gamba_warp.train.sources import pack as writer
from gamba_warp.train.sources.pack import PackSettings, write_pack

UIDS = ["a", "b/c.v2", "d"]
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


@pytest.mark.parametrize("size", [6, 10, None])
def test_shards_give_the_bits_of_the_files(data, tmp_path, size):
    packed(data, tmp_path / "pack", size=size)
    files, pack = open_dataset(data), open_dataset(tmp_path / "pack")
    assert (pack.uids, pack.layout, pack.packed_size) == (files.uids, "shards", size)
    assert not pack.check()
    for uid in files.uids:
        for views in (None, [2, 0], [1, 1]):
            assert_same(pack.load(uid, views, size), files.load(uid, views, size))
        assert_same(pack.load(uid, [1, 2], size, 1), files.load(uid, [1, 2], size, 1))
        if size is None:  # other sizes are made from the same pictures
            assert_same(pack.load(uid, [1, 2], 7), files.load(uid, [1, 2], 7))
    for name in ("train", "test"):
        assert open_dataset(tmp_path / "pack", name).uids == open_dataset(data, name).uids
    refused("split val", open_dataset, tmp_path / "pack", "val")


def test_shards_keep_the_bytes_of_the_pictures(data, tmp_path):
    packed(data, tmp_path / "pack", size=None)
    with tarfile.open(tmp_path / "pack" / "train-00000.tar") as tar:
        found = {member.name: tar.extractfile(member).read() for member in tar}
    assert found["a.001.png"] == (data / "a/1.png").read_bytes()
    assert found["a.001.depth.png"] == (data / "a/depth1.png").read_bytes()
    assert found["b/c%2Ev2.002.png"] == (data / "b/c.v2/2.png").read_bytes()
    packed(tmp_path / "pack", tmp_path / "again", size=None)  # shards of shards
    for name in ("train-00000.tar", "test-00000.tar", shards.INDEX):
        again = (tmp_path / "again" / name).read_bytes()
        assert again == (tmp_path / "pack" / name).read_bytes(), name


def test_masks_stay_apart_or_become_alpha(data, tmp_path):
    path = data / "a" / "transforms.json"
    values = json.loads(path.read_text())
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[3:] = 255
    Image.fromarray(mask).save(data / "a" / "mask.png")
    for frame in values["frames"]:
        frame["mask_path"] = "mask.png"
    path.write_text(json.dumps(values))
    for size in (None, 6):
        packed(data, tmp_path / f"{size}", size=size)
        got = open_dataset(tmp_path / f"{size}").load("a", size=size)
        assert_same(got, open_dataset(data).load("a", size=size))


@pytest.mark.parametrize("layout", ["gobjaverse", "openlrm", "nerf", "blender", "masks"])
def test_every_layout_can_be_packed(tmp_path, layout):
    for name, content in seeds.datasets()[layout].items():
        path = tmp_path / "data" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
    packed(tmp_path / "data", tmp_path / "pack", size=None)
    files, pack = open_dataset(tmp_path / "data"), open_dataset(tmp_path / "pack")
    assert pack.uids == files.uids
    for uid in files.uids:
        assert_same(pack.load(uid), files.load(uid))


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
    refused("unfinished shards", open_dataset, out)
    first = (out / "train-00000.tar").stat().st_mtime_ns
    (out / "train-00007.tar").write_bytes(b"of a killed run")
    assert cli.run("data pack", words) == 0
    assert "2 objects already in" in capsys.readouterr().out
    names = ["test-00000.tar", "train-00000.tar", "train-00001.tar"]
    assert sorted(p.name for p in out.glob("*.tar")) == names
    assert (out / "train-00000.tar").stat().st_mtime_ns == first
    for uid in UIDS:
        assert_same(open_dataset(out).load(uid, size=6), open_dataset(data).load(uid, size=6))
    assert cli.run("data pack", [*words[:3], "7"]) == 2
    error = capsys.readouterr().err
    assert error.splitlines()[-1] == f"gamba: {out}: holds shards of --size 6, not 7"


def test_objects_that_are_new_or_lost_are_packed_again(data, tmp_path):
    out = tmp_path / "pack"
    packed(data, out)
    write_object(data / "new", 9)
    assert (packed(data, out).written, packed(data, out).written) == (1, 0)
    (out / "train-00000.tar").unlink()
    assert packed(data, out).written == 2
    assert_same(open_dataset(out).load("a", size=6), open_dataset(data).load("a", size=6))


@pytest.mark.parametrize("room", [0, 3000, 9000])
def test_a_full_disk_is_one_line_and_leaves_nothing_half_written(data, tmp_path, room):
    out = tmp_path / "pack"
    with full_at(room), pytest.raises(UserError) as caught:
        write_pack(data, out, PackSettings(size=10), 1)
    assert "cannot write" in str(caught.value) and "\n" not in str(caught.value)
    left = [p for p in out.rglob("*") if p.name != ".lock"]
    assert not left, "the disk was full in the first shard, so nothing of it is there"
    assert not [p for p in tmp_path.rglob("*") if p.name.startswith(PART)]
    packed(data, out, size=10)
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
    (data / "b/c.v2/1.png").write_bytes(b"no picture")
    out = tmp_path / "pack"
    assert cli.run("data pack", [str(data), str(out), "--size", "6"]) == 1
    said = capsys.readouterr()
    assert "packed 2 objects" in said.out and "failed: b/c.v2: " in said.err
    assert "warning" not in said.err
    assert open_dataset(out).uids == ["a", "d"]
    with pytest.raises(UserError, match="no object can be packed"):
        write_pack(data / "b", tmp_path / "other", PackSettings(), 1)


def test_other_folders_are_refused(data, tmp_path):
    refused(r"holds other files \(a\)", packed, data, data)
    assert not (data / shards.INDEX).exists()


# Damage. Each case damages one object or one tar.


def index_of(out):
    return json.loads((out / shards.INDEX).read_text())


def edit(out, top=None, **changes):
    """Change the index: its values, and those of its first shard."""
    values = index_of(out)
    values["shards"][0] |= changes
    (out / shards.INDEX).write_text(json.dumps(values | (top or {})))


def rewritten(out, change):
    """Write the first tar anew: ``change`` maps its members, [(TarInfo, content)], to others."""
    path = out / "train-00000.tar"
    with tarfile.open(path) as tar:
        members = [(member, tar.extractfile(member).read()) for member in tar]
    with tarfile.open(path, "w", format=tarfile.GNU_FORMAT) as tar:
        for member, content in change(members):
            member.size = len(content)
            tar.addfile(member, io.BytesIO(content))
        end = tar.offset
    first, *others = index_of(out)["shards"][0]["objects"]
    objects = [[first[0], 0, end - sum(size for _, _, size in others)]]
    shift = objects[0][2] - first[2]
    objects += [[uid, start + shift, size] for uid, start, size in others]
    edit(out, bytes=path.stat().st_size, objects=objects)


def added(name, kind=tarfile.REGTYPE, content=b"", **values):
    """Insert a member after the first one."""

    def change(members):
        member = tarfile.TarInfo(name)
        member.type = kind
        for key, value in values.items():
            setattr(member, key, value)
        return [members[0], (member, content), *members[1:]]

    return lambda out: rewritten(out, change)


def in_document(change):
    def change_first(members):
        (member, content), *rest = members
        values = json.loads(content)
        change(values)
        return [(member, json.dumps(values).encode()), *rest]

    return lambda out: rewritten(out, change_first)


def first_uid(out):
    return index_of(out)["shards"][0]["objects"][0][0]


def flip(out, byte):
    with (out / "train-00000.tar").open("r+b") as file:
        file.seek(byte)
        value = file.read(1)[0]
        file.seek(byte)
        file.write(bytes([value ^ 4]))


def moved(out, start=0, size=0):
    (uid, first, bytes), *rest = index_of(out)["shards"][0]["objects"]
    edit(out, objects=[[uid, first + start, bytes + size], *rest])


DAMAGE = {
    "a foreign member": (added("other.000.png", content=b"x"), "foreign member"),
    "a link": (added("KEY.link", tarfile.SYMTYPE, linkname="/etc/passwd"), "link, a folder"),
    "a hard link": (added("KEY.link", tarfile.LNKTYPE, linkname="KEY.json"), "link, a folder"),
    "a pipe": (added("KEY.pipe", tarfile.FIFOTYPE), "link, a folder or a device"),
    "a name outside": (added("../KEY.000.png"), "leaves its folder"),
    "an absolute name": (added("/KEY.000.png"), "not relative"),
    "a name twice": (added("KEY.000.png"), "occurs twice"),
    "a picture elsewhere": (
        in_document(lambda top: top["frames"][0].update(file_path="../a/0.png")),
        "the shard has no",
    ),
    "a pose that is none": (
        in_document(lambda top: top["frames"][0].update(transform_matrix=[[7] * 4] * 4)),
        "not a rotation",
    ),
    "a bomb of pixels": (
        lambda out: rewritten(out, lambda m: [m[0], (m[1][0], bomb()), *m[2:]]),
        "megapixels",
    ),
    "a document that is none": (
        lambda out: rewritten(out, lambda m: [(m[0][0], b"{"), *m[1:]]),
        "JSON",
    ),
    "no document": (lambda out: rewritten(out, lambda m: m[1:]), "has no "),
    "a header that is damaged": (lambda out: flip(out, 150), "cannot be unpacked"),
    "another start": (lambda out: moved(out, 512, -512), "cannot be unpacked|has no "),
    "an end within a picture": (lambda out: moved(out, size=-700), "cut short|unpacked|has no"),
}


def bomb():
    """A PNG that states 16,000 x 16,000 pixels."""
    file = io.BytesIO()
    Image.new("1", (16000, 16000)).save(file, "PNG")
    return file.getvalue()


@pytest.mark.parametrize("name", DAMAGE)
def test_damage_of_an_object_is_one_line_and_its_own(data, tmp_path, name):
    out = tmp_path / "pack"
    packed(data, out, size=None)
    uid, (damage, reason) = first_uid(out), DAMAGE[name]
    real = tarfile.TarInfo

    class Named(real):
        def __init__(self, name=""):
            super().__init__(name.replace("KEY", shards.key_of(uid)))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tarfile, "TarInfo", Named)
        damage(out)
    pack = open_dataset(out)
    message = refused(reason, pack.load, uid)
    assert str(out) in message and len(message) < 400
    for other in UIDS:
        if other != uid:
            assert_same(pack.load(other), open_dataset(data).load(other))


def test_members_that_nothing_reads_are_named_once_for_a_shard(data, tmp_path, capsys):
    out = tmp_path / "pack"
    packed(data, out, size=None)
    (first, *_), (second, *_) = index_of(out)["shards"][0]["objects"]
    keys = {uid: shards.key_of(uid) for uid in (first, second)}

    def change(members):
        at = next(i for i, (m, _) in enumerate(members) if m.name == f"{keys[second]}.json")
        own = [(tarfile.TarInfo(f"{keys[first]}.{end}"), b"x") for end in ("txt", "000.normal.png")]
        rest = [(tarfile.TarInfo(f"{keys[second]}.{end}"), b"x") for end in ("txt", "npy")]
        return [*members[:at], *own, *members[at:], *rest]

    rewritten(out, change)
    with tarfile.open(out / "train-00000.tar") as tar:
        middle = tar.getmember(f"{keys[second]}.json").offset
        end = tar.getmembers()[-1].offset_data + 512
    edit(out, objects=[[first, 0, middle], [second, middle, end - middle]])
    pack = open_dataset(out)
    for uid in (*UIDS, *UIDS):
        assert_same(pack.load(uid), open_dataset(data).load(uid))
    pickle.loads(pickle.dumps(pack)).load("a")
    (said,) = capsys.readouterr().err.splitlines()
    start = f"warning: {out / 'train-00000.tar'}: 4 members that nothing reads: "
    named = said.removeprefix(start).removesuffix(", ...").split(", ")
    assert said.startswith(start) and said.endswith(", ...") and len(named) == 3
    assert {*named} < {f"{keys[first]}.{end}" for end in ("txt", "000.normal.png")} | {
        f"{keys[second]}.{end}" for end in ("txt", "npy")
    }


def test_a_shard_cut_short_costs_its_own_objects(data, tmp_path):
    out = tmp_path / "pack"
    packed(data, out, size=None)
    os.truncate(out / "train-00000.tar", 2000)
    pack = open_dataset(out)
    assert_same(pack.load("d"), open_dataset(data).load("d"))
    refused("cut short or changed", pack.load, "a")
    assert pack.check().keys() == {"a", "b/c.v2"}, "told before a training starts"
    (out / "train-00000.tar").unlink()
    assert "No such file" in open_dataset(out, "train").check()["a"]


def test_a_shard_that_is_a_link_is_refused(data, tmp_path):
    out = tmp_path / "pack"
    packed(data, out)
    (out / "train-00000.tar").rename(tmp_path / "elsewhere.tar")
    (out / "train-00000.tar").symlink_to(tmp_path / "elsewhere.tar")
    refused("not a plain file", open_dataset(out).load, "a", size=6)


def test_a_shard_that_is_cut_while_it_is_used_is_no_crash(data, tmp_path):
    packed(data, tmp_path / "pack")
    pack = open_dataset(tmp_path / "pack")
    pack.load("a", size=6)
    os.truncate(tmp_path / "pack" / "train-00000.tar", 100)
    refused("cut short", pack.load, "a", size=6)


def test_a_bad_object_of_shards_is_skipped_in_training(tmp_path):
    data = micro.write_dataset(tmp_path / "clouds", objects=5)
    packed(data, tmp_path / "pack", size=None)
    bad = first_uid(tmp_path / "pack")
    flip(tmp_path / "pack", 150)
    assert micro.run(tmp_path / "pack", tmp_path / "run", length={"steps": 4}) == 1
    said = micro.lines(tmp_path / "run", "warning")[0]["message"]
    assert f"{bad} is skipped" in said and "cannot be unpacked" in said


@pytest.mark.parametrize(
    ("top", "reason"),
    [
        ({"version": 2}, "version 2 of shards, supported is 1"),
        ({"format": "zip"}, "not the index of shards"),
        ({"shards": []}, "have no objects"),
        ({"shards": 3}, "array"),
        ({"size": 0}, ">= 1"),
        ({"address": "pipe:touch /tmp/x"}, "regex"),
        ({"address": "file:///etc"}, "regex"),
        ({"address": "https://host/a b"}, "regex"),
    ],
)
def test_a_bad_index_is_one_line(data, tmp_path, top, reason):
    out = tmp_path / "pack"
    packed(data, out)
    edit(out, top=top)
    refused(reason, open_dataset, out)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"name": "../a.tar"}, "regex"),
        ({"name": ".a.tar"}, "regex"),
        ({"objects": [["../a", 0, 512]]}, "leaves its folder"),
        ({"objects": [[3, 0, 512]]}, "str"),
        ({"objects": [["a", 0, 512], ["a", 0, 512]]}, "a occurs twice"),
        ({"objects": [["a", -8, 512]]}, ">= 0"),
        ({"objects": [["a", 0, 10**9]]}, "ends outside"),
        ({"split": "more"}, "enum|Invalid"),
    ],
)
def test_a_bad_entry_of_the_index_is_one_line(data, tmp_path, changes, reason):
    out = tmp_path / "pack"
    packed(data, out)
    edit(out, **changes)
    refused(reason, open_dataset, out)


def test_webdataset_reads_the_shards(data, tmp_path):
    webdataset = pytest.importorskip("webdataset")
    packed(data, tmp_path / "pack", size=None)
    urls = [str(path) for path in sorted((tmp_path / "pack").glob("*.tar"))]
    read = webdataset.WebDataset(urls, shardshuffle=False, empty_check=False).decode("rgba8")
    objects = {sample["json"]["uid"]: sample for sample in read}
    assert sorted(objects) == UIDS
    for uid, sample in objects.items():
        want = open_dataset(data).pictures(uid)[0]
        assert np.array_equal(sample["002.png"], want[2])
        assert sample["json"]["attribution"] == {"creator": "me"}
        assert sample["json"]["frames"][2]["file_path"] == "002.png"
