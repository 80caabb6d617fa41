"""Each barrier of the kernels, left out, is reported: all are needed, and none would go unseen."""

import pytest
import torch
from helpers import raster as rasters
from helpers import scan as scans

from gamba_warp.kernels.rasterize import rasterization
from gamba_warp.kernels.selective_scan import selective_scan
from gamba_warp.kernels.selective_scan.cuda import launch as scan_cuda
from gamba_warp.kernels.selective_scan.cuda.launch import Tuning

from .launch import interpreted
from .machine import opcodes


def scan(states):
    """Both directions, in segments."""
    mine = scans.leaves(scans.make(1, 140, 5, states))
    out, last = selective_scan(**mine, delta_softplus=True, return_last_state=True)
    torch.autograd.grad(out.sum() + last.sum(), [*mine.values()])


def image():
    """Both directions."""
    mine = rasters.leaves(rasters.crowded(), torch.float32)
    renders, alphas, _ = rasterization(**mine)
    (renders.square().sum() + alphas.sum()).backward()


CASES = {
    "scan": (lambda: scan(16), 132),
    "scan of many states": (lambda: scan(70), 132),
    "image": (image, 0),
    "image of tiles in quarters": (image, 132),
}


@pytest.mark.parametrize("name", CASES)
def test_every_barrier_is_needed(monkeypatch, name):
    monkeypatch.setattr(scan_cuda, "choose", lambda *_: Tuning(segments=3, back_segments=2))
    function, multiprocessors = CASES[name]

    def findings(seed=0):
        torch.manual_seed(0)
        with interpreted(multiprocessors, seed=seed) as machine:
            function()
        return machine

    whole, unseen, tried = findings(), [], 0
    assert not whole.findings
    for program, executed in whole.executed.values():
        for at, text in enumerate(program.text):
            if not executed[at] or not text.startswith("bar."):
                continue
            instruction = program.code[at]
            was = instruction.op, instruction.reads, instruction.target
            instruction.op, instruction.reads, instruction.target = opcodes()["bra"][0], 0, at + 1
            tried += 1
            if not any(findings(seed).findings for seed in (0, 1, 2)):
                unseen.append(f"{program.name}: {at} {text}")
            instruction.op, instruction.reads, instruction.target = was
    assert tried and not unseen, f"of {tried}, nothing is found without {unseen}"
