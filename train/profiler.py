"""``--profile``: torch's profiler over ten steps of a run."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import torch

from gamba_warp.files import atomic_path, output_folder, write_text

WARM_STEPS, STEPS = 3, 10  # steps before the profile, which compile kernels, and in it


@contextmanager
def profiled(folder: Path, device: torch.device) -> Iterator[Callable[[], None]]:
    """Profile the steps after the first ``WARM_STEPS``, at most ``STEPS``.

    Args:
        folder: of ``trace.json``, which ``chrome://tracing`` and Perfetto show, and ``table.txt``,
            the operators by their own time.
        device: the training device.

    Yields:
        A function to call after each step.

    Raises:
        UserError: a file cannot be written.
    """
    from torch.profiler import ProfilerActivity, profile, schedule

    def write(found: profile) -> None:
        output_folder(folder)
        with atomic_path(folder / "trace.json") as temporary:
            found.export_chrome_trace(str(temporary))
        averages = found.key_averages()
        known = dir(averages[0]) if len(averages) else []
        order = "self_device_time_total" if device.type == "cuda" else "self_cpu_time_total"
        table = averages.table(order if order in known else None, row_limit=-1)
        write_text(folder / "table.txt", table + "\n")

    activities = [ProfilerActivity.CPU]
    if device.type == "cuda":
        activities.append(ProfilerActivity.CUDA)
    plan = schedule(wait=0, warmup=WARM_STEPS, active=STEPS, repeat=1)
    with profile(activities=activities, schedule=plan, on_trace_ready=write) as running:
        yield running.step
