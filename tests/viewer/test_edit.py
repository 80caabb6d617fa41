"""The brush of the viewer that removes Gaussians, as the page of the app shows it."""

import base64
import io

import numpy as np
import pytest
import torch
from helpers.views import cloud_of
from PIL import Image

from gamba_warp.trajectories.paths import set_up
from gamba_warp.viewer.page import write_viewer

CAMERA = (1.5, 49.1, 0.0)
SIDE = 400


def row(y=0.0, n=8):
    """Gaussians side by side at a height, the largest last; the viewer has it first."""
    means = torch.full((n, 1), y) * torch.tensor([0.0, 1.0, 0.0])
    means[:, 0] = torch.linspace(-0.4, 0.4, n)
    found = cloud_of(means, 0.02, 0.9, torch.tensor([0.1, 0.3, 0.9]).expand(n, 3))
    found.scales *= torch.linspace(1, 1.1, n)[:, None]
    return found


@pytest.fixture
def edited(browser_page, tmp_path):
    """Opens the page of a row, whose frame is told of edits in ``told``."""

    def opened(removed=bytes(1), y=0.0, **options):
        edit = {"key": "row", "elevation": 0.0, "removed": base64.b64encode(removed).decode()}
        path = tmp_path / "row.html"
        write_viewer(path, "Row", row(y), camera=CAMERA, edit=edit)
        found = browser_page(path, SIDE, 600, reduced_motion="reduce", **options)
        found.promised("gambaViewer.rest()")
        found.page.evaluate("""() => {
          window.told = [];
          addEventListener("message", ({ data }) => data.edit && told.push(data.edit.removed));
        }""")
        return found

    return opened


def place(page, x, y=0.0):
    """The pixel of a point with z = 0."""
    box = page.locator("#canvas").bounding_box()
    focal = min(box["width"], box["height"]) / 2 / np.tan(np.radians(CAMERA[1] / 2))
    return box["width"] / 2 + focal * x / CAMERA[0], box["height"] / 2 + focal * y / CAMERA[0]


def stroke(page, start, end, y=0.0):
    """Drag from one x to another."""
    (x, height), (to, _) = place(page, start, y), place(page, end, y)
    page.mouse.move(x, height)
    page.mouse.down()
    page.mouse.move(to, height, steps=2)  # the brush paints what is between two events, too
    page.mouse.up()


def states(page):
    """The states in the row's order."""
    return page.evaluate("[...gambaViewer.editor.state]")[::-1]


def told(opened, count):
    """The removed ones, in the row's order, of the last message."""
    opened.until(f"told.length === {count}")
    text = opened.page.evaluate("told.at(-1)")
    bits = np.unpackbits(np.frombuffer(base64.b64decode(text), np.uint8), bitorder="little")
    return bits[::-1].tolist()


def blue(page):
    """The columns of the canvas that show the row's colour."""
    return page.evaluate("""async () => {
      await gambaViewer.rest();
      gambaViewer.renderer.present();
      const copy = document.createElement("canvas"), { canvas } = gambaViewer;
      Object.assign(copy, { width: canvas.width, height: canvas.height });
      const ink = copy.getContext("2d");
      ink.drawImage(canvas, 0, 0);
      const { data, width, height } = ink.getImageData(0, 0, canvas.width, canvas.height);
      const blue = new Set();
      for (let i = 0; i < width * height; i++)
        if (data[4 * i + 3] && data[4 * i + 2] > data[4 * i] + 80) blue.add(i % width);
      return [Math.min(...blue), Math.max(...blue)];
    }""")


def test_a_brush_marks_removes_and_undoes(edited):
    opened = edited()
    page, view = opened.page, "JSON.stringify(gambaViewer.camera.copyOf(gambaViewer.camera))"
    before, whole = page.evaluate(view), blue(page)
    page.keyboard.press("e")
    page.evaluate("byId('brush-size').value = 12")
    stroke(page, -0.42, -0.15)
    assert states(page) == [1, 1, 1, 0, 0, 0, 0, 0]
    marked = blue(page)
    assert marked[0] > whole[0] + 30 and marked[1] == whole[1], "marks have another colour"
    page.keyboard.press("Delete")
    assert told(opened, 1) == [1, 1, 1, 0, 0, 0, 0, 0]
    assert page.inner_text("#about") == "5 Gaussians" and blue(page) == marked
    stroke(page, 0.4, 0.4)
    page.click("#do-remove")
    assert told(opened, 2) == [1, 1, 1, 0, 0, 0, 0, 1]
    page.click("#do-undo")
    assert told(opened, 3) == [1, 1, 1, 0, 0, 0, 0, 0] and states(page)[-1] == 1
    for _ in range(3):
        page.keyboard.press("Control+z")
    assert told(opened, 4) == [0] * 8 and states(page) == [0] * 8
    assert page.is_disabled("#do-undo") and page.inner_text("#about") == "8 Gaussians"
    assert blue(page) == whole and page.evaluate(view) == before
    assert not opened.messages


def test_marks_can_be_cleared_and_the_view_turned(edited):
    opened = edited()
    page = opened.page
    page.click("#do-brush")
    stroke(page, -0.42, 0.42)
    assert states(page) == [1] * 8
    page.keyboard.press("Delete")
    assert page.inner_text("#message-text") == "This removes all Gaussians."
    page.keyboard.down("Shift")
    stroke(page, -0.4, -0.4)
    page.keyboard.up("Shift")
    assert states(page) == [0] + [1] * 7
    x, y = place(page, 0)
    page.mouse.move(x, y)
    page.mouse.down(button="right")
    page.mouse.move(x + 40, y, steps=2)
    page.mouse.up(button="right")
    assert page.evaluate("gambaViewer.camera.azimuth") < -0.1 and states(page) == [0] + [1] * 7
    page.keyboard.press("Escape")
    assert states(page) == [0] * 8
    stroke(page, -0.42, 0.42)  # it turns the view again
    assert states(page) == [0] * 8 and page.evaluate("told.length") == 0 and not opened.messages


def test_a_finger_marks_and_two_move(edited):
    opened = edited(has_touch=True)
    page = opened.page
    page.tap("#do-brush")
    opened.fingers("touchStart", place(page, -0.4))
    opened.fingers("touchMove", place(page, -0.1))
    opened.fingers("touchEnd")
    opened.until("gambaViewer.editor.state.includes(1)")
    marked = states(page)
    assert marked[0] == 1 and marked[-1] == 0
    (x, y), (to, _) = place(page, 0.1), place(page, 0.4)
    opened.fingers("touchStart", (x, y), (to, y))
    opened.fingers("touchMove", (x, y + 30), (to, y + 30))
    opened.fingers("touchEnd")
    opened.until("gambaViewer.camera.target[1] < -0.01")
    assert states(page) == marked and not opened.messages


def test_what_was_removed_before_is_not_shown_and_can_be_undone(edited):
    opened = edited(bytes([0b1110_0000]))
    assert states(opened.page) == [2, 2, 2, 0, 0, 0, 0, 0]
    assert opened.page.inner_text("#about") == "5 Gaussians"
    opened.page.mouse.dblclick(*place(opened.page, -0.4))
    opened.until("gambaViewer.picks.size === 0")
    assert opened.page.evaluate("gambaViewer.camera.goal") is None, "nothing is there to look at"
    opened.page.click("#do-undo")
    assert told(opened, 1) == [0] * 8 and states(opened.page) == [0] * 8
    assert not opened.messages


def canvas(opened):
    """The pixels at rest."""
    text = opened.promised("gambaViewer.png()").partition(",")[2]
    with Image.open(io.BytesIO(base64.b64decode(text))) as image:
        return np.asarray(image.convert("RGB")).astype(float) / 255


def test_the_object_is_rotated_at_once_for_another_elevation(edited, browser_page, tmp_path):
    """The view stays; the first view is the input's; the image is that of a rotated object."""
    opened = edited(y=0.3)
    page, camera = opened.page, "JSON.stringify(gambaViewer.camera.copyOf(gambaViewer.camera))"
    first = canvas(opened)
    page.evaluate("gambaViewer.setCamera({ azimuth: 0.7, elevation: 0.3 })")
    before = page.evaluate(camera)
    for degrees in (10, 40):
        page.evaluate(f"postMessage({{ elevation: {degrees} }})")
    opened.until("told.length === 1")  # once it stays
    assert page.evaluate("gambaViewer.about.edit.elevation") == 40
    assert page.evaluate(camera) == before
    seen = canvas(opened)
    path = tmp_path / "above.html"
    write_viewer(path, "Row", set_up(row(0.3), 40.0), camera=(*CAMERA[:2], 40.0))
    other = browser_page(path, SIDE, 600, reduced_motion="reduce")
    other.promised("gambaViewer.rest()")
    other.page.evaluate("gambaViewer.setCamera({ azimuth: 0.7, elevation: 0.3 })")
    # The brush's page has no slider of the input either, so both images have one size.
    assert np.abs(canvas(other) - seen).max() < 3 / 255 < 0.3 < np.abs(first - seen).max()
    page.keyboard.press("r")
    assert np.abs(canvas(opened) - first).max() < 2 / 255, "the input's view"
    page.keyboard.press("e")
    stroke(page, -0.42, -0.15, 0.3)
    assert states(page)[:3] == [1, 1, 1] and states(page)[-1] == 0, "the brush sees it as it is"
    page.evaluate("postMessage({ elevation: 'x' })")
    assert page.evaluate("gambaViewer.about.edit.elevation") == 40 and not opened.messages


def test_other_pages_have_no_brush(browser_page, tmp_path):
    write_viewer(tmp_path / "row.html", "Row", row(), camera=CAMERA)
    opened = browser_page(tmp_path / "row.html", SIDE, 600, reduced_motion="reduce")
    opened.promised("gambaViewer.rest()")
    opened.page.keyboard.press("e")
    stroke(opened.page, -0.42, 0.42)
    opened.page.evaluate("postMessage({ elevation: 30 })")
    assert opened.page.evaluate("gambaViewer.camera.tilt") == 0
    assert not opened.page.is_visible("#edit") and not opened.page.is_visible("#ring")
    assert opened.page.evaluate("gambaViewer.camera.azimuth") < 0
    opened.page.keyboard.press("h")
    assert "unmarks" not in opened.page.inner_text("#help") and not opened.messages
