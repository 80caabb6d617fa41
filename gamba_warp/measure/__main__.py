"""``python -m gamba_warp.measure``: the benchmark of ``make gpu``, which needs only torch and Warp.

Writes bench.json and bench.md into out/gpu after every table. Exit code 1 if a result is wrong or
could not be computed.
"""

import sys
from pathlib import Path

import torch

from ..files import write_json, write_text
from ..kernels.bench import conv, raster, scan
from ..kernels.bench.measure import Settings, measure
from ..kernels.bench.report import failures, markdown
from . import models


def main(device: str = "cuda", out: str = "out/gpu") -> int:
    """Measure convolution, models, rasterizer and scan; on a CPU, to try it, the first alone."""
    settings = Settings(torch.device(device), "quick" if device == "cpu" else "normal")
    suites = (conv,) if device == "cpu" else (conv, models, raster, scan)
    folder, document = Path(out), {"records": []}
    folder.mkdir(parents=True, exist_ok=True)
    for table in (table for suite in suites for table in suite.tables(settings)):
        if table.build is models.skipping:  # reads an image, which needs more packages
            continue
        before = document["records"]
        document = measure([table], settings)
        document["records"][:0] = before
        write_json(folder / "bench.json", document)
        write_text(folder / "bench.md", markdown(document))
        if document["interrupted"]:
            break
    lines = failures(document)
    print("\n".join([*lines, f"wrote {folder / 'bench.json'} and bench.md"]))
    return int(bool(lines))


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
