"""``python -m tests.gpu.check``: the tests of a GPU, then the benchmark on it.

It needs torch, numpy, warp-lang and pytest, and no installation. Each part runs in a process of its
own with a time limit, so that a crash or an endless kernel ends that part only.
"""

import argparse
import subprocess
import sys
from pathlib import Path

import torch

from gamba_warp.files import write_json, write_text
from gamba_warp.kernels.bench import conv, raster, scan
from gamba_warp.kernels.bench.measure import Settings, measure
from gamba_warp.kernels.bench.report import markdown
from gamba_warp.measure import models

ROOT = Path(__file__).resolve().parents[2]
BENCH = "import sys; from tests.gpu.check import bench; sys.exit(bench(*sys.argv[1:]))"


def test_files():
    """Return the files with tests for a GPU, of those that need no other packages."""
    files = (f for name in ("gpu", "ops", "ptx") for f in ROOT.glob(f"tests/{name}/**/test_*.py"))
    return [f for f in sorted(files) if "@pytest.mark.gpu" in f.read_text(encoding="utf-8")]


def bench(device, folder):
    """Run the benchmark, and write bench.json and bench.md after every case, for a crash.

    Returns 1 if a result is wrong or could not be computed, else 0, also after an interrupt.
    """
    settings = Settings(torch.device(device), "quick" if device == "cpu" else "normal")
    suites = (conv,) if device == "cpu" else (conv, models, raster, scan)
    records = []
    for case in (case for suite in suites for case in suite.cases(settings)):
        document = measure([case], settings)
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


def run_part(name, words, log, seconds):
    """Run Python with arguments; interrupt it at the limit, and kill it 20 s later."""
    command = ["timeout", "-s", "INT", "-k", "20", str(seconds), sys.executable, *words]
    with open(log, "wb") as output:
        code = subprocess.run(command, cwd=ROOT, stdout=output, stderr=output).returncode
    lines = log.read_text(encoding="utf-8", errors="replace").splitlines()
    how = "passed" if code == 0 else f"failed with exit code {code}"
    print("\n".join([*(f"  {line}" for line in lines[-20:]), f"{name}: {how} ({log})"]), flush=True)
    return code == 0


def main():
    """Run both parts; return 0 if both pass, 1 if not, 2 without a GPU."""
    parser = argparse.ArgumentParser(prog="python -m tests.gpu.check", description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out/gpu-check"), help="folder")
    parser.add_argument("--minutes", type=float, default=10.0, help="time limit of the run")
    parser.add_argument("--device", choices=("cuda", "cpu"), default="cuda", help="cpu: a dry run")
    o = parser.parse_args()
    if o.device == "cuda" and not torch.cuda.is_available():
        print("no CUDA device; --device cpu tries the command itself", file=sys.stderr)
        return 2
    out, half = o.out.absolute(), 30 * o.minutes - 20
    out.mkdir(parents=True, exist_ok=True)
    tests = ["-m", "pytest", "-m", "gpu", *map(str, test_files())]
    passed = [
        run_part("tests", tests, out / "tests.txt", half),
        run_part("bench", ["-c", BENCH, o.device, out], out / "bench.txt", half),
    ]
    return int(not all(passed))


if __name__ == "__main__":
    sys.exit(main())
