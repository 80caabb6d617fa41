"""``gamba stress``: random and hostile cases, each against float64."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated

import tyro
from msgspec import Meta

from ..conventions import DeviceChoice
from ..devices import pick_device
from ..files import output_folder
from ..untrusted.ranges import Minutes, Seed, Threads, ranged

_MINUTES = 1.0


@ranged
def stress_command(
    what: tyro.conf.Positional[Annotated[tuple[str, ...], tyro.conf.arg(metavar="WHAT ...")]] = (
        "all",
    ),
    *,
    seed: Seed = 0,
    minutes: Minutes | None = None,
    cases: Annotated[int, Meta(ge=1)] | None = None,
    device: DeviceChoice = "auto",
    threads: Threads | None = None,
    out: Path = Path("out/stress"),
    shrink_seconds: Annotated[float, Meta(ge=0, le=86_400)] = 30.0,
    replay: tuple[Path, ...] = (),
) -> int:
    """Runs random and hostile cases of the kernels and the model, each against float64.

    Forward results and all gradients; a failing case is made small and written to a file that
    --replay runs again. Writes stress.json and stress.md. Ctrl-C keeps what was found.

    Args:
        what: scan (with the convolution), raster, model, or all (of these).
        seed: The same seed gives the same cases in the same order.
        minutes: Time limit; 1 if not given, or none with --cases.
        cases: Number of cases; as many as fit in --minutes if not given.
        device: Device of the kernels; auto is the GPU if there is one.
        threads: Number of CPU threads; torch's own number if not given.
        out: Folder for the summary and the failing cases.
        shrink_seconds: Time limit for making one failing case small.
        replay: Run only these files of failing cases.
    """
    import torch

    from ..measure import stress_run

    chosen = pick_device(device)
    if threads is not None:
        torch.set_num_threads(threads)
    if replay:
        code = 0
        for passes, text in stress_run.replay(replay, chosen):
            print(text)
            code = code if passes else 1
        return code
    endless = minutes is None and cases is not None
    ops = stress_run.choose_ops(what)
    run = stress_run.StressRun(ops, chosen, output_folder(out), seed, shrink_seconds)
    run.run(cases, math.inf if endless else 60 * (minutes or _MINUTES))
    run.write()
    print(f"{run.summary()}; wrote {out / 'stress.json'}")
    if run.about["interrupted"]:
        print("interrupted; what was found is kept")
        return 130
    return 1 if run.failures else 0
