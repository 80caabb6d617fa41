"""``gamba reconstruct --sheet``: every result in one image."""

from pathlib import Path

import numpy as np
import pytest
from helpers.gaussians import some
from helpers.images import cut_out
from helpers.model import SMALLEST, quick, run_reconstruct
from helpers.refusals import refused, refused_command
from PIL import Image

from gamba_warp.images import load_rgba, save_image
from gamba_warp.pages.sheet import VIEWS, Sheet
from gamba_warp.trajectories.movies import turntable_frames
from gamba_warp.trajectories.paths import Viewpoint


def test_a_row_is_the_input_and_views_around(tmp_path):
    sheet, gaussians = Sheet(tmp_path / "s.png"), some(40)
    rgba = np.zeros((64, 64, 4), np.float32)
    rgba[16:48, 16:48] = (1, 0, 0, 1)
    view = Viewpoint(20.0, SMALLEST.distance, SMALLEST.fov)
    sheet.add("first", rgba, gaussians, view)
    sheet.write()
    image = load_rgba(tmp_path / "s.png")[..., :3]
    assert image.shape == (18 + 128, 6 * 128, 3)
    tiles = image[18:].reshape(128, 1 + VIEWS, 128, 3).transpose(1, 0, 2, 3)
    assert np.abs(tiles[0][64, 64] - (1, 0, 0)).max() < 0.01
    assert np.abs(tiles[0][4, 4] - 0.5).max() < 0.01
    want = turntable_frames(gaussians, view, size=128, frames=VIEWS) / 255
    np.testing.assert_array_equal(tiles[1][:, 1:], want[0].astype(np.float32)[:, 1:])  # and a line
    np.testing.assert_array_equal(tiles[2:], want[1:].astype(np.float32))
    assert image[:18, 128:].min() == 1 and image[:18, :128].min() < 0.6  # the name


def sheet_of(path, count):
    """Return a sheet of white rows with unprintable names."""
    sheet = Sheet(path)
    sheet._rows += [(f"n{n}\udcff", np.zeros((128, 768, 3), np.uint8)) for n in range(count)]
    sheet.write()


@pytest.mark.parametrize(("count", "size"), [(12, (768, 12 * 146)), (13, (2 * 768 + 12, 7 * 146))])
def test_many_rows_stand_in_two_columns(tmp_path, count, size):
    sheet_of(tmp_path / "s.webp", count)
    with Image.open(tmp_path / "s.webp") as image:
        assert image.size == size and image.format == "WEBP"


def test_the_command_writes_a_sheet_of_what_went_well(tmp_path, checkpoint, capsys):
    paths = [cut_out(tmp_path / name) for name in ("a.png", "b.png")]
    save_image(tmp_path / "empty.png", np.zeros((9, 9, 4)))
    sheet = tmp_path / "new" / "sheet.png"
    options = [*quick(checkpoint, tmp_path / "out"), "--sheet", sheet]
    assert run_reconstruct(*paths, tmp_path / "empty.png", *options) == 1
    assert load_rgba(sheet).shape[:2] == (2 * 146, 768)
    assert (tmp_path / "out" / "b.ply").exists()
    sheet.unlink()
    assert run_reconstruct(tmp_path / "empty.png", *options) == 1 and not sheet.exists()


def test_a_sheet_that_cannot_be_is_one_line(tmp_path, checkpoint, capsys):
    path = cut_out(tmp_path / "a.png")
    for sheet, reason in {
        tmp_path / "sheet.txt": "a sheet is one of .png, .webp, .jpg",
        path: "would be overwritten by an output",
    }.items():
        words = [path, *quick(checkpoint, tmp_path / "out"), "--sheet", sheet]
        refused_command(capsys, "reconstruct", words, sheet, reason)
    refused("cannot write /dev/null/s.png", sheet_of, Path("/dev/null/s.png"), 1)
