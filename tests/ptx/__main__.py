"""``PYTHONPATH=tests python -m ptx stress scan``: a gamba command, its CUDA launches from PTX."""

import sys

from gamba_warp.cli import run

from .launch import interpreted

with interpreted(seed=1) as machine:
    code = run(sys.argv[1], [*sys.argv[2:], "--device", "cpu", "--threads", "1"])
print(f"from PTX: {len(machine.trace)} launches, {machine.steps} instructions of warps")
print(*machine.findings, sep="\n")
sys.exit(code or bool(machine.findings))
