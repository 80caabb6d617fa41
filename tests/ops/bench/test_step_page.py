"""docs/step.md shows the results of the bench, and says so when a result is missing."""

import importlib.util
from pathlib import Path

import pytest

from gamba_warp.measure.suites import read_document

DOCS = Path(__file__).resolve().parents[3] / "docs"


@pytest.fixture(scope="module")
def writer():
    spec = importlib.util.spec_from_file_location("step_page", DOCS / "step_page.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_page_of_a_step_shows_the_results(writer):
    documents = read_document(writer.STEP), read_document(writer.PRECISION)
    text = writer.PAGE.read_text(encoding="utf-8")
    assert writer.page_of(text, *documents) == text, "run: python docs/step_page.py"
    fused = next(r for r in documents[0]["records"] if r["variant"] == "AdamW, fused")
    fused["ms_p50"] = 12345.0
    assert "| AdamW | 12,345 |" in writer.page_of(text, *documents)
    fused["ms_p50"] = None
    with pytest.raises(ValueError, match=r"no time of step, optimizer, AdamW, fused"):
        writer.page_of(text, *documents)
