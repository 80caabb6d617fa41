"""Benchmark of the loader, on made-up views and on those of a folder."""

import pytest
import torch
from helpers import micro
from lab.studies import StudySettings, loader

from gamba_warp.kernels.bench.core.measure import measure


@pytest.mark.parametrize("given", [False, True])
def test_the_loader_is_measured(tmp_path, given):
    data = micro.write_dataset(tmp_path / "clouds") if given else None
    settings = StudySettings(device=torch.device("cpu"), level="quick", data=data)
    records = measure(loader.cases(settings), settings)["records"]
    assert [r["status"] for r in records] == ["ok"] * 4, records
    names = [r["variant"] for r in records]
    assert names == ["files", "files, --cache", "shards", "shards, --cache-device"]
    assert all(r["work"]["samples"] == 8 for r in records)
    assert all(r["work"]["cpu_ms_per_sample"] > 0 for r in records)
