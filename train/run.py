"""Beginning and end of a run: what its processes have in common, its folder, and its messages."""

from __future__ import annotations

import contextlib
import socket
import sys
from collections.abc import Callable, Mapping
from pathlib import Path

import torch

from gamba_warp.devices import precision_note
from gamba_warp.errors import UserError
from gamba_warp.files import only_process, output_folder, sweep, write_json
from gamba_warp.versions import __version__, installed

from .checkpoint import RunState, Setup, find_checkpoint, list_checkpoints, step_of
from .config import command_line, options_of_all
from .ddp import World
from .log import NoLog, RunLog, say

_COMPUTE = ("torch", "warp-lang", "numpy", "pillow", "kornia", "timm")
_PYTHON = ".".join(map(str, sys.version_info[:2]))


def facts_of(setup: Setup, lpips: bool) -> Mapping[str, dict[str, object]]:
    """Return the facts that all processes must have in common, see ``World.agree``."""
    config, data, world = setup
    known = {"objects": data.fingerprint, "device": world.device.type, "LPIPS": lpips}
    return {
        "options": {**options_of_all(config.to_dict()), **known},
        "data": {**data.digests},
        "versions": {"gamba-warp": __version__, "python": _PYTHON, **installed(*_COMPUTE)},
    }


class RunFolder(contextlib.ExitStack):
    """Run folder of a single trainer; a missing one is made by ``open_log``, after all checks."""

    def __init__(self, path: Path, world: World) -> None:
        super().__init__()
        self.path, self.world, self._existed = path, world, path.is_dir()

    def find_checkpoint(self, resume: str, warn: Callable[[str], None]) -> Path | None:
        """Find the checkpoint of ``--resume``, the same on all processes; lock the folder.

        Raises:
            UserError: as ``checkpoint.find_checkpoint``, or another process trains here, or one of
                this run sees a newer checkpoint. Without a shared disk this happens if the
                processes are ranked in another order than before.
        """

        def find() -> Path | None:
            if self._existed:
                self.enter_context(only_process(self.path, "trains"))
            return find_checkpoint(self.path, resume, warn)

        checkpoint = self.world.broadcast_from_main(find)
        if resume != "auto":
            return checkpoint
        taken = -1 if checkpoint is None else step_of(checkpoint)
        seen = self.world.gather((socket.gethostname(), list_checkpoints(self.path)))
        host, known = seen[0]
        steps = {step_of(path) for path in known}
        for rank, (other, paths) in enumerate(seen):
            newer = [p for p in paths if step_of(p) > taken and step_of(p) not in steps]
            if newer:
                raise UserError(
                    f"process {rank} on {other} sees {newer[-1]}, process 0 on {host} does not: "
                    "start with that machine as the first, or give a shared folder as --out"
                )
        return checkpoint

    def open_log(self) -> RunLog:
        """Make and lock the folder on the main process, and open the log.

        Raises:
            UserError: it cannot be written, or another process has begun to train here.
        """
        with self.world.raise_on_all():
            if not self.world.main:
                return NoLog()
            output_folder(self.path / "samples")
            if not self._existed:
                self.enter_context(only_process(self.path, "trains"))
                if list_checkpoints(self.path):
                    raise UserError(f"{self.path}: the run folder is in use; start again")
            for folder in (self.path, self.path / "samples", self.path / "checkpoints"):
                sweep(folder, age=0)
            return self.enter_context(contextlib.closing(RunLog(self.path)))


def announce(
    setup: Setup,
    state: RunState,
    log: RunLog,
    precision: torch.dtype,
    checkpoint: Path | None,
    notes: list[str],
) -> None:
    """Report the setup of a run at its beginning.

    Args:
        setup: of the run.
        state: of the run.
        log: of the run.
        precision: of the network's products.
        checkpoint: the one that the run resumes, or None.
        notes: lines for the user.
    """
    config, data, world = setup
    if not world.main:
        return
    values = config.to_dict()
    write_json(config.run.out / "config.json", values)
    groups = state.optimizer.param_groups
    facts = {
        "objects": len(set(data.objects)),
        "held_out": len(data.held_out.objects) if data.held_out else 0,
        "split_version": data.train.split_version,
        "parameters": sum(p.numel() for group in groups for p in group["params"]),
        "steps": state.schedule.total,
        "device": str(world.device),
        "precision": str(precision).removeprefix("torch."),
        "command": command_line(values),
    }
    log.write("start", state.step, config=values, resumed_from=str(checkpoint or ""), **facts)
    say(
        f"{facts['objects']} objects, {facts['parameters'] / 1e6:.1f} M parameters, "
        f"{state.schedule}, {facts['device']}, products in {facts['precision']} -> "
        f"{config.run.out}"
    )
    width = state.model.config.width
    slow = precision_note(config.optim.precision, world.device, width)
    for note in filter(None, [*notes, slow]):
        log.warn(state.step, note)
    if checkpoint is not None:
        say(f"resumed {checkpoint} at step {state.step}")


def report(setup: Setup, state: RunState, log: RunLog, stop: int, failures: dict[str, str]) -> None:
    """Report the end of a run, by the signal ``stop`` or 0, with the failures of all processes."""
    if not setup.world.main:
        return
    memory = {}
    if setup.world.device.type == "cuda":
        memory = {"device_memory": torch.cuda.max_memory_allocated(setup.world.device)}
    code = 128 + stop if stop else 0
    log.write("end", state.step, code=code, skipped=state.skipped, failures=failures, **memory)
    if state.skipped:
        say(f"{state.skipped} of {state.step} steps were skipped: not finite")
    for uid, reason in failures.items():
        say(f"could not read {uid}: {reason}", sys.stderr)
    if stop:
        say(f"stopped by a signal at step {state.step}; the same command resumes from here")
    else:
        say(f"wrote {setup.config.run.out / 'model.safetensors'}")
