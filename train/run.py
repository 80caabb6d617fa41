"""One run of ``gamba train``, from the options to the exit code."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable
from pathlib import Path

import torch

from gamba_warp.errors import UserError
from gamba_warp.files import only_process, output_folder, sweep, write_json
from gamba_warp.model.gamba import Gamba

from .batches import TrainingData, kept_on, open_data
from .checkpoint import (
    find_checkpoint,
    find_initial,
    initial_differences,
    list_checkpoints,
    load_weights,
)
from .config import TrainConfig, command_line
from .ddp import World
from .log import RunLog, say
from .loop import Trainer
from .objective.losses import open_lpips


def train(config: TrainConfig, world: World) -> int:
    """Trains as configured on this process's device.

    Args:
        config: the options.
        world: this process among all.

    Returns:
        0; 1 if some objects could not be read; 128 + n if signal n stopped it (resumable).

    Raises:
        UserError: bad data, options or run folder.
    """
    data = kept_on(world.device, config, open_data(config))
    with contextlib.ExitStack() as held:
        return _train(config, world, data, held)


def _train(
    config: TrainConfig, world: World, data: TrainingData, held: contextlib.ExitStack
) -> int:
    run = config.run
    lock = only_process(run.out, "trains")
    there = run.out.is_dir()  # one that is not there is made only when nothing is bad
    if world.main and there:
        held.enter_context(lock)
    damaged: list[str] = []
    checkpoint = find_checkpoint(run.out, run.resume, damaged.append)
    lpips, warning = open_lpips(config)
    torch.manual_seed(run.seed)
    # TF32 where there is a GPU; no effect on a CPU. It is meant for the network's products, forward
    # and backward; geometry makes none (cameras.exact_product), SSIM's keep all digits.
    torch.set_float32_matmul_precision("high")
    model = Gamba(config.model_config(), run.encoder_weights)
    model.recompute = run.recompute
    started = ""
    if run.init is not None and checkpoint is None:
        started = _load_initial(config, data, model, damaged.append)
    model.to(world.device)
    if lpips is not None:
        lpips.to(world.device)
    log = None
    if world.main:
        output_folder(run.out / "samples")
        if not there:
            held.enter_context(lock)
            if list_checkpoints(run.out):
                raise UserError(f"{run.out}: another process trained here meanwhile; start again")
        for folder in (run.out, run.out / "samples"):
            sweep(folder, age=0)
        log = RunLog(run.out, run.tensorboard)
    try:
        trainer = Trainer(config, model, data, world, log, lpips)
        notes = [*damaged, *([warning] if warning else [])]
        if checkpoint is not None:
            changed = trainer.restore(checkpoint)
            notes += [changed] if changed else []
        if log is not None:
            _announce(trainer, log, checkpoint, notes)
            if started:
                say(started)
        code = trainer.run()
        if log is not None:
            code = _report(trainer, log, code)
        return code
    finally:
        if log is not None:
            log.close()


def _load_initial(
    config: TrainConfig, data: TrainingData, model: Gamba, warn: Callable[[str], None]
) -> str:
    """Loads what ``--init`` means into the model, and returns a line about it."""
    assert config.run.init is not None
    path = find_initial(config.run.init, warn)
    load_weights(path, model)
    differing = initial_differences(path, config, data.fingerprint)
    if differing is None:
        return f"starts from the weights of {path}; of what run they are is not known"
    others = f"other {', '.join(differing[:20])}" if differing else "the same options"
    return f"starts from the weights of {path}, of a run with {others}"


def _announce(trainer: Trainer, log: RunLog, checkpoint: Path | None, notes: list[str]) -> None:
    """Says at the beginning what is trained on what, and what is missing."""
    config, data = trainer.config, trainer.data
    values = config.to_dict()
    write_json(config.run.out / "config.json", values)
    facts = {
        "objects": len(set(data.objects)),
        "held_out": len(data.held_out),
        "split_version": data.train.split_version,
        "parameters": sum(p.numel() for p in trainer.parameters),
        "steps": trainer.total,
        "device": str(trainer.world.device),
        "command": command_line(values),
    }
    log.write("start", trainer.step, config=values, resumed_from=str(checkpoint or ""), **facts)
    say(
        f"{facts['objects']} objects, {facts['parameters'] / 1e6:.1f} M parameters, "
        f"{trainer.schedule}, {facts['device']} -> {config.run.out}"
    )
    for note in [*data.notes, *notes]:
        log.warn(trainer.step, note)
    if checkpoint is not None:
        say(f"resumed {checkpoint} at step {trainer.step}")


def _report(trainer: Trainer, log: RunLog, code: int) -> int:
    """Says at the end what went wrong on the way; returns the exit code."""
    failures = trainer.failures
    log.write("end", trainer.step, code=code, skipped=trainer.skipped, failures=failures)
    log.page()
    if trainer.skipped:
        say(f"{trainer.skipped} of {trainer.step} steps were skipped: not finite")
    for uid, reason in failures.items():
        say(f"could not read {uid}: {reason}", sys.stderr)
    if code > 128:
        say(f"stopped by a signal at step {trainer.step}; the same command goes on from here")
    elif code == 0:
        say(f"wrote {trainer.config.run.out / 'model.safetensors'}")
    return code or int(bool(failures))
