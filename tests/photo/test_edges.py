"""Edges of cut-outs: white and black that is mixed in goes, colours of the object stay."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from gamba_warp.images import save_image
from gamba_warp.photo.cutout import CutoutOptions, cut_out
from gamba_warp.photo.edges import without_background, without_matte

SIZE = (61, 83)


def disc(color, seed=0):
    """A disc ``[H, W, 4]`` with a soft edge, of a colour with 5 % of noise; straight alpha."""
    y, x = np.mgrid[: SIZE[0], : SIZE[1]]
    alpha = np.clip(24 - np.hypot(x - 40, y - 29), 0, 1)
    noise = np.random.default_rng(seed).normal(0, 0.05, (*SIZE, 3))
    return np.dstack([(noise + color).clip(0, 1), alpha]).astype(np.float32)


def mixed(rgba, background):
    colors, alpha = rgba[..., :3], rgba[..., 3:]
    return np.dstack([alpha * colors + (1 - alpha) * background, alpha]).astype(np.float32)


@pytest.mark.parametrize("color", [(0.7, 0.0, 0.1), (0.3, 0.4, 0.5), (0.6, 0.6, 0.2)])
@pytest.mark.parametrize("name, background", [("white", 1.0), ("black", 0.0)])
def test_white_and_black_go(name, background, color):
    clean = disc(color)
    found, which = without_matte(mixed(clean, background))
    assert which == name
    seen = clean[..., 3] > 0.05  # float32 divided by a small alpha
    np.testing.assert_allclose(found[seen], clean[seen], atol=1e-5)
    assert found.dtype == np.float32


def test_solid_pixels_keep_their_colours():
    """Nearly opaque ones too, whose alpha has one step of 8 bits."""
    clean = disc((0.5, 0.0, 0.1))
    clean[20:30, 35:45, 3] = 254 / 255
    given = mixed(clean, 1.0)
    found, which = without_matte(given)
    solid = given[..., 3] == 1
    assert which == "white" and (found[solid] == given[solid]).all()
    almost = given[..., 3] == np.float32(254 / 255)
    np.testing.assert_allclose(found[almost], clean[almost], atol=1e-5)


def test_a_photograph_keeps_the_colours_of_solid_pixels():
    rgb = np.random.default_rng(1).random((*SIZE, 3)).astype(np.float32)
    alpha = disc((0, 0, 0))[..., 3]
    found = without_background(rgb, alpha)
    assert (found[alpha == 1, :3] == rgb[alpha == 1]).all() and (found[..., 3] == alpha).all()


GROUND = np.array([0.2, 0.5, 0.9])


def bounded(color, background, width=1.2):
    """A disc before a background as a hard mask of some pixels more cuts it; and as it is."""
    clean = disc(color)
    y, x = np.mgrid[: SIZE[0], : SIZE[1]]
    mask = np.hypot(x - 40, y - 29) < 24 + width
    return np.dstack([mixed(clean, background)[..., :3], mask]).astype(np.float32), clean


@pytest.mark.parametrize("color", [(0.7, 0.0, 0.1), (0.3, 0.5, 0.3), (0.7, 0.3, 0.1)])
def test_a_rim_of_the_background_goes(color):
    """Of white by itself, of a photograph's background beside its mask."""
    ground = GROUND if color == (0.7, 0.3, 0.1) else 1.0
    given, clean = bounded(color, ground)
    if ground is GROUND:
        found = without_background(given[..., :3], given[..., 3])
    else:
        found, which = without_matte(given)
        assert which == "white"
    left, before = (abs(x[..., 3] - clean[..., 3]).mean() for x in (found, given))
    assert left < 0.15 * before
    seen = clean[..., 3] > 0.3
    assert abs(found - clean)[seen].mean() < 0.5 * abs(given - clean)[seen].mean()


def test_a_rim_that_is_removed_is_said(tmp_path):
    given, clean = bounded((0.7, 0.3, 0.1), GROUND)
    save_image(tmp_path / "photo.png", given[..., :3])
    for mask, said in ((given, ", without the background mixed into its edge."), (clean, ".")):
        save_image(tmp_path / "mask.png", mask[..., 3])
        options = CutoutOptions(mask=tmp_path / "mask.png", recenter=False)
        how = cut_out(tmp_path / "photo.png", options).how
        assert how == f"The mask mask.png cut the object out{said}"


def shaded(color):
    """A hard disc that becomes darker towards its edge, as a ball does."""
    y, x = np.mgrid[: SIZE[0], : SIZE[1]]
    light = np.sqrt(np.clip(1 - (np.hypot(x - 40, y - 29) / 26) ** 2, 0, 1))
    return np.dstack([light[..., None] * color, light > 0.3]).astype(np.float32)


def outlined(color):
    """A disc in a drawing, with an outline of two pixels."""
    image, _ = bounded((0.7, 0.6, 0.2), np.array(color))
    return image


KEPT = {
    "clean": disc((0.3, 0.4, 0.5)),
    "white itself": disc((0.97, 0.97, 0.97)),
    "a fringe that nobody sees": mixed(disc((0.95, 0.95, 0.95)), 1.0),
    "light, or a photograph's": mixed(disc((0.2, 0.3, 0.4)), np.array([0.75, 0.6, 0.3])),
    "half transparent": disc((0.5, 0.1, 0.1)) * [1, 1, 1, 0] + np.float32([0, 0, 0, 0.5]),
    "shaded": shaded((0.6, 0.7, 0.3)),
    "black outline": outlined((0, 0, 0)),
    "red outline": outlined((0.8, 0.1, 0.1)),
    "nearly white": disc((0.9, 0.9, 0.85)),
}


@pytest.mark.parametrize("image", KEPT.values(), ids=KEPT)
def test_other_edges_stay(image):
    found, which = without_matte(image)
    assert which is None and found is image


@pytest.mark.parametrize("blur", [0, 1])
def test_a_right_mask_stays(blur):
    """Also one of an image that is a little blurred, as photographs are."""
    clean = disc((0.7, 0.3, 0.1))
    photo = gaussian_filter(mixed(clean, GROUND)[..., :3], (0.6 * blur, 0.6 * blur, 0))
    assert (without_background(photo, clean[..., 3])[..., 3] == clean[..., 3]).all()


def test_a_image_keeps_no_fringe_of_its_background(tmp_path):
    clean = disc((0.7, 0.0, 0.1))
    save_image(tmp_path / "icon.png", mixed(clean, 1.0))
    icon = cut_out(tmp_path / "icon.png", CutoutOptions(recenter=False))
    assert "is the cut-out, without the white mixed into its edge." in icon.how
    save_image(tmp_path / "clean.png", clean)
    assert "is the cut-out." in cut_out(tmp_path / "clean.png").how
    save_image(tmp_path / "photo.png", mixed(clean, 0.9)[..., :3])
    save_image(tmp_path / "mask.png", clean[..., 3])
    options = CutoutOptions(mask=tmp_path / "mask.png", recenter=False)
    photo = cut_out(tmp_path / "photo.png", options)
    edge = (clean[..., 3] > 0.3) & (clean[..., 3] < 0.9)
    for cut in (icon, photo):
        inner = cut.editable[edge]
        np.testing.assert_allclose(inner[:, 3], clean[edge, 3], atol=0.003)  # of 8 bits
        assert abs(inner[:, 1] - clean[edge, 1]).mean() < 0.08  # .4 with the fringe
