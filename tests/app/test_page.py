"""The whole workflow in a browser, and the page's answers to bad input."""

import io
import os
import signal
import time
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
import pytest
from helpers.app import MEGABYTES, command, serving
from helpers.browser import complains
from helpers.children import ran
from helpers.images import post
from helpers.matting import matting_network
from PIL import Image

from gamba_warp.formats.read import read_gaussians
from gamba_warp.images import save_image
from gamba_warp.trajectories.paths import set_up

PATIENCE = 90  # seconds, on a machine that does much else
RED = (0.8, 0.1, 0.1)


@pytest.fixture(scope="module")
def served(browser, tmp_path_factory):
    pytest.importorskip("gradio", reason="needs gradio: pip install '.[app]'")
    with serving(tmp_path_factory.mktemp("tmp")) as made:
        yield made


@dataclass
class Open:
    """The page, all requested URLs, and the errors of its console."""

    page: Any
    asked: list[str] = field(default_factory=list)
    complaints: list[str] = field(default_factory=list)

    def hear(self, message) -> None:
        # gradio's own scripts warn of their own libraries; their errors count.
        theirs = "/assets/" in message.location.get("url", "")
        if message.type == "error" or (complains(message) and not theirs):
            self.complaints.append(f"{message.text} ({message.location})")


@pytest.fixture
def opened(served, browser_page):
    view = browser_page("about:blank", width=1280, height=1000)
    found = Open(view.page)
    found.page.context.set_default_timeout(1000 * PATIENCE)
    found.page.on("request", lambda request: found.asked.append(request.url))
    found.page.on("console", found.hear)
    found.page.on("pageerror", lambda error: found.complaints.append(str(error)))
    found.page.goto(served.address)
    found.page.wait_for_selector("#image input[type=file]", state="attached")
    yield found
    here = (f"http://{served.host}/", "data:", "blob:")
    assert not [url for url in found.asked if not url.startswith(here)], "all stays on this machine"
    assert not found.complaints


def give(page, path):
    page.locator("#image input[type=file]").set_input_files(str(path))


def toast(page):
    page.wait_for_selector(".toast-body")
    return page.locator(".toast-body").inner_text()


def middle(page):
    """Return the colour in the middle of the editor's image, 0 to 255."""
    shot = Image.open(io.BytesIO(page.locator("#editor canvas").first.screenshot()))
    x, y = shot.width // 2, shot.height // 2
    return np.asarray(shot.convert("RGB"))[y - 2 : y + 3, x - 2 : x + 3].mean((0, 1))


def until(found, what):
    """Wait for a condition without an event."""
    deadline = time.monotonic() + PATIENCE
    while not found():
        assert time.monotonic() < deadline, what
        time.sleep(0.1)


def red_square(folder):
    image = np.ones((200, 200, 3))
    image[40:160, 40:160] = RED
    save_image(folder / "my square.png", image)
    return folder / "my square.png"


def test_the_whole_way(opened, served, tmp_path):
    page = opened.page
    give(page, red_square(tmp_path))
    page.wait_for_selector("#editor canvas")
    until(lambda: middle(page)[1] < 60, "the cut-out is seen, red in the middle")
    assert "plain background" in page.locator("#note").inner_text()
    wraps = "note => getComputedStyle(note).overflowWrap"  # an address in a message is long
    assert page.locator("#note p").evaluate(wraps) == "anywhere"

    page.get_by_text("Paint what to remove").click()
    page.wait_for_selector("#brush label.selected:has-text('remove')")
    canvas = page.locator("#editor canvas").first
    canvas.scroll_into_view_if_needed()
    box = canvas.bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2

    def paint():
        page.mouse.move(x - 30, y)
        page.mouse.down()
        page.mouse.move(x + 30, y, steps=8)
        page.mouse.up()
        page.wait_for_timeout(300)
        return middle(page)[2] < middle(page)[0] - 100 and middle(page)[1] > 45

    until(paint, "a stroke is seen")
    page.get_by_role("button", name="Apply strokes").click()
    # A little of what is cut away still shows; an image that loads is white, or nearly.
    until(lambda: 150 < middle(page)[1] < 220 < middle(page)[0] + 10, "the middle is cut away")
    page.get_by_role("button", name="Start over").click()
    until(lambda: middle(page)[1] < 60, "the middle is back")

    page.locator("#make").click()
    frame = page.wait_for_selector("iframe.stage")
    viewer = frame.content_frame()
    viewer.wait_for_selector("#message", state="hidden")
    assert viewer.locator("#name").inner_text() == "my-square"

    def drawn():
        shot = Image.open(io.BytesIO(page.locator("iframe.stage").screenshot())).convert("RGB")
        pixels = np.asarray(shot).astype(int)
        return (pixels[..., 0] - pixels[..., 1] > 60).mean() > 0.02

    until(drawn, "the viewer shows something red")
    for kind, name in (("ply", "my-square.ply"), ("spz", "my-square.spz")):
        with page.expect_download() as download:
            page.locator(f"#file-{kind}").click()
        assert download.value.suggested_filename == name
        download.value.save_as(tmp_path / name)
        assert read_gaussians(tmp_path / name).num > 100
    listed = "".join(page.locator("#made").inner_text().split())
    assert "my-square.ply" in listed and "my-square.spz" in listed


def test_several_images_and_a_strip(opened, tmp_path):
    page = opened.page
    images = [red_square(tmp_path), tmp_path / "blue.png"]
    pixels = np.ones((200, 200, 3))
    pixels[50:150, 80:190] = 0.1, 0.2, 0.8
    save_image(images[1], pixels)
    with page.expect_file_chooser() as chosen:
        page.locator("#several").click()
    chosen.value.set_files(images)
    page.wait_for_selector("#results button >> nth=1")

    def viewed():
        frame = page.wait_for_selector("iframe.stage").content_frame()
        frame.wait_for_selector("#message", state="hidden")
        return frame.locator("#name").inner_text()

    assert viewed() == "blue"
    page.locator("#results button").first.click()
    until(lambda: viewed() == "my-square", "the first one is shown again")
    with page.expect_download() as download:
        page.locator("#file-ply").click()
    download.value.save_as(tmp_path / "first.ply")
    assert read_gaussians(tmp_path / "first.ply").opacities.min() < 0.05, "faint ones are kept"
    with page.expect_download() as download:
        page.locator("#file-mesh-stl").click()
    assert download.value.suggested_filename == "my-square-mesh.stl"
    frame = page.wait_for_selector("iframe.stage").content_frame()
    frame.wait_for_selector("[data-mode=mesh]")
    assert frame.locator("#wipe input").get_attribute("max") == "1"


def downloaded(page, kind, path):
    with page.expect_download() as download:
        page.locator(f"#file-{kind}").click()
    download.value.save_as(path)
    return path


def shown_viewer(page):
    """The viewer of the shown object, once it is drawn."""
    viewer = page.wait_for_selector("iframe.stage").content_frame()
    viewer.wait_for_selector("#message", state="hidden")
    until(lambda: viewer.evaluate("!!gambaViewer.editor.state"), "it can be edited")
    return viewer


def test_the_object_is_rotated_at_once(opened, tmp_path):
    """Files follow, the view stays, and another result keeps its own elevation."""
    page = opened.page
    blue = np.ones((200, 200, 3))
    blue[50:150, 80:190] = 0.1, 0.2, 0.8
    save_image(tmp_path / "blue.png", blue)
    give(page, red_square(tmp_path))
    page.wait_for_selector("#editor canvas")
    page.locator("#make").click()
    viewer = shown_viewer(page)
    number = page.locator("#elevation input[type=number]")
    estimate = int(number.input_value())
    assert f"Estimate: {estimate} degrees" in page.locator("#elevation").inner_text()
    whole = read_gaussians(downloaded(page, "ply", tmp_path / "whole.ply"))
    viewer.evaluate("gambaViewer.rest(), gambaViewer.setCamera({ azimuth: 0.5 })")
    assert_clear(page, "#elevation")
    page.set_viewport_size({"width": 390, "height": 844})
    for button in page.locator("#elevation button").all():
        box = button.bounding_box()
        assert box["width"] >= 44 and box["height"] >= 44
    page.locator("#elevation button").last.click()
    page.locator("#elevation button").last.click()
    tilt = "Math.round(gambaViewer.camera.tilt * 180 / Math.PI)"
    until(lambda: viewer.evaluate(tilt) == 10, "it is rotated")
    page.wait_for_selector("#made", state="hidden")  # what was written before
    number.fill("40")
    until(lambda: viewer.evaluate(tilt) == 40 - estimate, "it is rotated")
    page.wait_for_timeout(1000)
    assert viewer.evaluate("gambaViewer.camera.azimuth") == 0.5, "the frame is the same"
    turned = read_gaussians(downloaded(page, "ply", tmp_path / "turned.ply"))
    wanted = set_up(whole, 40 - estimate).means
    np.testing.assert_allclose(turned.means, wanted, atol=1e-5)
    assert np.abs(turned.means - whole.means).max() > 0.05

    page.locator("#image").get_by_label("Remove Image").click()
    page.wait_for_selector("#cut", state="hidden")
    give(page, tmp_path / "blue.png")
    page.wait_for_selector("#cut", state="visible")
    page.locator("#make").click()
    page.wait_for_selector("#results button >> nth=1")
    until(lambda: number.input_value() != "40", "its own estimate")
    page.locator("#results button").first.click()
    until(lambda: number.input_value() == "40", "the elevation of the first one")
    assert shown_viewer(page).evaluate("gambaViewer.about.edit.elevation") == 40


def test_parts_are_erased(opened, tmp_path):
    """Every download follows, and the view stays."""
    page = opened.page
    give(page, red_square(tmp_path))
    page.wait_for_selector("#editor canvas")
    page.locator("#make").click()
    viewer = shown_viewer(page)
    whole = read_gaussians(downloaded(page, "ply", tmp_path / "whole.ply"))
    viewer.evaluate(
        "gambaViewer.rest(), gambaViewer.setCamera({ azimuth: 0.5 }), (window.same = true)"
    )
    viewer.locator("#do-brush").click()
    box = viewer.locator("#canvas").bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.mouse.move(x - 60, y)
    page.mouse.down()
    page.mouse.move(x + 60, y, steps=3)
    page.mouse.up()
    marked = viewer.evaluate("gambaViewer.editor.state.filter((kind) => kind === 1).length")
    assert marked > 20
    page.keyboard.press("Delete")
    page.wait_for_selector("#made", state="hidden")  # what was written before
    left = read_gaussians(downloaded(page, "ply", tmp_path / "left.ply"))
    assert left.num == whole.num - marked
    document = downloaded(page, "html", tmp_path / "left.html").read_text(encoding="utf-8")
    assert f'"count": {left.num},' in document and '"edit": null' in document
    assert viewer.evaluate("window.same && gambaViewer.camera.azimuth") == 0.5
    # Not by the mouse: a message of the page may be above the button.
    viewer.evaluate("byId('do-undo').click()")
    page.wait_for_selector("#made", state="hidden")
    again = read_gaussians(downloaded(page, "ply", tmp_path / "again.ply"))
    assert again.num == whole.num

    viewer.evaluate("byId('do-remove').click()")
    page.wait_for_selector("#made", state="hidden")
    # Another frame cannot speak for the viewer.
    key = viewer.evaluate("gambaViewer.about.edit.key")
    page.evaluate("(key) => postMessage({ edit: { key, elevation: 0, removed: '' } })", key)
    viewer.evaluate(
        "parent.postMessage({ edit: { key: 'other', elevation: 0, removed: '' } }, '*')"
    )
    page.wait_for_selector(".toast-body:has-text('this result has expired')")
    assert not page.locator(".toast-body", has_text="not those of this object").count()


def test_an_example_and_an_object_that_is_not_there(opened, tmp_path):
    page = opened.page
    page.locator("#examples button").last.click()
    page.wait_for_selector("#editor canvas")
    page.wait_for_selector("#note:has-text('transparency')")
    save_image(tmp_path / "even.png", np.full((50, 60, 3), 0.5))
    page.locator("#image").get_by_label("Remove Image").click()
    page.wait_for_selector("#cut", state="hidden")
    give(page, tmp_path / "even.png")
    page.wait_for_selector("#note:has-text('No object was found')")
    page.wait_for_selector("#editor canvas")
    page.locator("#make").click()
    assert "no object found" in toast(page) and "paint over the object" in toast(page)
    assert page.locator("iframe.stage").count() == 0


# Whether an element is inside the window, and no other is over its middle and corners.
CLEAR = """element => {
  const { left, top, right, bottom } = element.getBoundingClientRect();
  const points = [[left + 9, top + 9], [right - 9, top + 9], [left + 9, bottom - 9],
    [right - 9, bottom - 9], [(left + right) / 2, (top + bottom) / 2]];
  return top >= 0 && left >= 0 && bottom <= innerHeight && right <= innerWidth
    && points.every((point) => element.contains(document.elementFromPoint(...point)));
}"""
SIZES = ((1280, 900), (390, 844))


def assert_clear(page, *places):
    for width, height in SIZES:
        page.set_viewport_size({"width": width, "height": height})
        for place in places:
            clear = partial(page.locator(place).first.evaluate, CLEAR)
            until(clear, f"{place} is seen at {width} x {height}")


def test_the_cut_out_and_the_progress_are_in_the_window(opened, tmp_path):
    page = opened.page
    give(page, red_square(tmp_path))
    page.wait_for_selector("#editor canvas")
    assert_clear(page, "#editor", "#editor .toolbar-wrap", "#brush", "#view", "#make")
    assert page.evaluate("scrollY") == 0
    assert page.locator("#editor canvas").first.bounding_box()["height"] > 844 * 0.4
    assert not page.locator("#examples, #several").filter(visible=True).count()
    page.locator("#make").click()
    page.wait_for_selector("iframe.stage")
    assert_clear(page, "iframe.stage")
    page.locator("#view").get_by_text("Cut-out").click()
    assert_clear(page, "#editor")
    page.locator("#view").get_by_text("Object").click()
    choices = page.locator("#mesh > *").evaluate_all(
        "all => all.map(each => [each.getBoundingClientRect().right, each.scrollWidth"
        " - each.clientWidth, each.querySelector('input').clientWidth])"
    )
    assert len(choices) == 3 and all(right < 390 and over <= 0 for right, over, _ in choices)
    assert all(width > 90 for _, _, width in choices[:2]), choices  # of "Texture 1024"
    page.get_by_text("Closed, for printing").click()
    assert page.locator("#mesh input[type=checkbox]").is_checked()

    page.locator("#file-mesh-glb").click()
    page.wait_for_selector("#now .progress-level-inner:has-text('mesh ')")
    assert_clear(page, "#now", "#cancel")
    page.locator("#cancel").click()
    assert "it was cancelled" in toast(page)
    page.wait_for_selector("#now", state="hidden")


def test_a_doubted_cut_out_is_made_again_by_a_network(browser_page, tmp_path, monkeypatch):
    for library in ("gradio", "onnxruntime", "pooch"):
        pytest.importorskip(library, reason="needs pip install '.[app,photo]'")
    home = tmp_path / "models"
    home.mkdir()
    closed = "http://127.0.0.1:9"  # nothing is fetched
    settings = {"U2NET_HOME": str(home), "GAMBA_OFFLINE": "0", "HTTPS_PROXY": closed}
    for name, value in settings.items():
        monkeypatch.setenv(name, value)
    with serving(tmp_path) as served:
        page = browser_page(served.address, 1280, 900).page
        page.context.set_default_timeout(1000 * PATIENCE)
        give(page, post(tmp_path))
        page.wait_for_selector("#network:has-text('isnet-general-use, 179 MB, fetched once')")
        note = page.locator("#note").inner_text()
        assert "may be wrong" in note and "or use a network" in note and "gamba" not in note
        page.screenshot(path=tmp_path / "network.png")
        page.locator("#network").click()
        assert "the network cannot be fetched" in toast(page)
        (home / "isnet-general-use.onnx").write_bytes(matting_network())
        page.locator("#network").click()
        page.wait_for_selector("#note:has-text('The matting model isnet-general-use.onnx')")
        page.wait_for_selector("#network", state="hidden")


def test_no_image_is_one_line(opened, tmp_path):
    page = opened.page
    bad = tmp_path / "<b>no.png"
    bad.write_bytes(b"nothing of an image")
    give(page, bad)
    assert "<b>no.png: not an image that can be read" in toast(page)
    assert page.locator("#cut").count() == 0 or page.locator("#cut").is_hidden()


def test_too_large_an_upload_is_refused(opened, served, tmp_path):
    page = opened.page
    big = tmp_path / "big.png"
    big.write_bytes(b"\x89PNG" + bytes((MEGABYTES << 20) + 1))
    give(page, big)
    assert "exceed the maximum allowed size" in toast(page)
    opened.complaints.clear()  # gradio's page logs that it has no image to show
    # Warp keeps headers in a folder of its own while it compiles
    files = (p for p in served.temporary.rglob("*") if not p.parent.name.startswith("wp_pch_"))
    left = [p for p in files if p.is_file() and p.stat().st_size > 1 << 20]
    assert not left, "nothing of it is kept"


def test_a_port_in_use_and_a_bad_model_are_one_line(served, tmp_path):
    port = served.host.rpartition(":")[2]
    before = served.folders()
    for options, said, reason in (
        (["--port", port], "", f"gamba: --port {port}: Address already in use\n"),
        (["--port", 0, "--matte-model", tmp_path / "none.onnx"], "loading the model\n", None),
    ):
        environment = {**os.environ, "TMPDIR": str(served.temporary)}
        done = ran(*command(*options), timeout=60, env=environment)
        assert done.returncode == 2 and done.stdout == f"loading torch\n{said}"
        assert done.stderr.count("\n") == 1 and done.stderr.startswith("gamba: "), done.stderr
        assert reason in (None, done.stderr)
    assert served.folders() == before


def test_ctrl_c_leaves_nothing(served):
    """Must be the last test: ends the server of this file."""
    assert len(served.folders()) == 1
    served.process.send_signal(signal.SIGINT)
    out, err = served.process.communicate(timeout=30)
    assert (served.process.returncode, out, err) == (130, "", "gamba: interrupted\n")
    assert served.folders() == []
