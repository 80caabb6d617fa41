"""Datasets: three layouts that agree, splits, resizing, and errors that name the file."""

import json
import math
import pickle

import numpy as np
import pytest
import torch
from helpers import micro
from helpers.gobjaverse import ELEVATION, VIEWS, camera, write_object
from helpers.refusals import refused
from helpers.views import to_opengl
from PIL import Image

from gamba_warp.cameras import orbit
from gamba_warp.data.dataset import (
    SPLITS,
    background_note,
    camera_note,
    open_dataset,
    split_of,
    write_split,
)
from gamba_warp.train.batches import open_data

FOV = math.radians(49.1)
FOCAL = 0.5 / math.tan(FOV / 2)


def viewmats(count):
    return orbit(torch.arange(count) * 40.0, 15.0, 1.7)


def write_image(path, width=14, height=10, mark=0):
    """Left half opaque in the colour (mark, 100, 50); right half transparent red."""
    pixels = np.zeros((height, width, 4), np.uint8)
    pixels[:, : width // 2] = (mark, 100, 50, 255)
    pixels[:, width // 2 :] = (255, 0, 0, 0)
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path, lossless=True, exact=True)


def write_transforms(folder, count=3, suffix=".png", width=14, height=10, depth=False):
    poses = to_opengl(viewmats(count).double()).tolist()
    frames = []
    for i in range(count):
        name = f"images/{i:03d}{suffix}"
        write_image(folder / name, width, height, mark=i)
        frames.append({"file_path": name, "transform_matrix": poses[i]})
        if depth:
            frames[-1]["depth_file_path"] = name = f"depth/{i}.png"
            (folder / "depth").mkdir(exist_ok=True)
            Image.fromarray(np.full((height, width), 1000 + i, np.uint16)).save(folder / name)
    values = {"w": width, "h": height, "fl_x": FOCAL * height, "fl_y": FOCAL * height}
    values |= {"cx": width / 2, "cy": height / 2, "depth_unit": 1e-3, "frames": frames}
    values |= {"name": "Red half", "attribution": {"creator": "somebody"}}
    (folder / "transforms.json").write_text(json.dumps(values))
    return folder / "transforms.json"


def edit(path, **changes):
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


def test_transforms_layout(tmp_path):
    write_transforms(tmp_path / "thing", depth=True)
    data = open_dataset(tmp_path)
    assert (data.uids, len(data), data.num_views(0), data.layout) == (["thing"], 1, 3, "transforms")
    got = data.load("thing", views=[2, 0])
    assert (got.uid, got.name) == ("thing", "Red half")
    assert got.attribution == {"creator": "somebody"}
    assert got.images.shape == (2, 10, 14, 4) and got.images.dtype == torch.float32
    assert got.images[0, 0, 0].mul(255).round().tolist() == [2, 100, 50, 255]
    assert (got.cameras.width, got.cameras.height) == (14, 10)
    # float32 poses of a 1.7 unit orbit, inverted twice
    torch.testing.assert_close(got.cameras.viewmats, viewmats(3)[[2, 0]], atol=1e-6, rtol=0)
    want = [[FOCAL * 10, 0, 7], [0, FOCAL * 10, 5], [0, 0, 1]]
    torch.testing.assert_close(got.cameras.Ks[1], torch.tensor(want))
    assert got.depths.shape == (2, 10, 14)
    assert got.depths[:, 3, 3].tolist() == pytest.approx([1.002, 1.0])
    alone = open_dataset(tmp_path / "thing")
    assert alone.uids == ["thing"] and torch.equal(alone.load(0, [2, 0]).images, got.images)


def test_three_layouts_agree(tmp_path):
    write_transforms(tmp_path / "a" / "thing", width=12, height=12)
    for i, viewmat in enumerate(viewmats(3).double()):
        c2w = torch.linalg.inv(viewmat).numpy()  # OpenCV axes
        view = tmp_path / "b" / "0" / "10010" / "campos_512_v4" / f"{i:05d}"
        write_image(view / f"{i:05d}.png", 12, 12, mark=i)
        axes = {k: c2w[:3, n].tolist() for n, k in enumerate(["x", "y", "z", "origin"])}
        axes |= {"x_fov": FOV, "y_fov": FOV}
        (view / f"{i:05d}.json").write_text(json.dumps(axes))
        write_image(tmp_path / "c" / "uid" / "rgba" / f"{i:03d}.png", 12, 12, mark=i)
        c2w = to_opengl(viewmat).numpy()[:3].copy()
        c2w[:, 3] *= 2  # its cube has side 2
        (tmp_path / "c" / "uid" / "pose").mkdir(exist_ok=True)
        np.save(tmp_path / "c" / "uid" / "pose" / f"{i:03d}.npy", c2w)
    intrinsics = [[FOCAL * 12, FOCAL * 12], [6, 6], [12, 12]]
    np.save(tmp_path / "c" / "uid" / "intrinsics.npy", np.array(intrinsics))

    views = {}
    for root, layout in (("a", "transforms"), ("b", "gobjaverse"), ("c", "openlrm")):
        data = open_dataset(tmp_path / root)
        assert data.layout == layout
        views[layout] = data.load(0)
    assert open_dataset(tmp_path / "b").uids == ["0/10010"]
    for layout, got in views.items():
        want = views["transforms"]
        assert torch.equal(got.images, want.images), layout
        # float32 poses
        torch.testing.assert_close(got.cameras.viewmats, want.cameras.viewmats, atol=1e-5, rtol=0)
        torch.testing.assert_close(got.cameras.Ks, want.cameras.Ks, msg=layout)


def test_linked_objects_are_found_once(tmp_path):
    data, other = tmp_path / "data", tmp_path / "other"
    for folder in (data / "lamp", other / "deep" / "chair", other / "table"):
        write_transforms(folder, count=1)
    (data / "chair").symlink_to(other / "deep" / "chair")
    (data / "set").symlink_to(other)
    (data / "again").symlink_to(data / "lamp")
    (other / "up").symlink_to(tmp_path)
    (data / "gone").symlink_to(tmp_path / "nowhere")
    found = open_dataset(data)
    assert found.uids == ["chair", "lamp", "set/table"]
    assert not found.check() and found.load("chair").images.shape[0] == 1
    (tmp_path / "link").symlink_to(data)
    assert open_dataset(tmp_path / "link").uids == found.uids


def test_an_angle_alone_of_a_image_that_is_not_square(tmp_path):
    """Pixels are square: the vertical focal length is the horizontal one, in pixels."""
    path = write_transforms(tmp_path, count=1, width=8, height=6)
    frame = json.loads(path.read_text())["frames"][0]
    for given, (fl_x, fl_y, cx, cy) in (
        ({"camera_angle_x": FOV}, (FOCAL * 8, FOCAL * 8, 4, 3)),
        ({"camera_angle_x": FOV, "camera_angle_y": 2 * FOV}, (FOCAL * 8, 3 / math.tan(FOV), 4, 3)),
        # Numbers in pixels apply to the image, whose size the file need not repeat.
        ({"fl_x": 9, "fl_y": 7, "cx": 3, "cy": 2}, (9, 7, 3, 2)),
    ):
        path.write_text(json.dumps({**given, "frames": [frame]}))
        K = open_dataset(tmp_path).load(0).cameras.Ks[0]
        want = torch.tensor([[fl_x, 0, cx], [0, fl_y, cy], [0, 0, 1]]).float()
        torch.testing.assert_close(K, want)


def test_gobjaverse_of_images_that_are_not_square(tmp_path):
    view = tmp_path / "campos_512_v4" / "00000"  # one object's folder
    write_image(view / "00000.png", 16, 8)
    axes = {"x": [1, 0, 0], "y": [0, 1, 0], "z": [0, 0, 1], "origin": [0, 0, -2]}
    both = {"x_fov": 0.8, "y_fov": 0.6}, (8 / math.tan(0.4), 4 / math.tan(0.3))
    published = {}, (8 * 1422.222 / 1024,) * 2
    for angles, focal in (({"x_fov": FOV}, (FOCAL * 16,) * 2), both, published):
        (view / "00000.json").write_text(json.dumps(axes | angles))
        K = open_dataset(tmp_path).load(0).cameras.Ks[0]
        assert (K[0, 0], K[1, 1]) == pytest.approx(focal)


def test_masks_are_the_alpha(tmp_path):
    path = write_transforms(tmp_path, count=2, width=8, height=6)
    values = json.loads(path.read_text())
    for number, frame in enumerate(values["frames"]):
        Image.new("RGB", (8, 6), (10, 20, 30)).save(tmp_path / frame["file_path"])
        frame["mask_path"] = f"mask{number}.png"
        mask = np.zeros((6, 8), np.uint8)
        mask[2:4, 3:5] = 1 if number else 255  # nerfstudio takes both for the object
        Image.fromarray(mask).save(tmp_path / frame["mask_path"])
    frames, values["frames"] = values["frames"], [dict(f) for f in values["frames"]]
    path.write_text(json.dumps(values))
    data = open_dataset(tmp_path)
    images = data.load(0).images
    assert images[..., 3].sum((1, 2)).tolist() == [4, 4] and (images[:, 2:4, 3:5, 3] == 1).all()
    assert background_note(data) is None
    for frame in values["frames"]:
        del frame["mask_path"]
    path.write_text(json.dumps(values))
    assert "no image has an alpha channel or a mask" in background_note(open_dataset(tmp_path))
    values["frames"] = frames
    path.write_text(json.dumps(values))
    Image.new("L", (4, 6)).save(tmp_path / "mask0.png")
    refused("mask0.png: the mask is 4x6, its image 8x6", open_dataset(tmp_path).load, 0)
    (tmp_path / "mask0.png").unlink()
    assert "mask0.png: no such file" in next(iter(open_dataset(tmp_path).check().values()))


def test_nerfs_own_layout(tmp_path):
    """Three files of one object, with frames without a suffix, possibly with dots."""
    path = write_transforms(tmp_path, count=3, width=8, height=6)
    frames = json.loads(path.read_text())["frames"]
    path.unlink()
    for part, frame in zip(("train", "val", "test"), frames):
        image = tmp_path / frame["file_path"]
        frame["file_path"] = f"./{part}/r_0.5"
        (tmp_path / part).mkdir()
        image.rename(tmp_path / part / "r_0.5.png")
        values = {"camera_angle_x": FOV, "frames": [frame]}
        (tmp_path / f"transforms_{part}.json").write_text(json.dumps(values))
    data = open_dataset(tmp_path)
    assert (data.layout, data.num_views(0), data.check()) == ("nerf", 3, {})
    got = data.load(0)
    torch.testing.assert_close(got.cameras.viewmats, viewmats(3), atol=1e-6, rtol=0)
    assert [path.parent.name for path in data.files(0).images] == ["train", "val", "test"]


def test_resize_is_an_area_mean_without_bleeding(tmp_path):
    write_transforms(tmp_path, count=1, suffix=".webp", width=14, height=10)
    got = open_dataset(tmp_path).load(0, size=5)
    assert got.images.shape == (1, 5, 7, 4)
    # column 3 covers one opaque and one transparent column of the file
    assert got.images[0, 2, 3, 3].item() == pytest.approx(0.5, abs=1 / 255)
    # two 8-bit roundings at alpha 1/2
    assert got.images[0, 2, 3, :3].mul(255).tolist() == pytest.approx([0, 100, 50], abs=2)
    assert got.cameras.Ks[0, 0].tolist() == pytest.approx([FOCAL * 5, 0, 3.5])


def test_only_asked_views_are_read_and_cache_is_equal(tmp_path):
    write_transforms(tmp_path)
    (tmp_path / "images" / "001.png").write_bytes(b"broken")
    data = open_dataset(tmp_path, cache=True)
    first = data.load(0, views=[2], size=5)
    (tmp_path / "images" / "002.png").unlink()
    again = data.load(0, views=[2], size=5)
    assert torch.equal(first.images, again.images)
    assert torch.equal(first.cameras.Ks, again.cameras.Ks)
    refused("002.png", data.load, 0, views=[2])  # another size is not in the cache
    assert pickle.loads(pickle.dumps(data)).uids == data.uids


def test_split(tmp_path):
    uids = [f"object{i:04d}" for i in range(400)]
    counts = {name: sum(split_of(uid) == name for uid in uids) for name in SPLITS}
    # binomial: three standard deviations of 400 draws at 0.8 and 0.1
    assert abs(counts["train"] - 320) < 24 and abs(counts["test"] - 40) < 18
    for uid in uids[:12]:
        write_transforms(tmp_path / uid, count=1)
    by_hash = {name: [u for u in uids[:12] if split_of(u) == name] for name in SPLITS}
    assert open_dataset(tmp_path, "train").uids == by_hash["train"]
    write_split(tmp_path, dict.fromkeys(uids[:12], "one group"))
    group = split_of("one group")
    assert len(open_dataset(tmp_path, group)) == 12
    for other in set(SPLITS) - {group}:
        refused(f"12 objects is in the {other}", open_dataset, tmp_path, other)
    assert len(open_dataset(tmp_path)) == 12


@pytest.mark.parametrize(
    "spoil, message",
    [
        (lambda p: p.write_text("{"), "transforms.json: not valid JSON"),
        (lambda p: edit(p, frames=[]), "transforms.json: no frames"),
        (lambda p: edit(p, w=15), "000.png: is 14x10, but its cameras are for 15x10"),
        (lambda p: (p.parent / "images/002.png").unlink(), "002.png: no such file"),
        (lambda p: (p.parent / "images/002.png").write_bytes(b""), "002.png: the file is empty"),
        (lambda p: write_image(p.parent / "images/002.png", 8, 8), "002.png: is 8x8"),
        (lambda p: (p.parent / "depth/1.png").unlink(), "1.png: no such file"),
    ],
)
def test_bad_objects_name_the_file(tmp_path, spoil, message):
    path = write_transforms(tmp_path / "thing", depth=True)
    spoil(path)
    refused(message, open_dataset(tmp_path).load, 0)


def test_bad_requests(tmp_path):
    refused("no such folder", open_dataset, tmp_path / "nowhere")
    refused("no objects found", open_dataset, tmp_path)
    write_transforms(tmp_path / "a")
    (tmp_path / ".a.tmp").mkdir()
    (tmp_path / ".a.tmp" / "transforms.json").write_text("half written")
    data = open_dataset(tmp_path)
    assert data.uids == ["a"]
    refused("no object 'z'", data.load, "z")
    refused("view 3 requested, it has 3", data.load, 0, views=[3])
    refused("no views", data.load, 0, views=[])
    refused("size 0", data.load, 0, size=0)
    refused("split 'tset'", open_dataset, tmp_path, "tset")


@pytest.mark.parametrize("stated", [{"w": 40, "h": 30, "fl_x": 43.75, "cx": 20, "cy": 15}, {}])
def test_images_of_posed_sets_are_not_turned_by_exif(tmp_path, stated):
    """As COLMAP takes them; by an angle alone the focal length is that of the stored width."""
    folder = tmp_path / "obj"
    (folder / "images").mkdir(parents=True)
    exif = Image.Exif()
    exif[0x0112] = 6
    image = Image.fromarray(np.arange(3600, dtype=np.uint8).reshape(30, 40, 3))
    image.save(folder / "images" / "0.png", exif=exif)
    pose = np.eye(4)
    pose[2, 3] = 2
    about = stated or {"camera_angle_x": 2 * math.atan(20 / 43.75)}
    frames = [{"file_path": "images\\0.png", "transform_matrix": pose.tolist()}]
    (folder / "transforms.json").write_text(json.dumps({**about, "frames": frames}))
    views = open_dataset(tmp_path).load("obj")
    assert views.images.shape == (1, 30, 40, 4)
    np.testing.assert_array_equal((255 * views.images[0, ..., :3]).round(), np.asarray(image))
    assert views.cameras.Ks[0, 0].tolist() == pytest.approx([43.75, 0, 20])


FLIP = np.diag([1.0, -1.0, -1.0, 1.0])


@pytest.mark.parametrize(
    "convention, change",
    [
        ("in OpenCV's axes", lambda pose: pose @ FLIP),
        ("world to camera", np.linalg.inv),
        ("world to camera in OpenCV's axes", lambda pose: FLIP @ np.linalg.inv(pose)),
    ],
)
def test_cameras_that_do_not_face_the_object(tmp_path, convention, change):
    """Views of such cameras are empty, and a training on them would end without an error."""
    root = micro.write_dataset(tmp_path / "clouds", 2)
    assert camera_note(open_dataset(root)) is None
    for path in root.glob("*/transforms.json"):
        values = json.loads(path.read_text())
        for frame in values["frames"]:
            frame["transform_matrix"] = change(np.array(frame["transform_matrix"])).tolist()
        path.write_text(json.dumps(values))
    note = camera_note(open_dataset(root))
    assert note is not None and f"they would if read as {convention}: poses" in note
    refused("do not face the origin", open_data, micro.options(root, tmp_path / "run"))


def project(point, views, number):
    """Project a point of the world into an image, in fractions of its side."""
    local = views.cameras.viewmats[number, :3] @ torch.tensor([*point, 1.0])
    pixel = views.cameras.Ks[number] @ local
    return (pixel[:2] / pixel[2] / views.cameras.width).tolist()


def test_the_published_layout_is_read_where_it_is(tmp_path):
    write_object(tmp_path / "0" / "10010")
    data = open_dataset(tmp_path)
    assert (data.layout, data.uids, data.num_views(0)) == ("gobjaverse", ["0/10010"], VIEWS)
    views = data.load(0)
    assert views.images.shape == (VIEWS, 32, 32, 4)
    # The camera's focal length is that of the published example: 1422.222 of 1024 pixels.
    assert views.cameras.Ks[0, 0, 0].item() == pytest.approx(32 * 1422.222 / 1024, rel=1e-5)
    # The origin is the middle of every image; z is up; the first orbit goes around it.
    for number in range(VIEWS):
        assert project((0, 0, 0), views, number) == pytest.approx([0.5, 0.5], abs=1e-6)
    for number in (0, 7, 24, 27):
        assert project((0, 0, 0.2), views, number)[1] < 0.45
    assert views.cameras.viewmats[3, 2, 3].item() == pytest.approx(camera(3)["distance"], rel=1e-6)
    centre = -views.cameras.viewmats[0, :3, :3].T @ views.cameras.viewmats[0, :3, 3]
    sine = (centre[2] / centre.norm()).item()
    assert math.degrees(math.asin(sine)) == pytest.approx(ELEVATION[0], abs=1e-4)


@pytest.mark.parametrize("suffix", [".png", ".json"])
def test_views_that_lack_a_file_are_passed_over(tmp_path, suffix):
    write_object(tmp_path / "0" / "10010")
    views = tmp_path / "0" / "10010" / "campos_512_v4"
    (views / "00007" / f"00007{suffix}").unlink()
    (views / "00040").mkdir()  # an empty one, as left by an interrupted wget
    data = open_dataset(tmp_path)
    assert data.num_views(0) == VIEWS - 1 and not data.check()
    assert "00007" not in {path.stem for path in data.files(0).images}
    for view in views.iterdir():
        for path in view.glob("?????.png"):
            path.unlink()
    refused("no views with both image and camera", open_dataset(tmp_path).load, 0)
