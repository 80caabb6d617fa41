"""docs/lab/step.md shows the results of the bench, and says so when a result is missing."""

import pytest
from lab.figures import step as writer

from gamba_warp.measure.suites import read_document


def test_the_page_of_a_step_shows_the_results():
    documents = read_document(writer.STEP), read_document(writer.PRECISION)
    text = writer.PAGE.read_text(encoding="utf-8")
    assert writer.page_of(text, *documents) == text, "run: make figures"
    fused = next(r for r in documents[0]["records"] if r["variant"] == "AdamW, fused")
    fused["ms_p50"] = 12345.0
    assert "| AdamW | 12,345 |" in writer.page_of(text, *documents)
    fused["ms_p50"] = None
    with pytest.raises(ValueError, match=r"no time of step, optimizer, AdamW, fused"):
        writer.page_of(text, *documents)
