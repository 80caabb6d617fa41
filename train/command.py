"""``gamba train``, also ``python -m gamba_warp.train`` and ``torchrun -m gamba_warp.train``."""

from __future__ import annotations

import sys

import torch
import tyro

from gamba_warp.errors import UserError
from gamba_warp.files import output_folder, write_json
from gamba_warp.model.gamba import Gamba

from .batches import open_data, open_lpips
from .checkpoint import find_checkpoint, load_weights
from .config import TrainConfig
from .ddp import World, world
from .log import RunLog
from .loop import Trainer


def train(config: TrainConfig, place: World) -> int:
    """Trains as configured on this process's device.

    Returns:
        0; 1 if some objects could not be read; 128 + n if signal n stopped it (resumable).

    Raises:
        UserError: bad data, options or run folder.
    """
    run = config.run
    data = open_data(config)
    checkpoint = find_checkpoint(run.out, run.resume)
    lpips, warning = open_lpips(config)
    torch.manual_seed(run.seed)
    torch.set_float32_matmul_precision("high")  # TF32 where there is a GPU; no effect on a CPU
    model = Gamba(config.model_config(), run.encoder_weights)
    model.recompute = run.recompute
    if run.init is not None and checkpoint is None:
        load_weights(run.init, model)
    model.to(place.device)
    if lpips is not None:
        lpips.to(place.device)
    log = None
    if place.main:
        output_folder(run.out / "samples")
        log = RunLog(run.out, run.tensorboard)
    try:
        trainer = Trainer(config, model, data, place, log, lpips)
        if checkpoint is not None:
            trainer.restore(checkpoint)
        if log is not None:
            _announce(trainer, checkpoint, warning)
        code = trainer.run()
        if log is not None:
            code = _report(trainer, code)
        return code
    finally:
        if log is not None:
            log.close()


def _announce(trainer: Trainer, checkpoint: object, warning: str | None) -> None:
    config, log, data = trainer.config, trainer.log, trainer.data
    write_json(config.run.out / "config.json", config.to_dict())
    log.write("start", trainer.step, config=config.to_dict(), resumed_from=str(checkpoint or ""))
    parameters = sum(p.numel() for p in trainer.parameters)
    length = f"{trainer.total} steps" if trainer.total else f"{config.length.minutes} minutes"
    print(
        f"{len(set(data.objects))} objects, {parameters / 1e6:.1f} M parameters, {length}, "
        f"{trainer.world.device} -> {config.run.out}"
    )
    for note in [*data.notes, *([warning] if warning else [])]:
        log.warn(trainer.step, note)
    if checkpoint is not None:
        print(f"resumed {checkpoint} at step {trainer.step}")


def _report(trainer: Trainer, code: int) -> int:
    """Says at the end what went wrong on the way; returns the exit code."""
    failures, log = trainer.failures, trainer.log
    log.write("end", trainer.step, code=code, skipped=trainer.skipped, failures=failures)
    if trainer.skipped:
        print(f"{trainer.skipped} of {trainer.step} steps were skipped: not finite")
    for uid, reason in failures.items():
        print(f"could not read {uid}: {reason}", file=sys.stderr)
    if code > 128:
        print(f"stopped by a signal at step {trainer.step}; the same command goes on from here")
    elif code == 0:
        print(f"wrote {trainer.config.run.out / 'model.safetensors'}")
    return code or int(bool(failures))


def train_command(config: tyro.conf.OmitArgPrefixes[TrainConfig]) -> int:
    """Trains a model on posed views.

    Loss, optimizer and schedules are the paper's. Writes checkpoints, log.jsonl, sample pictures
    and at the end model.safetensors into the run folder. Ctrl-C saves and stops; the same command
    goes on. Several GPUs: torchrun --nproc-per-node N -m gamba_warp.train DATA ...
    """
    if config.run.threads is not None:
        torch.set_num_threads(config.run.threads)
    with world(config.run.device) as place:
        return train(config, place)


def main() -> None:
    """Entry point of ``python -m gamba_warp.train``."""
    try:
        sys.exit(tyro.cli(train_command, prog="gamba train"))
    except UserError as error:
        print(f"gamba: {error}", file=sys.stderr)
        sys.exit(2)


if __name__ == "__main__":
    main()
