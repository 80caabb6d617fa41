"""The sheet of ``gamba eval-geometry``: predictions beside their ground truths, the worst first."""

import numpy as np
import pytest
import trimesh
from PIL import Image

from gamba_warp import cli
from gamba_warp.eval.shapes.shape import Mesh, Points
from gamba_warp.eval.shapes.sheet import SIDE, image_of


@pytest.fixture
def folders(tmp_path):
    """A box that is right, and one that is half as high."""
    for name, height in (("good", 1.0), ("bad", 0.5)):
        for side, extents in (("pred", (0.6, 0.8, height)), ("gt", (0.6, 0.8, 1.0))):
            (tmp_path / side).mkdir(exist_ok=True)
            trimesh.creation.box(extents).export(tmp_path / side / f"{name}.ply")
    return tmp_path / "pred", tmp_path / "gt"


def test_the_worst_pair_comes_first(folders, tmp_path):
    options = "--set", "num_points=500", "iou_voxels=16", "--out", tmp_path / "out"
    assert cli.run("eval-geometry", [*map(str, (*folders, *options))]) == 0
    sheet = np.asarray(Image.open(tmp_path / "out" / "sheet.png"))
    assert sheet.shape[1] == 4 * SIDE
    box = trimesh.creation.box((0.6, 0.8, 1.0))
    want = image_of(Mesh(box.vertices, box.faces))
    first, second = (sheet[top + 40 : top + 40 + SIDE] for top in (0, SIDE + 26))
    for row, same in ((first, False), (second, True)):
        assert np.array_equal(row[:, 2 * SIDE :], want)  # the ground truth
        assert np.array_equal(row[:, : 2 * SIDE], want) == same
    rest = *options[:-1], tmp_path / "no", "--no-sheet"
    assert cli.run("eval-geometry", [*map(str, (*folders, *rest))]) == 0
    assert not (tmp_path / "no" / "sheet.png").exists()


def test_points_are_drawn_where_they_are():
    image = image_of(Points(np.array([[0.0, 0, 0], [0, 0, 0.4]])))
    for view in np.hsplit(image, 2):
        row, column = np.nonzero(view < 255)
        assert len(row) == 2 and abs(column - SIDE / 2).max() < 1  # upright
        assert row.min() < 0.35 * SIDE and abs(row.max() - SIDE / 2) <= 1
