"""docs/kernels-alone.md shows the results of the study, and the study gives what the page needs."""

import torch
from lab.figures import times as writer
from lab.studies import times

from gamba_warp.kernels.bench.core.case import Settings
from gamba_warp.measure.suites import read_document


def test_the_page_shows_the_results():
    document = read_document(writer.TIMES)
    text = writer.PAGE.read_text(encoding="utf-8")
    assert writer.page_of(text, document) == text, "run: make figures"
    first = next(r for r in document["records"] if r["variant"] == "float32")
    first["ms_p50"] = 12345.0
    assert "| float32 | 12,345 |" in writer.page_of(text, document)


def test_the_study_times_both_dtypes_beside_others():
    (case,) = times.cases(Settings(torch.device("cpu"), "quick"))
    made = [(v.name, v.direction, v.peer) for v in case.build()]
    assert [name for name, direction, peer in made if not peer] == ["float32"] * 2 + [
        "bfloat16"
    ] * 2
    assert {name for name, _, peer in made if peer} == {"torch loop", "mambapy"}
