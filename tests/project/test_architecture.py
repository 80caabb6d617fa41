"""docs/architecture.md matches the code."""

import re
from pathlib import Path

import pytest
from architecture.__main__ import page, picture
from architecture.imports import read_imports
from architecture.packages import PACKAGES, edges
from architecture.picture import BOXES, FLOORS, arrows, box_of

DOCS = Path(__file__).resolve().parents[2] / "docs"
AGAIN = "run make architecture"


@pytest.fixture(scope="module")
def entries():
    """All imports of the checkout."""
    return read_imports(DOCS.parent)


def test_the_picture_is_fresh(entries):
    assert (DOCS / "architecture.svg").read_text() == picture(entries), AGAIN


def test_the_table_is_fresh(entries):
    text = (DOCS / "architecture.md").read_text()
    assert text == page(text, entries), AGAIN


def test_every_package_is_drawn():
    assert {box_of(package) for package in PACKAGES} - {"versions"} == set(BOXES)
    assert all(0 <= box.floor < FLOORS for box in BOXES.values())


def test_every_arrow_goes_down(entries):
    graph = edges(entries, by_package=True)
    for here, there in arrows(graph, graph):
        assert BOXES[here].floor > BOXES[there].floor, f"{here} to {there}"


def test_arrows_that_follow_from_others_are_left_out():
    drawn = arrows({"pages": {"model"}}, {"pages": {"model", "data"}, "model": {"data", "core"}})
    later = {("pages", "model"): False, ("model", "data"): True, ("model", "core"): True}
    assert drawn == later


def test_every_path_of_the_page_exists():
    """Check every file and folder that the page names in code quotes."""
    text = (DOCS / "architecture.md").read_text()
    paths = re.findall(r"`((?:kernels|gamba_warp|train|eval|tests|docs)/[\w./-]*)`", text)
    assert len(paths) > 30
    missing = [path for path in paths if not (DOCS.parent / path).exists()]
    assert not missing
