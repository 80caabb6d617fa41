"""Enclosed background, shadows and white matter on plain backgrounds, with their right masks."""

import numpy as np
import pytest
from helpers.cutouts import cases, doubted, iou, near_white
from scipy.ndimage import gaussian_filter

pytest.importorskip("skimage")
from gamba_warp.photo.plain import plain_matte


@pytest.fixture(scope="module")
def found():
    pytest.importorskip("manifold3d")
    return [(case, plain_matte(case.rgb)) for case in cases()]


@pytest.fixture(scope="module")
def scores(found):
    return [(case, iou(matte.rgba[..., 3], case.alpha)) for case, matte in found]


def test_enclosed_background_and_shadows_go_and_white_matter_stays(scores):
    """Means of docs/reconstruct.md, less a hundredth for other versions of the libraries."""
    means = {}
    for case, score in scores:
        means.setdefault(case.white, []).append(score)
        if case.shadow:
            means.setdefault("shadow", []).append(score)
    assert len(scores) == 40 and len(means[True]) == 20
    floors = {False: 0.97, True: 0.87, "shadow": 0.87}
    for group, floor in floors.items():
        assert np.mean(means[group]) > floor, group


def test_text_on_white_and_shading_save_an_area(scores):
    kept = ("bottle", "monitor", "telephone", "letter", "dice", "plate", "cup", "clock", "panda")
    for case, score in scores:
        if case.name.split(",")[0] in kept:
            assert score > 0.98, case.name


@pytest.mark.parametrize(
    "darkness, blur, rows, columns, removed",
    [
        ((0.3, 0.3, 0.3), 8, (145, 165), (50, 150), True),
        ((0.3, 0.3, 0.4), 8, (145, 165), (50, 150), False),
        ((-0.1, -0.1, -0.1), 8, (145, 165), (50, 150), False),
        ((0.3, 0.3, 0.3), 8, (95, 115), (50, 150), False),
        ((0.25, 0.25, 0.25), 14, (145, 180), (20, 180), False),
    ],
    ids=["grey", "coloured", "light", "at half the height", "larger than a third of the object"],
)
def test_only_a_small_grey_shadow_at_the_foot_is_removed(darkness, blur, rows, columns, removed):
    cast = np.zeros((200, 200))
    cast[slice(*rows), slice(*columns)] = 1
    cast = gaussian_filter(cast, blur)[..., None]
    rgb = (0.9 * (1 - np.array(darkness) * cast)).astype(np.float32)
    rgb[50:150, 60:140] = 0.2, 0.3, 0.7
    alpha = plain_matte(rgb).rgba[..., 3]
    alpha[50:152, 58:142] = 0  # the object and its boundary
    assert alpha.any() != removed


def test_holes_may_be_kept(scores):
    case = next(case for case, _ in scores if case.name.startswith("headphones"))
    found, kept = plain_matte(case.rgb), plain_matte(case.rgb, keep_holes=True)
    assert len(found.holes) == 1 and not kept.holes
    hole = found.areas == found.holes[0]
    assert not found.rgba[hole, 3].any() and kept.rgba[hole, 3].all()
    np.testing.assert_array_equal(found.areas, kept.areas)


def test_an_object_like_its_background_is_doubted(found):
    """Counts of docs/reconstruct.md: 10 of 11 that are cut wrong, 1 of 43 that are cut right."""
    doubts = {True: [], False: []}
    for case, matte in (*found, *((case, plain_matte(case.rgb)) for case in near_white())):
        doubts[iou(matte.rgba[..., 3], case.alpha) >= 0.9].append(doubted(case, matte))
    assert sum(doubts[True]) <= 1 and len(doubts[True]) > 30
    assert np.mean(doubts[False]) > 0.75
