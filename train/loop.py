"""Training: ``train`` is a run of ``gamba train`` from the options to the exit code."""

from __future__ import annotations

import contextlib
import math
import time
from collections import deque
from functools import partial

import torch
from torch import Tensor

from gamba_warp.errors import UserError
from gamba_warp.model.checkpoint import save_model
from gamba_warp.model.gamba import Gamba
from gamba_warp.processes import stop_requests

from .batches import Batches, open_data
from .checkpoint import RunState, Setup, find_initial, load_weights
from .config import TrainConfig
from .data.shards import Unreachable
from .ddp import World
from .graphs import open_graphs
from .log import RunLog, run_bar, say
from .objective.losses import Progress, open_lpips, term_weights
from .optim import novel_views
from .run import RunFolder, announce, facts_of, report
from .step import Objective, collapse_reason, make_step, means
from .validation import Validator

MAX_SKIPPED = 20  # a run ends after so many steps in a row that are not finite


def train(config: TrainConfig, world: World) -> int:
    """Train as configured on this process's device.

    Args:
        config: the options.
        world: this process among all.

    Returns:
        0; 1 if some objects could not be read; 128 + n if signal n stopped it (resumable).

    Raises:
        UserError: invalid data, options or run folder, or they differ between processes; or too
            many steps in a row are not finite.
    """
    run, views, minutes = config.run, config.views, config.length.minutes
    on_gpu, notes = world.device.type == "cuda", []
    with RunFolder(run.out, world) as folder:
        # Data, model, optimizer: nothing is written until all checks have passed.
        with world.raise_on_all():
            data = open_data(config)
            lpips, warning = open_lpips(config, world.device.type)
        setup = Setup(config, data, world)
        world.check_consistent(lambda: facts_of(setup, lpips is not None))
        checkpoint = folder.find_checkpoint(run.resume, notes.append)
        torch.manual_seed(run.seed)
        # TF32 applies to the network's products, forward and backward; geometry has none
        # (cameras.exact_product), and SSIM's keep full precision.
        if on_gpu:
            torch.set_float32_matmul_precision("high")
        initial = None
        with world.raise_on_all():
            model = Gamba(config.model_config(), run.encoder_weights)
            model.checkpointing = run.activation_checkpointing
            if run.init is not None and checkpoint is None and world.main:  # ``wrap`` sends it
                initial = find_initial(run.init, notes.append)
                load_weights(initial, model)
            model.to(world.device)
            if lpips is not None:
                lpips.to(world.device)
        state = RunState.begin(model, setup)
        parts = world.wrap(model), state.optimizer, state.ema
        precision = world.precision(config.optim.precision, model.config.width)
        objective = Objective({}, lpips, config.loss.lpips_crop, precision)
        graphs = open_graphs(config, world, state.optimizer)
        run_step = make_step(*parts, objective, views.accumulate, graphs)
        changed = None if checkpoint is None else state.restore(checkpoint, setup)
        schedule, total = state.schedule, state.schedule.total
        log = folder.open_log()
        notes = [*data.notes, *notes, *filter(None, (warning, changed))]
        announce(setup, state, log, precision, checkpoint, notes)
        if initial is not None:
            say(f"starts from the weights of {initial}")
        outcomes, validator = Outcomes(state, world, log), Validator(config, data, lpips, log)

        def novel(number: int) -> int:
            """Return the number of novel views of a batch."""
            if views.views_per_object is not None:
                return views.views_per_object
            return novel_views(schedule.progress(number // views.accumulate, state.elapsed))

        last = None if total is None else total * views.accumulate
        batches = Batches(data, config, world, novel, last)

        # Steps, until the end, the time limit or a signal.
        model.train()
        bar = run_bar(total, minutes, state.step, state.elapsed / 60, world.main)
        first, began, collapsed = state.step, time.monotonic() - state.elapsed, False
        saved = state.elapsed
        stops = stop_requests(insist=True)
        with stops as received, contextlib.closing(bar), contextlib.closing(batches):
            while True:
                # Elapsed seconds and signal are the same on all processes.
                signals = float(received[0] if received else 0), float(bool(received))
                clock = (time.monotonic() - began) / world.size
                state.elapsed, signal, senders = world.total(clock, *signals)
                stop, new = int(signal / max(1.0, senders)), state.step > first
                late = minutes is not None and state.elapsed >= 60 * minutes
                over = late or (total is not None and state.step >= total)
                if minutes is not None:
                    bar.update(min(minutes, state.elapsed / 60) - bar.n)
                done = schedule.progress(state.step, state.elapsed)
                progress = Progress(state.step, state.step / setup.steps_per_epoch, done)

                due = new and run.val_every and state.step % run.val_every == 0
                tuned = state.step == 0 and run.init is not None  # compared with its beginning
                if run.val_every and (due or tuned or (over and not stop)):
                    world.broadcast_from_main(partial(validator.run, state, progress))
                waits = run.save_minutes and state.elapsed - saved >= 60 * run.save_minutes
                if stop or over or (new and (waits or state.step % run.save_every == 0)):
                    outcomes.read()
                    world.broadcast_from_main(partial(state.save, setup))
                    saved = state.elapsed
                if stop or over:
                    break

                begun, batches.waited = time.perf_counter(), 0.0
                numbers = range(views.accumulate * state.step, views.accumulate * (state.step + 1))
                rate = config.optim.lr * schedule.fraction(state.step, state.elapsed)
                weights = term_weights(config.loss, progress)
                try:
                    outcome = run_step(map(batches.take, numbers), weights, rate)
                except Unreachable:
                    if world.size == 1:  # else the others wait for this process in an exchange
                        outcomes.read()
                        state.save(setup)
                    raise
                state.step += 1
                outcomes.add(outcome.stats)
                logs = state.step % run.log_every == 0
                loss, norm = outcomes.read(late=int(on_gpu and not logs))
                seconds = time.perf_counter() - begun

                if minutes is None:
                    bar.update(1)
                log.warn_of_objects(state.step, batches.failures)
                if not logs:
                    continue
                figures = world.mean(means(outcome))
                shown = {} if minutes is None else {"step": state.step}
                bar.set_postfix(shown, loss=f"{loss:.4f}", psnr=f"{figures['psnr']:.1f}")
                log.write(
                    "train",
                    state.step,
                    minutes=state.elapsed / 60,
                    epoch=progress.epochs,
                    skipped=state.skipped,
                    loss=loss,
                    grad_norm=norm,
                    lr=rate,
                    seconds=seconds,
                    wait_share=batches.waited / seconds,
                    views_per_second=setup.step_size * outcome.result.target.shape[1] / seconds,
                    **figures,
                )
                reason = collapse_reason(figures)
                if reason and not collapsed:
                    log.warn(state.step, f"possible collapse at step {state.step}: {reason}")
                collapsed = reason is not None

        # The result.
        if late and state.step < (total or 0):
            line = f"--minutes ends the run at step {state.step} of {total}, "
            log.warn(state.step, line + "before the learning rate's schedule ends")
        if world.main and not stop:
            validator.conclude(state)
            save_model(run.out / "model.safetensors", state.result)
        gathered = world.gather(batches.failures | validator.failures)
        failures = {uid: why for each in gathered for uid, why in each.items()}
        report(setup, state, log, stop, failures)
        return 128 + stop if stop else int(bool(failures))


class Outcomes:
    """Outcomes of steps, which a GPU is not waited for: they are read some steps later."""

    def __init__(self, state: RunState, world: World, log: RunLog) -> None:
        self._state, self._world, self._log = state, world, log
        self._unread: deque[tuple[int, Tensor]] = deque()

    def add(self, stats: Tensor) -> None:
        """Add the result of ``update`` of the last step."""
        self._unread.append((self._state.step, stats))

    def read(self, late: int = 0) -> tuple[float, float]:
        """Read the outcomes of all steps but the last ``late``, and count those that were skipped.

        Returns:
            Loss, the mean over all processes, and norm of the gradient, of the last one read.

        Raises:
            UserError: too many steps in a row were skipped.
        """
        state, loss, norm = self._state, math.nan, math.nan
        while len(self._unread) > late:
            step, stats = self._unread.popleft()
            own_loss, norm, bad = stats.tolist()
            (summed,) = self._world.total(own_loss)
            loss = summed / self._world.size
            if not bad:
                state.skipped_in_row = 0
                continue
            state.skipped += 1
            state.skipped_in_row += 1
            if state.ema is not None:
                state.ema.updates -= 1
            what = "gradient" if math.isfinite(summed) else "loss"
            self._log.warn(step, f"step {step} skipped: its {what} is not finite")
            if state.skipped_in_row >= MAX_SKIPPED:
                raise UserError(
                    f"{state.skipped_in_row} steps in a row were not finite (step {step}); "
                    "lower --lr, or resume from an older checkpoint"
                )
        return loss, norm
