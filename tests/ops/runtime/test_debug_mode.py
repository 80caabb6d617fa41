"""Warp's debug mode, in which ``make debug`` runs the operators' tests."""

import os
import sys
from pathlib import Path

from helpers.children import ran

PROGRAM = """
import ops.debug_mode, torch
import warp as wp
from gamba_warp.kernels.runtime.views import view
from helpers.kernels import plain_kernel
x, y = torch.zeros(2, 8)
for room in (7, 6):
    wp.launch(plain_kernel, 7, [view(x[:7]), view(y[:room])], device="cpu")
    print("room for", room, flush=True)
"""


def test_a_write_past_the_end_of_an_array_ends_the_process():
    tests = Path(__file__).parents[2]
    environment = {**os.environ, "PYTHONPATH": str(tests)}
    done = ran(sys.executable, "-c", PROGRAM, env=environment)
    assert done.stdout.endswith("room for 7\n"), done.stdout + done.stderr
    assert done.returncode < 0 and "i < arr.shape[0]" in done.stderr
