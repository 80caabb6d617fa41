"""HTML pages: they are well-formed, hold everything that they show, and load nothing."""

import base64
import html.parser
import json
import re
import urllib.parse

import numpy as np
import pytest
from helpers.gaussians import some
from helpers.refusals import refused
from PIL import Image, features

from gamba_warp.model.checkpoint import DEFAULT_CHECKPOINT
from gamba_warp.pages.card import about_model, read_card
from gamba_warp.pages.page import Section, write_page
from gamba_warp.trajectories.paths import Viewpoint


class Page(html.parser.HTMLParser):
    """Collects tags, and fails on one that is not closed."""

    VOID = {"meta", "img", "line", "polyline"}

    def __init__(self, path):
        super().__init__()
        self.tags, self.text, self.stack = [], "", []
        self.source = path.read_text(encoding="utf-8")
        self.feed(self.source)
        self.close()
        assert not self.stack, f"not closed: {self.stack}"

    def handle_starttag(self, tag, attributes):
        self.tags.append((tag, dict(attributes)))
        if tag not in self.VOID:
            self.stack.append(tag)

    def handle_startendtag(self, tag, attributes):
        self.tags.append((tag, dict(attributes)))

    def handle_endtag(self, tag):
        assert self.stack.pop() == tag

    def handle_data(self, data):
        self.text += data

    def all(self, tag):
        return [attributes for name, attributes in self.tags if name == tag]


def images(*shape):
    return np.random.default_rng(0).random(shape).astype(np.float32)


def frames(count=5, size=24):
    return (images(count, size, size, 3) * 255).astype(np.uint8)


def decoded(source):
    kind, _, data = source.partition(";base64,")
    return kind.removeprefix("data:"), base64.b64decode(data, validate=True)


def full(title="A chair", **changes):
    values = dict(text="Seen once.", image=images(9, 9, 4), turntable=frames(), gaussians=some(11))
    table = [("input", "24.3 dB"), ("note", "n/a")]
    return Section(title, **{**values, "table": table, **changes})


def test_a_page_holds_everything_and_asks_for_nothing(tmp_path):
    write_page(tmp_path / "a.html", "Demo", [full(), full("Second")], "All of it.")
    page = Page(tmp_path / "a.html")
    text = re.sub(r'srcdoc="[^"]*"', "", page.source)  # the frames' policy keeps scripts at home
    addresses = re.findall(r"(?:src|href|url|action)\s*[=(]\s*[\"']?([^\"')\s>]+)", text)
    assert addresses and all(a.startswith("data:") for a in addresses)
    assert "http" not in page.source.replace("http-equiv", "")
    assert not page.all("script") and not page.all("link")
    (policy,) = [a["content"] for a in page.all("meta") if "http-equiv" in a]
    assert policy.startswith("default-src 'none'")
    for image in page.all("img"):
        kind, data = decoded(image["src"])
        assert kind in ("image/png", "image/webp") and len(data) > 50 and image["alt"]


def test_the_viewer_gets_the_gaussians_and_the_camera(tmp_path):
    write_page(tmp_path / "a.html", "", [full(view=Viewpoint(30.0, 2.25, 40.0))])
    (frame,) = Page(tmp_path / "a.html").all("iframe")
    parts = {
        part: re.findall(rf'<script type="[^"]*" id="{part}">(.*?)</script>', frame["srcdoc"])
        for part in ("object", "gaussians", "harmonics", "mesh")
    }
    (text,), (data,) = parts["object"], parts["gaussians"]
    about = json.loads(text)
    assert about["input"]["distance"] == 2.25 and about["input"]["fov"] == 40
    assert about["input"]["elevation"] == pytest.approx(np.pi / 6)
    assert len(base64.b64decode(data)) == 32 * about["count"] == 32 * 11
    assert parts["harmonics"] == parts["mesh"] == [""]
    assert about["image"].startswith("data:image/webp;base64,")


def test_images_come_back_from_the_page(tmp_path):
    section = full(gaussians=None)
    write_page(tmp_path / "a.html", "", [section])
    images = [decoded(a["src"]) for a in Page(tmp_path / "a.html").all("img")]
    (tmp_path / "input.png").write_bytes(images[0][1])
    with Image.open(tmp_path / "input.png") as image:
        np.testing.assert_allclose(np.asarray(image) / 255, section.image, atol=0.501 / 255)
    (tmp_path / "turn.webp").write_bytes(images[1][1])
    with Image.open(tmp_path / "turn.webp") as image:
        assert image.n_frames == 5 and image.size == (24, 24)
    assert features.check("webp") and len(images) == 2


def test_text_is_escaped(tmp_path):
    nasty = '</script><b onload="x">&'
    section = Section(nasty, text=nasty, files=[nasty], links={nasty: frames(1)[0]})
    section.table, section.details = [(nasty, "1"), ("1.5", nasty)], {nasty: nasty}
    write_page(tmp_path / "a.html", nasty, [section], nasty)
    page = Page(tmp_path / "a.html")
    assert not page.all("b") and "</script><b" not in page.source
    assert page.text.count(nasty) == 11


def test_an_unwritable_page_is_refused():
    refused(r"cannot write /dev/null/a\.html", write_page, "/dev/null/a.html", "", [])


def test_a_result_has_its_files_beside_a_large_viewer(tmp_path, browser_page):
    path, names = tmp_path / "a.html", ["a b#1.ply", "a<b>.gif"]
    for name in names:
        (tmp_path / name).write_bytes(b"ply\nformat binary_little_endian 1.0\n" + bytes(range(256)))
    section = Section("a", image=images(9, 9, 4), gaussians=some(20), files=names)
    write_page(path, "a", [section])
    links = [link for link in Page(path).all("a") if "download" in link]
    assert [urllib.parse.unquote(link["href"]) for link in links] == names
    opened = browser_page(path, 1280, 900, accept_downloads=True)
    box = opened.page.query_selector(".viewer").bounding_box()
    assert box["width"] > 1000 and 600 < box["height"] < 900, box
    with opened.page.expect_download() as download:
        opened.page.click(".files a")
    assert download.value.suggested_filename == names[0]
    phone = browser_page(path, 390, 800).page
    assert phone.query_selector(".viewer").bounding_box()["width"] > 300
    assert phone.evaluate("document.documentElement.scrollWidth <= innerWidth")


def test_a_wide_table_fits_a_phone(tmp_path, browser_page):
    rows = [("the training object most like it", "new views: 13.552, on black 20.957, absent")]
    write_page(tmp_path / "a.html", "", [Section("Numbers", table=rows)])
    phone = browser_page(tmp_path / "a.html", 390, 800).page
    assert phone.evaluate(
        "(box => box.scrollWidth <= box.clientWidth)(document.querySelector('.scroll'))"
    )


def row(views, name, psnr, **more):
    return {"views": views, "name": name, "objects": 7, "psnr": {"mean": psnr}, **more}


CARD = {
    **{"data": "seven cubes", "objects": 1234, "steps": 5, "compute": "a second", "seed": 3},
    **{"command": "gamba train cubes", "use": "tests", "measured": "here"},
    "limits": ["No spheres.", "No cones."],
    "figures": [
        row("novel", "model", 20.125, lpips={"mean": 0.3, "interval": [0.2, 0.4]}),
        row("novel", "billboard", 18.5, lpips={"mean": 0.25}),
        row("novel", "empty", 15.0, lpips={"mean": 0.5}),
        row("input", "model", 30.0),
        row("input", "billboard", 100.0),
    ],
}


@pytest.fixture
def model(tmp_path):
    (tmp_path / "m.json").write_text(json.dumps(CARD))
    return tmp_path / "m.safetensors"


def test_a_page_says_what_the_card_says(model):
    about = dict(about_model(model))
    assert about["Model"] == "m.safetensors" and about["Trained on"] == "seven cubes"
    assert about["Training"] == "1,234 objects, 5 steps; a second"
    # the best baseline: more is better in PSNR, less in LPIPS
    novel = about["Measured, new views"]
    assert "PSNR 20.12 dB (billboard 18.50), LPIPS 0.300 (billboard 0.250)" in novel
    assert about["Measured, input view"] == "PSNR 30.00 dB. 7 objects."
    assert about["Limits"] == "No spheres. No cones."


def test_a_model_without_a_card_says_so(tmp_path):
    assert read_card(tmp_path / "m.safetensors") is None
    model, trained = about_model(tmp_path / "m.safetensors")
    assert model == ("Model", "m.safetensors")
    assert trained == ("Trained on", "not known: this model has no card")


@pytest.mark.parametrize(
    "content",
    ["", "[]", "{", '{"data": 1}', json.dumps({**CARD, "steps": -1}), '{"a":' * 3000, "NaN"],
)
def test_a_file_that_is_no_card_does_not_stop_a_page(model, content):
    (model.parent / "m.json").write_text(content)
    refused(r"m\.json: ", read_card, model)
    assert about_model(model)[1] == ("Trained on", "not known: m.json is no model card")


def test_the_shipped_model_has_a_card():
    card = read_card(DEFAULT_CHECKPOINT)
    assert card is not None and card.objects > 100 and card.limits
    assert any(row.name == "model" and row.views == "novel" for row in card.figures)
