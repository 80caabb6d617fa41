"""Folders of images rendered by any method: matching, refusals and messages."""

import shutil

import numpy as np
import pytest
import torch
from helpers.views import around, eval_views, transforms
from PIL import Image

from gamba_warp.data.dataset import open_dataset
from gamba_warp.eval.views.compare import Shown, ViewsProtocol, load_gt, shown
from gamba_warp.eval.views.images import ImagePredictions, save_images

SIZE, VIEWS = 24, 4
UIDS = ("a", "group/b")

pytestmark = pytest.mark.usefixtures("one_thread")


def rgba(seed, alpha=True):
    """A noisy blob on nothing; without alpha on white."""
    rng = np.random.default_rng(seed)
    image = np.zeros((SIZE, SIZE, 4), np.uint8)
    top, left = rng.integers(2, 8, 2)
    image[top : top + 12, left : left + 13, :3] = rng.integers(0, 200, (12, 13, 3))
    image[top : top + 12, left : left + 13, 3] = 255
    if alpha:
        return image
    empty = image[..., 3] == 0
    image[empty] = 255
    return image[..., :3]


def poses(names, azimuths):
    return transforms(names, around(azimuths, 20.0, 2.0, SIZE))


AZIMUTHS = torch.arange(VIEWS) * 60.0
NAMES = [f"view{v}.png" for v in range(VIEWS)]


@pytest.fixture
def data(tmp_path):
    """Two objects of four views in data/, and copies of their images in pred/."""
    for number, uid in enumerate(UIDS):
        folder = tmp_path / "data" / uid
        folder.mkdir(parents=True)
        (folder / "transforms.json").write_text(poses(NAMES, AZIMUTHS))
        for v, name in enumerate(NAMES):
            Image.fromarray(rgba(10 * number + v)).save(folder / name)
        shutil.copytree(folder, tmp_path / "pred" / uid)
        (tmp_path / "pred" / uid / "transforms.json").unlink()
    return tmp_path


def test_true_views_without_alpha_are_told(data, capsys):
    evaluate(data)
    assert "warning" not in capsys.readouterr().err
    for path in (data / "data").rglob("*.png"):
        Image.open(path).convert("RGB").save(path)
    evaluate(data)
    line = f"warning: {data / 'data'}: no image has an alpha channel or a mask"
    assert capsys.readouterr().err.count(line) == 1


def evaluate(folder, *options):
    places = (folder / name for name in ("pred", "data", "out"))
    return eval_views(*places, "--split", "all", "--no-baselines", *options)


def test_by_name_by_number_and_by_camera_is_the_same(data):
    code, named = evaluate(data)
    assert code == 0 and named["num_ok"] == 2
    assert all(record["psnr"] == 100 and record["mask_iou"] == 1 for record in named["objects"])
    assert named["objects"][0]["images"]["matched_by"] == "name"
    for uid in UIDS:
        folder = data / "pred" / uid
        for v in range(VIEWS):
            (folder / f"view{v}.png").rename(folder / f"{v:04d}.png")
    assert evaluate(data)[1]["objects"][1]["images"]["matched_by"] == "number"
    # In another order, with an image more, and cameras rounded as a text holds them.
    for uid in UIDS:
        folder = data / "pred" / uid
        shutil.copy(folder / "0001.png", folder / "extra.png")
        names = ["extra.png", "0002.png", "0000.png", "0003.png", "0001.png"]
        azimuths = torch.tensor([75.0, 120, 0, 180, 60]) + 0.01
        (folder / "transforms.json").write_text(poses(names, azimuths))
    code, found = evaluate(data)
    want = {"matched_by": "camera", "unused": 1, "resized": 0, "alpha": True}
    assert code == 0 and found["objects"][0]["images"] == want
    assert found["mean"]["psnr"] == named["mean"]["psnr"] == 100


def test_views_of_one_name_in_several_folders_go_by_number(data):
    for uid in UIDS:
        folder = data / "data" / uid
        names = [f"camera{v}/view.png" for v in range(VIEWS)]
        (folder / "transforms.json").write_text(poses(names, AZIMUTHS))
        for v, name in enumerate(names):
            (folder / name).parent.mkdir()
            (folder / f"view{v}.png").rename(folder / name)
    assert evaluate(data)[0] == 1  # view0.png has the name of no view
    for uid in UIDS:
        for v in range(VIEWS):
            path = data / "pred" / uid / f"view{v}.png"
            path.rename(path.with_name(f"{v:03d}.png"))
    code, report = evaluate(data)
    assert code == 0 and report["objects"][1]["images"]["matched_by"] == "number"
    assert report["mean"]["psnr"] == 100
    files = open_dataset(data / "data").files("a")
    rgb = torch.from_numpy(rgba(0)[..., :3] / np.float32(255))[None]
    save_images(data / "saved", files, [2], Shown(rgb, torch.ones(1, SIZE, SIZE)))
    assert [path.name for path in (data / "saved").iterdir()] == ["2.png"]


def test_images_without_alpha_have_no_mask(data):
    for number, uid in enumerate(UIDS):
        for v in range(VIEWS):
            image = Image.fromarray(rgba(10 * number + v, alpha=False))
            image.save(data / "pred" / uid / f"view{v}.png")
    code, report = evaluate(data)
    assert code == 0
    assert report["mean"]["psnr"] == 100 and report["mean"]["mask_iou"] is None
    assert report["mean"]["psnr_black"] is None and report["protocol"]["grounds"]["grey"] == 0.5
    assert "absent" in (data / "out" / "table.md").read_text()
    # An alpha that is 1 everywhere says nothing either.
    path = data / "pred" / "a" / "view1.png"
    Image.open(path).convert("RGBA").save(path)
    assert "view0.png: has no alpha" in evaluate(data)[1]["failures"][0]["reason"]


def test_the_input_need_not_be_there(data):
    (data / "pred" / "a" / "view0.png").unlink()
    code, report = evaluate(data)
    record = report["objects"][0]
    assert code == 0 and record["psnr"] == 100 and record["input"]["psnr"] is None
    rows = {(row["views"], row["objects"]) for row in report["table"]}
    assert rows == {("novel", 2), ("input", 1)}


def double_a_number(folder):
    for path in folder.glob("view*.png"):
        path.rename(folder / path.name.removeprefix("view"))
    shutil.copy(folder / "1.png", folder / "01.png")


def shrink(folder):
    Image.open(folder / "view3.png").resize((12, 12)).save(folder / "view3.png")


def on_black(folder):
    for path in folder.glob("*.png"):
        image = np.array(Image.open(path))
        Image.fromarray(image[..., :3] * (image[..., 3:] > 0)).save(path)


def with_cameras(azimuths, focal='"fl_x": '):
    """Return a function that states cameras of an object's images."""
    text = poses(NAMES, azimuths).replace('"fl_x": ', focal)
    return lambda folder: (folder / "transforms.json").write_text(text)


@pytest.mark.parametrize(
    "spoil, said",
    [
        (lambda folder: (folder / "view2.png").unlink(), "no image of the name of view 2 (1 of"),
        (lambda x: shutil.copy(x / "view2.png", x / "view2.webp"), "view2.png has the same name"),
        (double_a_number, "has the same number"),
        (shrink, "is 12x12, the images compared are 24x24"),
        (on_black, "background rgb(0, 0, 0)"),
        (with_cameras(AZIMUTHS + 3), "rotated by 3 degrees"),
        (with_cameras(AZIMUTHS, '"fl_x": 1'), "its intrinsics differ by"),
        (
            with_cameras(torch.tensor([0.0, 60, 120, 120])),
            "view2.png and view3.png both have the camera of view 2",
        ),
        (lambda x: (x / "view1.png").write_bytes(b""), "view1.png: the file is empty"),
        (shutil.rmtree, "no such folder"),
    ],
)
def test_a_bad_object_is_named_and_the_other_is_evaluated(data, spoil, said):
    spoil(data / "pred" / "a")
    code, report = evaluate(data)
    assert code == 1 and report["num_ok"] == 1 and report["objects"][1]["psnr"] == 100
    (failed,) = report["failures"]
    assert failed["name"] == "a" and said in failed["reason"], failed["reason"]


def test_resizing_is_asked_for_and_stated(data):
    for path in (data / "pred").rglob("*.png"):
        Image.open(path).resize((48, 48), Image.Resampling.NEAREST).save(path)
    assert evaluate(data)[1]["num_failed"] == 2
    code, report = evaluate(data, "--resize-images")
    assert code == 0 and report["mean"]["psnr"] > 50  # an area average of four equal pixels
    assert report["protocol"]["resize_images"] is True
    assert report["objects"][0]["images"]["resized"] == VIEWS
    Image.fromarray(np.zeros((20, 48, 4), np.uint8)).save(data / "pred" / "a" / "view1.png")
    reason = evaluate(data, "--resize-images")[1]["failures"][0]["reason"]
    assert "48x20 has another aspect ratio than 24x24" in reason


def test_images_of_the_files_size_are_resized_as_the_truth_is(data):
    code, report = evaluate(data, "--size", "16")
    assert code == 0 and report["mean"]["psnr"] == 100


@pytest.mark.parametrize(
    "case, said",
    [
        ("none", "no folder of images for any of the 2 objects"),
        ("gaussians", "--save-gaussians"),
        ("over", "would be overwritten"),
    ],
)
def test_what_cannot_start(data, case, said, capsys):
    options = []
    if case == "none":
        (data / "pred" / "a").rename(data / "pred" / "x")
        (data / "pred" / "group").rename(data / "pred" / "y")
    if case == "gaussians":
        options = ["--save-gaussians"]
    if case == "over":
        (data / "out").mkdir()
        (data / "pred").rename(data / "out" / "images")
        (data / "pred").symlink_to(data / "out" / "images")
        options = ["--save-images"]
    code, report = evaluate(data, *options)
    assert code == 2 and report is None
    said_there = capsys.readouterr().err
    assert said in said_there and said_there.count("\n") == 1


def test_what_is_written_is_read_as_it_was(data, tmp_path):
    """Colours on each background to a rounding of 8 bits in each of colour and alpha; masks."""
    dataset = open_dataset(data / "data")
    protocol = ViewsProtocol("all", 0, None, None, None, None, 1.5)
    gt = load_gt(dataset, "a", protocol, "cpu")
    generator = torch.Generator().manual_seed(0)
    images = torch.rand(VIEWS, SIZE, SIZE, 4, generator=generator)
    images[:, :4, :, 3] = 0.0
    there = shown(images)
    save_images(tmp_path / "saved" / "a", dataset.files("a"), gt.views, there)
    found = ImagePredictions(tmp_path / "saved", 1.5, "cpu").images(dataset, gt).shown
    clear = (images[..., 3] - 0.5).abs() > 1 / 255
    assert torch.equal(found.mask()[clear], there.mask()[clear])
    for ground in (1.0, 0.5, 0.0):
        assert (found.on(ground) - there.on(ground)).abs().max() <= 1 / 255 + 1e-6
