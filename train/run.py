"""A run of ``gamba train``, from the options to the exit code."""

from __future__ import annotations

import contextlib
import hashlib
import math
import socket
import sys
from collections.abc import Mapping
from pathlib import Path

import torch

from gamba_warp.batch import EXPECTED
from gamba_warp.data.dataset import evenly
from gamba_warp.devices import precision_note
from gamba_warp.errors import UserError
from gamba_warp.files import only_process, output_folder, sweep, write_json
from gamba_warp.model.gamba import Gamba
from gamba_warp.versions import __version__, installed

from .batches import TrainingData, open_data
from .checkpoint import (
    find_checkpoint,
    find_initial,
    initial_differences,
    list_checkpoints,
    load_weights,
    step_of,
)
from .config import TrainConfig, command_line, options_of_all
from .ddp import World
from .log import RunLog, say
from .loop import Trainer
from .objective.losses import open_lpips

_COMPUTE = ("torch", "warp-lang", "numpy", "pillow", "kornia", "timm")
_PYTHON = ".".join(map(str, sys.version_info[:2]))
_PICTURES = 16  # objects whose first picture is compared between processes
_DIGESTS = 4096  # compared between processes: of one object each, or of several in a large set


def train(config: TrainConfig, world: World) -> int:
    """Train as configured on this process's device.

    Args:
        config: the options.
        world: this process among all.

    Returns:
        0; 1 if some objects could not be read; 128 + n if signal n stopped it (resumable).

    Raises:
        UserError: invalid data, options or run folder, or they differ between processes.
    """
    run, notes, started, log = config.run, [], "", None
    there = run.out.is_dir()  # a missing folder is made only after all checks
    with contextlib.ExitStack() as held:

        def claim() -> Path | None:
            if there:
                held.enter_context(only_process(run.out, "trains"))
            return find_checkpoint(run.out, run.resume, notes.append)

        with world.together():
            data = open_data(config)
            lpips, warning = open_lpips(config, world.device.type)
        world.agree(lambda: _facts(config, data, world, lpips is not None))
        checkpoint = world.on_main(claim)  # the others use its result
        if run.resume == "auto":
            _refuse_newer(world, run.out, checkpoint)
        torch.manual_seed(run.seed)
        # TF32 applies to the network's products, forward and backward; geometry has none
        # (cameras.exact_product), and SSIM's keep full precision.
        if world.device.type == "cuda":
            torch.set_float32_matmul_precision("high")
        with world.together():
            model = Gamba(config.model_config(), run.encoder_weights)
            model.recompute = run.recompute
            if run.init is not None and checkpoint is None and world.main:  # ``wrap`` sends it
                path = find_initial(run.init, notes.append)
                load_weights(path, model)
                differing = initial_differences(path, config, data.fingerprint)
                whose = "; their run is not known"
                if differing is not None:
                    others = f"other {', '.join(differing[:20])}"
                    whose = f", of a run with {others if differing else 'the same options'}"
                started = f"starts from the weights of {path}{whose}"
            model.to(world.device)
            if lpips is not None:
                lpips.to(world.device)
        trainer = Trainer(config, model, data, world, lpips)
        changed = None if checkpoint is None else trainer.restore(checkpoint)
        with world.together():  # all checks have passed: from here on files are written
            if world.main:
                output_folder(run.out / "samples")
                if not there:
                    held.enter_context(only_process(run.out, "trains"))
                    if list_checkpoints(run.out):
                        raise UserError(
                            f"{run.out}: another process has trained here meanwhile; start again"
                        )
                for folder in (run.out, run.out / "samples", run.out / "checkpoints"):
                    sweep(folder, age=0)
                log = held.enter_context(contextlib.closing(RunLog(run.out)))
        trainer.log = log
        if log is not None:
            notes = [*data.notes, *notes, *filter(None, (warning, changed))]
            _announce(trainer, log, checkpoint, notes)
            if started:
                say(started)
        code = trainer.run()
        failures = {u: why for each in world.gather(trainer.failures) for u, why in each.items()}
        if log is not None:
            _report(trainer, log, code, failures)
        return code or int(bool(failures))


def _facts(
    config: TrainConfig, data: TrainingData, world: World, lpips: bool
) -> Mapping[str, dict[str, object]]:
    """Facts that all processes must have in common, see ``World.agree``.

    For the data: a hash per object, or of several, of the cameras and, for some objects, of the
    first picture.
    """
    chosen, contents = sorted(set(data.objects)) if data.shards is None else [], {}
    read, size = evenly(chosen, _PICTURES), max(1, math.ceil(len(chosen) / _DIGESTS))
    for part in (chosen[at : at + size] for at in range(0, len(chosen), size)):
        digest = hashlib.sha256()
        for index in part:
            digest.update(data.train.digest(index).encode())
            if index in read:
                with contextlib.suppress(*EXPECTED):  # the training reports it when it matters
                    picture = data.train.load(index, [0], depths=0).images
                    digest.update(picture.numpy().tobytes())
        names = dict.fromkeys(data.train.uids[index] for index in (part[0], part[-1]))
        contents[" to ".join(names)] = digest.hexdigest()[:16]
    known = {"objects": data.fingerprint, "device": world.device.type, "LPIPS": lpips}
    return {
        "options": {**options_of_all(config.to_dict()), **known},
        "data": contents,
        "versions": {"gamba-warp": __version__, "python": _PYTHON, **installed(*_COMPUTE)},
    }


def _refuse_newer(world: World, out: Path, checkpoint: Path | None) -> None:
    """Raise if another process sees a newer checkpoint than the main one.

    Without a shared disk this happens if the processes are ranked in another order than before.
    """
    taken = -1 if checkpoint is None else step_of(checkpoint)
    seen = world.gather((socket.gethostname(), list_checkpoints(out)))
    host, known = seen[0]
    steps = {step_of(path) for path in known}
    for rank, (other, found) in enumerate(seen):
        newer = [p for p in found if step_of(p) > taken and step_of(p) not in steps]
        if newer:
            raise UserError(
                f"process {rank} on {other} sees {newer[-1]}, process 0 on {host} does not: start "
                "with that machine as the first, or give a shared folder as --out"
            )


def _announce(trainer: Trainer, log: RunLog, checkpoint: Path | None, notes: list[str]) -> None:
    """Report the setup of the run at its beginning."""
    config, data = trainer.config, trainer.data
    values = config.to_dict()
    write_json(config.run.out / "config.json", values)
    facts = {
        "objects": len(set(data.objects)),
        "held_out": len(data.held_out.objects) if data.held_out else 0,
        "split_version": data.train.split_version,
        "parameters": sum(p.numel() for p in trainer.parameters),
        "steps": trainer.total,
        "device": str(trainer.world.device),
        "precision": str(trainer.precision).removeprefix("torch."),
        "command": command_line(values),
    }
    log.write("start", trainer.step, config=values, resumed_from=str(checkpoint or ""), **facts)
    say(
        f"{facts['objects']} objects, {facts['parameters'] / 1e6:.1f} M parameters, "
        f"{trainer.schedule}, {facts['device']}, products in {facts['precision']} -> "
        f"{config.run.out}"
    )
    width, device = trainer.model.config.width, trainer.world.device
    for note in filter(None, [*notes, precision_note(config.optim.precision, device, width)]):
        log.warn(trainer.step, note)
    if checkpoint is not None:
        say(f"resumed {checkpoint} at step {trainer.step}")


def _report(trainer: Trainer, log: RunLog, code: int, failures: dict[str, str]) -> None:
    """Report at the end the failures of all processes."""
    memory = {}
    if trainer.world.device.type == "cuda":
        memory = {"device_memory": torch.cuda.max_memory_allocated(trainer.world.device)}
    log.write("end", trainer.step, code=code, skipped=trainer.skipped, failures=failures, **memory)
    if trainer.skipped:
        say(f"{trainer.skipped} of {trainer.step} steps were skipped: not finite")
    for uid, reason in failures.items():
        say(f"could not read {uid}: {reason}", sys.stderr)
    if code > 128:
        say(f"stopped by a signal at step {trainer.step}; the same command resumes from here")
    elif code == 0:
        say(f"wrote {trainer.config.run.out / 'model.safetensors'}")
