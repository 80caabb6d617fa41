"""Images to model input: mattes, masks, recentring, and images without an object."""

import importlib.util

import numpy as np
import pytest
import torch
from helpers.refusals import refused
from PIL import Image

from gamba_warp.data.preprocess import SamSegmenter, composite, recenter, shrink
from gamba_warp.images import save_image
from gamba_warp.photo.cutout import CutoutOptions, cut_out
from gamba_warp.photo.plain import plain_matte


def disc(size=(60, 80), centre=(30, 45), radius=14.3, soft=True):
    """Coverage [H, W] of a disc, anti-aliased."""
    y, x = np.mgrid[: size[0], : size[1]]
    distance = np.hypot(y - centre[0], x - centre[1])
    return np.clip(radius + 0.5 - distance, 0, 1) if soft else (distance < radius).astype(float)


def scene(alpha, colour, background):
    alpha = alpha[..., None]
    return (alpha * np.asarray(colour) + (1 - alpha) * np.asarray(background)).astype(np.float32)


def write(path, image):
    save_image(path, image)
    return path


def prepare(path, **more):
    return cut_out(path, CutoutOptions(fetch=False, notify=lambda line: None, **more)).rgba


RED = (0.9, 0.2, 0.1)


@pytest.mark.parametrize("background", [(1, 1, 1), (0, 0, 0), (0.1, 0.7, 0.3), (0.5, 0.5, 0.5)])
def test_plain_backgrounds_are_taken_away(tmp_path, background):
    alpha = disc()
    noise = np.random.default_rng(0).normal(0, 0.008, (60, 80, 3))
    rgb = (scene(alpha, RED, background) + noise).clip(0, 1).astype(np.float32)
    rgba = plain_matte(rgb).rgba
    # 1.5 % of the disc's pixels: the noise, and edge pixels within the tolerance
    assert np.abs(rgba[..., 3] - alpha).sum() < 0.04 * alpha.sum()
    assert np.abs(rgba[..., 3] - alpha).max() < 0.35
    solid = rgba[..., 3] > 0.3
    assert np.abs(rgba[solid, :3] - RED).max() < 0.2  # no fringe of the background's colour
    out = prepare(write(tmp_path / "a.png", rgb))
    assert out.shape[0] == out.shape[1] and out[0, 0, 3] == 0


def test_on_its_own_background_the_matte_changes_nothing():
    """White stays white: removing the background and compositing on it again is the identity."""
    rgb = scene(disc(), RED, (1, 1, 1))
    rgba = plain_matte(rgb).rgba
    alpha = rgba[..., 3:]
    back = rgba[..., :3] * alpha + 1 - alpha
    # cut pixels may differ by the tolerance of "plain"
    assert np.abs(back - rgb).max() < 0.071 and np.abs(back - rgb).mean() < 1e-3


def test_dust_does_not_move_the_object():
    alpha = disc()
    rgb = scene(alpha, RED, (1, 1, 1))
    clean = recenter(plain_matte(rgb).rgba)
    rgb[2, 2] = 0
    np.testing.assert_array_equal(recenter(plain_matte(rgb).rgba), clean)


def test_a_mask_wins_over_all(tmp_path):
    rgb = write(tmp_path / "a.png", scene(disc(), RED, (1, 1, 1)))
    mask = np.zeros((60, 80))
    mask[:20, :20] = 1
    out = prepare(rgb, mask=write(tmp_path / "mask.png", mask))
    assert out.shape == (25, 25, 4) and out[..., 3].sum() == 400
    # A cut-out as a mask: opaque on the object, in any colour but black
    cutout = np.dstack([np.ones((60, 80, 3)), mask])
    again = prepare(rgb, mask=write(tmp_path / "cut.png", cutout))
    np.testing.assert_array_equal(again, out)
    small = write(tmp_path / "small.png", np.ones((4, 5)))
    refused(r"small\.png: the mask is 5x4 but .*a\.png is 80x60", prepare, rgb, mask=small)
    black = write(tmp_path / "black.png", np.zeros((60, 80)))
    refused(r"black\.png: no object found", prepare, rgb, mask=black)
    refused(r"none\.png: no such file", prepare, rgb, mask=tmp_path / "none.png")


@pytest.mark.parametrize(
    "image",
    [
        np.zeros((20, 30, 4)),
        np.dstack([np.ones((20, 30, 3)), np.full((20, 30), 0.02)]),
        np.ones((20, 30, 3)),
        np.full((1, 1), 0.3),
        np.ones((1, 500, 3)),
        np.dstack([np.zeros((20, 30, 3)), np.eye(20)[:, :1] @ np.eye(30)[:1]]),
    ],
    ids=["transparent", "nearly transparent", "white", "one pixel", "one row", "one of many"],
)
def test_images_without_an_object(tmp_path, image):
    path = write(tmp_path / "a.png", image)
    refused(r"a\.png: no object found", prepare, path)


@pytest.mark.parametrize("mode", ["P", "L", "I;16", "1"])
def test_other_kinds_of_images(tmp_path, mode):
    alpha = disc(soft=False)
    grey = (255 - 200 * alpha).astype(np.uint8)
    image = Image.fromarray(grey)
    if mode == "I;16":
        image = Image.fromarray(grey.astype(np.uint16) * 257)
    elif mode != "L":
        image = image.convert(mode, dither=Image.Dither.NONE)
    image.save(tmp_path / "a.png")
    out = prepare(tmp_path / "a.png")
    assert np.isfinite(out).all() and out.shape[0] == out.shape[1]
    assert abs((out[..., 3] > 0.5).sum() - alpha.sum()) < 0.03 * alpha.sum()


@pytest.mark.parametrize("size", [(1, 3000), (3000, 1), (2, 1200), (1500, 1700)])
def test_extreme_shapes(tmp_path, size):
    rgba = np.ones((*size, 4), np.float32)
    rgba[0, 0, 3] = 0
    out = prepare(write(tmp_path / "a.png", rgba))
    assert out.shape[0] == out.shape[1] <= 1280
    assert composite(out, 64).shape == (64, 64, 3)


@pytest.mark.parametrize("ratio", [0.0, 0.2, 0.5])
def test_recentring(ratio):
    rgba = np.zeros((50, 70, 4), np.float32)
    rgba[3:24, 40:67] = np.random.default_rng(0).uniform(0.5, 1, (21, 27, 4))
    out = recenter(rgba, ratio)
    side = int(np.ceil(27 / (1 - ratio)))
    assert out.shape == (side, side, 4) and out.dtype == np.float32
    rows, columns = np.nonzero(out[..., 3])
    assert abs(rows.min() + rows.max() - (side - 1)) <= 1
    assert abs(columns.min() + columns.max() - (side - 1)) <= 1
    inner = out[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]
    np.testing.assert_array_equal(inner, rgba[3:24, 40:67])


def test_shrinking_weights_by_alpha():
    """The colour under transparent pixels must not bleed into the object."""
    rgba = np.zeros((40, 80, 4), np.float32)
    rgba[..., 1] = 1  # transparent green
    rgba[10:30, 21:61] = (*RED, 1)
    small = shrink(rgba, 20)
    assert small.shape == (10, 20, 4)
    present = small[..., 3] > 0.01
    assert np.abs(small[present, :3] - RED).max() < 1e-5
    assert small[..., 3].mean() == pytest.approx(rgba[..., 3].mean(), rel=1e-3)
    assert shrink(rgba, 80) is rgba


def test_compositing():
    rgba = np.zeros((10, 10, 4), np.float32)
    rgba[..., 0] = 1
    rgba[5:, :, 3] = 0.5
    out = composite(rgba, 10)
    assert out.dtype == torch.float32
    assert out[0, 0].tolist() == [1, 1, 1] and out[9, 9].tolist() == [1, 0.5, 0.5]
    black = composite(rgba, 10, background=0.0)
    assert black[0, 0].tolist() == [0, 0, 0] and black[9, 9].tolist() == [0.5, 0, 0]
    assert composite(rgba, 33).shape == (33, 33, 3)


needs_sam = pytest.mark.skipif(
    importlib.util.find_spec("kornia.models.sam") is None, reason="needs kornia 0.9"
)


@needs_sam
def test_files_that_are_not_sam_checkpoints(tmp_path):
    (tmp_path / "text.pth").write_text("hello")
    torch.save({"image_encoder.pos_embed": torch.zeros(1, 64, 64, 7)}, tmp_path / "odd.pth")
    torch.save({"weight": torch.zeros(3)}, tmp_path / "other.pth")
    refused(r"--sam .*none\.pth: no such file", SamSegmenter, tmp_path / "none.pth")
    for name in ("text.pth", "odd.pth", "other.pth"):
        refused(rf"--sam .*{name}: not a Segment Anything", SamSegmenter, tmp_path / name)


@needs_sam
def test_sam_runs_the_weights_of_the_file(tmp_path):
    """A MobileSAM is recognised, its weights are the file's, and it is in eval mode."""
    from kornia.models.sam import Sam, SamConfig

    model = Sam.from_config(SamConfig("mobile_sam")).eval()
    torch.save(model.state_dict(), tmp_path / "mobile.pt")
    segmenter = SamSegmenter(tmp_path / "mobile.pt")
    loaded = segmenter._prompter.model
    assert not loaded.training
    for name, value in model.state_dict().items():
        assert torch.equal(loaded.state_dict()[name], value), name
    rgb = np.random.default_rng(0).random((30, 50, 3)).astype(np.float32)
    alpha = segmenter(rgb)
    assert alpha.shape == (30, 50) and alpha.dtype == np.float32
    assert set(np.unique(alpha)) <= {0.0, 1.0}
