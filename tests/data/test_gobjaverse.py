"""G-Objaverse's layout as published, and its missing files."""

import math

import pytest
import torch
from helpers.published.gobjaverse import ELEVATION, VIEWS, camera, write_object
from helpers.refusals import refused

from gamba_warp.data.dataset import open_dataset


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
