"""The site builds without broken links, and README keeps its promises."""

import os
import re
import sys
from html.parser import HTMLParser
from pathlib import Path

import pytest
import yaml
from helpers.children import ran
from website.links import rewritten

from gamba_warp.versions import __version__

ROOT = Path(__file__).resolve().parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")
CITATION = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))


class Loaded(HTMLParser):
    """Collects what a browser fetches to show a page."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []

    def handle_starttag(self, tag, attrs):
        values = dict(attrs)
        if tag in ("script", "img", "iframe", "source", "video"):
            self.found.append(values.get("src") or "")
        if tag == "link" and values.get("rel") in ("stylesheet", "icon", "preconnect", "preload"):
            self.found.append(values.get("href") or "")


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    pytest.importorskip("mkdocstrings", reason="needs pip install '.[docs]'")
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", folder]
    done = ran(*command, cwd=ROOT, env=os.environ | {"NO_MKDOCS_2_WARNING": "1"})
    assert done.returncode == 0, done.stdout + done.stderr
    return folder


def test_the_site_builds_strictly_and_has_every_page(site):
    for path in (ROOT / "docs").rglob("*.md"):
        page = path.relative_to(ROOT / "docs").with_suffix(".html")
        assert (site / page).is_file(), page
    for page in ("examples/first-steps.html", "repository/kernels/rasterize.html"):
        assert (site / page).is_file(), page
    code = (site / "code/docs/examples/fit_photograph.py.html").read_text()
    assert "rasterization" in code
    assert not list(site.rglob("*.py")) and not list(site.rglob("*.ipynb"))


def test_every_page_is_in_the_navigation(site):
    start = (site / "index.html").read_text()
    for path in (ROOT / "docs").glob("*.md"):
        assert f'href="{path.stem}.html"' in start or path.stem == "index", path.name


def test_a_page_loads_nothing_from_elsewhere(site):
    pages = list(site.rglob("*.html"))
    assert len(pages) > 30
    for page in pages:
        reader = Loaded()
        reader.feed(page.read_text(encoding="utf-8"))
        outside = [name for name in reader.found if re.match(r"(https?:)?//", name)]
        assert not outside, f"{page}: {outside}"


def test_links_keep_their_anchors_and_blocks_of_code_are_left():
    text = "[a](../eval/README.md#b) [c](#d) [e](https://f.org/g.md)\n"
    block = f"```text\n{text}```\n"
    new = "[a](repository/eval.md#b) [c](#d) [e](https://f.org/g.md)\n"
    assert rewritten(text + block, "docs/gpu.md", "gpu.md") == new + block


def test_the_citation_is_that_of_the_paper():
    assert CITATION["cff-version"] == "1.2.0" and CITATION["version"] == __version__
    assert {"title", "message", "authors", "license"} <= set(CITATION)
    paper = CITATION["preferred-citation"]
    names = [f"{a['family-names']}, {a['given-names']}" for a in paper["authors"]]
    for page in ("README.md", "docs/index.md"):
        text = (ROOT / page).read_text(encoding="utf-8")
        bibtex = re.search(r"```bibtex\n(.*?)```", text, re.DOTALL)[1]
        flat = " ".join(bibtex.split())
        assert " and ".join(names) in flat and paper["title"] in flat
        assert f"{{{paper['year']}}}" in flat and "2403.18795" in flat
