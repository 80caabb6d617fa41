"""docs/architecture.md matches the code."""

import re
from pathlib import Path

from architecture.__main__ import page
from architecture.imports import read_imports

DOCS = Path(__file__).resolve().parents[2] / "docs"


def test_the_table_is_fresh():
    text = (DOCS / "architecture.md").read_text()
    assert text == page(text, read_imports(DOCS.parent)), "run make architecture"


def test_every_path_of_the_page_exists():
    """Check every file and folder that the page names in code quotes."""
    text = (DOCS / "architecture.md").read_text()
    paths = re.findall(r"`((?:kernels|gamba_warp|train|eval|tests|docs)/[\w./-]*)`", text)
    assert len(paths) > 30
    missing = [path for path in paths if not (DOCS.parent / path).exists()]
    assert not missing
