"""Slurm script and count of operations of docs/train-your-own.md."""

import os
import re
import subprocess
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
SCRIPT = ROOT / "docs" / "examples" / "slurm.sh"
ARRAY = SCRIPT.with_name("slurm_array.sh")
PAGE = (ROOT / "docs" / "train-your-own.md").read_text(encoding="utf-8")


def slurm(folder, *arguments, script=SCRIPT, **more):
    """Run a script with stand-ins for scontrol and srun that print their arguments."""
    for name, text in (("scontrol", "printf 'node7\\nnode8\\n'"), ("srun", 'printf "%s\\n" "$@"')):
        (folder / name).write_text(f"#!/bin/bash\n{text}\n")
        (folder / name).chmod(0o755)
    place = {"PATH": f"{folder}:{os.environ['PATH']}", "SLURM_JOB_ID": "41234"}
    place |= {"SLURM_JOB_NODELIST": "node[7-8]", "SLURM_NNODES": "2", **more}
    command = ["bash", str(script), *arguments]
    return subprocess.run(command, env=place, capture_output=True, text=True, timeout=60)


def test_the_slurm_script_starts_torchrun_on_each_machine(tmp_path):
    done = slurm(tmp_path, "my data", "my run", "--lr", "0.002")
    assert done.returncode == 0, done.stderr
    words = done.stdout.splitlines()
    assert words[:2] == ["--kill-on-bad-exit=1", "torchrun"] and words[-2:] == ["--lr", "0.002"]
    own = words[words.index("gamba_warp.train") + 1 :]
    assert own[:3] == ["my data", "--out", "my run"]
    for name, value in (("--nnodes", "2"), ("--rdzv-endpoint", "node7:21234")):
        assert words[words.index(name) + 1] == value
    # The page's own command has the same options.
    shown = re.search(r"torchrun --nnodes 2.*?```", PAGE, re.DOTALL)
    assert shown
    for word in own[3:-2]:
        assert word in shown[0].split(), word
    missing = slurm(tmp_path, "my data")
    assert missing.returncode == 2 and missing.stderr.startswith("usage:")


def test_the_tasks_of_an_array_take_their_parts(tmp_path):
    task = {"script": ARRAY, "SLURM_ARRAY_TASK_ID": "3", "SLURM_ARRAY_TASK_COUNT": "16"}
    done = slurm(tmp_path, "data", "render", "my meshes", "--out", "DATA", **task)
    wanted = ["gamba", "data", "render", "my meshes", "--out", "DATA", "--shard", "3/16"]
    assert done.stdout.splitlines() == wanted, done.stderr
    task |= {"SLURM_ARRAY_TASK_COUNT": "1", "PARTS": "8"}  # one task again, of eight
    done = slurm(tmp_path, "data", "render", "MESHES", "--out", "DATA", **task)
    assert done.stdout.split()[1:] == "data render MESHES --out DATA --shard 3/8".split()
    assert slurm(tmp_path, "data", **task).returncode == 2
