"""``python -m gamba_warp.gpu_check``: the tests of a GPU, then the benchmark on it.

It needs torch, numpy, warp-lang and pytest, and no installation. Each part runs in a process of its
own with a time limit, so that a crash or an endless kernel ends that part only.
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import torch

from .files import write_json, write_text
from .kernels.bench import conv, raster, scan
from .kernels.bench.measure import Settings, measure
from .kernels.bench.report import markdown
from .measure import models

MINUTES = 10.0  # of the whole run, kernels compiled included
_FRACTION = 0.5  # of the time for the tests
_GRACE = 20.0  # seconds that an interrupted part has to write its results
_BENCH = "import sys; from gamba_warp.gpu_check import bench; sys.exit(bench(*sys.argv[1:]))"
ROOT = Path(__file__).resolve().parents[1]


def test_files() -> list[Path]:
    """Return the files with tests for a GPU, of those that need no other packages."""
    files = (
        path for name in ("gpu", "ops", "ptx") for path in ROOT.glob(f"tests/{name}/**/test_*.py")
    )
    return [
        path for path in sorted(files) if "@pytest.mark.gpu" in path.read_text(encoding="utf-8")
    ]


def bench(device: str, folder: str) -> int:
    """Run the benchmark, and write bench.json and bench.md after every table.

    Returns:
        1 if a result is wrong or could not be computed, else 0, also after an interrupt.
    """
    settings = Settings(torch.device(device), "quick" if device == "cpu" else "normal")
    tables = conv.tables(settings)
    if device == "cuda":
        made = [table for suite in (models, raster, scan) for table in suite.tables(settings)]
        # the model's image needs packages that the check does not ask for
        tables += [table for table in made if (table.op, table.name) != ("model", "skipping")]
    records: list[dict] = []
    for table in tables:  # a crash loses only the current one
        document = measure([table], settings)
        records += document["records"]
        document["records"] = records
        write_json(Path(folder, "bench.json"), document)
        write_text(Path(folder, "bench.md"), markdown(document))
        if document["interrupted"]:
            break
    failed = [r for r in records if r["status"].startswith(("failed", "check"))]
    for r in failed:
        print(f"{r['op']}: {r['case']}: {r['variant']}, {r['direction']}: {r['status']}")
    return int(bool(failed))


def run_part(name: str, words: Sequence[str], log: Path, seconds: float) -> bool:
    """Run Python with arguments in a group of processes, and print how it ends.

    Args:
        name: of the part.
        words: arguments of Python.
        log: file for the output, of which the last lines are printed.
        seconds: time limit; then the part is interrupted, and killed ``_GRACE`` seconds later.

    Returns:
        True if it passes.
    """
    how = ""
    with open(log, "wb") as output:
        command = [sys.executable, *words]
        process = subprocess.Popen(
            command, cwd=ROOT, stdout=output, stderr=output, start_new_session=True
        )
        try:
            process.wait(seconds)
        except subprocess.TimeoutExpired:
            how = f"stopped after {seconds:.0f} s, "
            process.send_signal(signal.SIGINT)
            with suppress(subprocess.TimeoutExpired):
                process.wait(_GRACE)
        finally:  # with the processes that it started
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            code = process.wait()
    why = f"signal {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"
    how += "passed" if code == 0 else f"failed with {why}"
    lines = log.read_text(encoding="utf-8", errors="replace").splitlines()
    print("\n".join([*(f"  {line}" for line in lines[-20:]), f"{name}: {how} ({log})"]), flush=True)
    return code == 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Run both parts; return 0 if both pass, 1 if not, 2 without a GPU or for a bad option."""
    parser = argparse.ArgumentParser(prog="python -m gamba_warp.gpu_check", description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out/gpu-check"), help="folder")
    parser.add_argument("--minutes", type=float, default=MINUTES, help="time limit of the run")
    parser.add_argument("--device", choices=("cuda", "cpu"), default="cuda", help="cpu: a dry run")
    o = parser.parse_args(arguments)
    problem = ""
    if not 0 < o.minutes < float("inf"):
        problem = f"--minutes {o.minutes}: must be above 0"
    elif o.device == "cuda" and not torch.cuda.is_available():
        problem = "no CUDA device; --device cpu tries the command itself"
    if problem:
        print(f"gpu_check: {problem}", file=sys.stderr)
        return 2
    out = o.out.absolute()
    out.mkdir(parents=True, exist_ok=True)
    ends, passed = time.monotonic() + 60 * o.minutes, True
    if files := test_files():
        words = ["-m", "pytest", "-m", "gpu", *map(str, files)]
        passed &= run_part("tests", words, out / "tests.txt", 60 * o.minutes * _FRACTION)
    else:
        print("tests: not run, because they are only in a checkout")
    words = ["-c", _BENCH, o.device, str(out)]
    left = max(ends - time.monotonic() - _GRACE, 1.0)
    passed &= run_part("bench", words, out / "bench.txt", left)
    return int(not passed)


if __name__ == "__main__":
    sys.exit(main())
