"""The training loop: ``Trainer.run`` is the loop, ``Trainer.train_step`` one optimizer step."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from gamba_warp.errors import UserError
from gamba_warp.model.checkpoint import save_model
from gamba_warp.model.gamba import Gamba
from gamba_warp.processes import stop_requests

from .batches import Batches, TrainingData, fixed_batches
from .checkpoint import STATE_VERSION, read_run, read_weights_of, save_checkpoint
from .config import LengthConfig, TrainConfig
from .ddp import World
from .log import RunLog, run_bar, say
from .objective.losses import Moment, term_weights
from .optim import Ema, Schedule, build_optimizer, checked_moments, novel_views
from .step import Objective, collapse_reason, compute_gradients, health, validate


class Trainer:
    """Trains a model on one dataset; it holds the model, its optimizer and their state."""

    def __init__(
        self,
        config: TrainConfig,
        model: Gamba,
        data: TrainingData,
        world: World,
        lpips: Callable[[Tensor, Tensor], Tensor] | None,
    ) -> None:
        """Takes a ``model`` on the world's device."""
        self.config, self.data, self.world, self.lpips = config, data, world, lpips
        self.log: RunLog | None = None  # the main process gets one before it runs
        self.model = model
        self.optimizer = build_optimizer(model, config.optim.weight_decay, config.optim.beta2)
        self.ema = Ema(model, config.optim.ema) if config.optim.ema else None
        # By the stem of their files; the last is the one that is used.
        self.models = {"model": model} | ({"ema": self.ema.model} if self.ema else {})
        self.parameters = [p for group in self.optimizer.param_groups for p in group["params"]]
        self.wrapped = world.wrap(model)
        self.precision = world.precision(config.optim.precision, model.config.width)
        self.accumulate = config.views.accumulate
        self.step = self.skipped = self.skipped_in_row = 0
        self.elapsed = 0.0  # seconds of training, resumed parts included
        self._collapsed = False
        self._unread: dict[str, str] = {}  # reasons by uid, of objects to validate on
        self._named: set[str] = set()  # uids whose failure was said
        self._saved = self._validated = -1  # the step of the last checkpoint and validation
        self.steps_per_epoch = len(data.objects) / (data.batch_size * world.size * self.accumulate)
        self.schedule = self._schedule(config.length)
        self.total = total = self.schedule.total
        self._batches = Batches(
            data,
            config,
            world,
            novel=lambda number: self.novel_views(number // self.accumulate),
            last=None if total is None else total * self.accumulate,
        )

    def _schedule(self, length: LengthConfig) -> Schedule:
        total = length.steps
        if total is None and (length.epochs or not length.minutes):
            total = math.ceil((length.epochs or 400) * self.steps_per_epoch)
        return Schedule(self.config.optim, total, length.minutes)

    @property
    def failures(self) -> dict[str, str]:
        """Reasons by uid, for the objects that could not be read so far."""
        return self._unread | self._batches.failures

    def _name_failures(self) -> None:
        """Warns of each object that could not be read, once."""
        for uid in [uid for uid in self.failures if uid not in self._named]:
            self._named.add(uid)
            if self.log is not None:
                self.log.warn(self.step, f"{uid} is skipped: {self.failures[uid]}")

    def novel_views(self, step: int) -> int:
        """Returns V, the number of novel views at a step."""
        views = self.config.views
        if self.data.novel is not None:
            return self.data.novel
        done = self.schedule.progress(step, self.elapsed)
        return novel_views(done, views.views_first, views.views_last)

    def _weights(self, validates: bool = False) -> dict[str, float]:
        epochs = self.step / self.steps_per_epoch
        done = self.schedule.progress(self.step, self.elapsed)
        return term_weights(self.config.loss, Moment(self.step, epochs, done, validates))

    def train_step(self) -> dict[str, float]:
        """Makes one optimizer step; returns its figures, some of them those of its last batch.

        With several processes, losses and the model's health are the means over all of them.

        A step whose loss or gradient is not finite leaves the weights alone and is counted.

        Raises:
            UserError: there are too many such steps in a row, or data cannot be read.
        """
        started = time.perf_counter()
        config, batches, first = self.config, self._batches, self.step * self.accumulate
        rate = config.optim.lr * self.schedule.share(self.step, self.elapsed)
        for group in self.optimizer.param_groups:
            group["lr"] = rate
        batches.waited = 0.0
        made = compute_gradients(
            self.wrapped,
            self.optimizer,
            map(batches.take, range(first, first + self.accumulate)),
            Objective(self._weights(), self.lpips, config.loss.lpips_crop, self.precision),
            clip=config.optim.clip,
            count=self.accumulate,
        )
        loss, norm = torch.stack([made.loss, made.norm]).tolist()
        bad = not (math.isfinite(loss) and math.isfinite(norm))
        number, total = self.world.total(bad, loss)  # so that all processes do alike
        self._apply(number > 0, "gradient" if math.isfinite(total) else "loss")
        loss = total / self.world.size
        seconds = time.perf_counter() - started
        views = made.batch.cameras.viewmats[..., 0, 0].numel() * self.accumulate * self.world.size
        figures = {"loss": loss, "grad_norm": norm, "lr": rate}
        figures |= {"seconds": seconds, "wait_share": batches.waited / seconds}
        figures["views_per_second"] = views / seconds
        if self.step % config.run.log_every == 0:
            terms = made.result.terms.items()
            own = {f"loss_{name}": term.mean().item() for name, term in terms}
            known = health(made.result, made.batch).items()
            figures |= self.world.mean(own | {name: value.item() for name, value in known})
        return figures

    def _apply(self, bad: bool, what: str) -> None:
        """Updates the weights, or skips the step because of ``what``, and counts the step."""
        self.step += 1
        if not bad:
            self.skipped_in_row = 0
            self.optimizer.step()
            if self.ema is not None:
                self.ema.update()
            return
        self.skipped += 1
        self.skipped_in_row += 1
        if self.log is not None:
            self.log.warn(self.step, f"step {self.step} skipped: its {what} is not finite")
        if self.skipped_in_row >= self.config.optim.max_skipped:
            raise UserError(
                f"{self.skipped_in_row} steps in a row were not finite (step {self.step}); "
                "lower --lr, or resume from an older checkpoint"
            )

    def run(self) -> int:
        """Trains until the end, the time limit or a signal, and then saves a checkpoint.

        Returns:
            0, or 128 + the number of the signal that stopped the run.

        Raises:
            UserError: as ``train_step``, or the run folder cannot be written.
        """
        minutes = self.config.length.minutes
        bar = run_bar(self.total, minutes, self.step, self.elapsed / 60, self.world.main)
        began, before, stop = time.monotonic(), self.elapsed, 0.0
        self.model.train()
        try:
            with stop_requests(insist=True) as received:
                while True:
                    # Elapsed seconds and signal are the same on all processes.
                    clock = (before + time.monotonic() - began) / self.world.size
                    signals = float(received[0] if received else 0), float(bool(received))
                    self.elapsed, stop, senders = self.world.total(clock, *signals)
                    stop /= max(1.0, senders)
                    late = minutes is not None and self.elapsed >= 60 * minutes
                    if minutes is not None:
                        bar.update(min(minutes, self.elapsed / 60) - bar.n)
                    if stop or late or (self.total is not None and self.step >= self.total):
                        break
                    self._after_step(self.train_step(), bar)
                if not stop:
                    self._validate()
                self.save()
        finally:
            self._batches.close()
            bar.close()
        if stop:
            return 128 + int(stop)
        if self.world.main:
            best = [*self.models.values()][-1]
            save_model(self.config.run.out / "model.safetensors", best)
        return 0

    def _after_step(self, figures: dict[str, float], bar: tqdm) -> None:
        run, minutes = self.config.run, self.config.length.minutes
        if minutes is None:
            bar.update(1)
        self._name_failures()
        if self.log is not None and self.step % run.log_every == 0:
            shown = {"loss": f"{figures['loss']:.4f}", "psnr": f"{figures['psnr']:.1f}"}
            if minutes is not None:
                shown = {"step": self.step, **shown}
            bar.set_postfix(shown)
            epoch = self.step / self.steps_per_epoch
            done = {"minutes": self.elapsed / 60, "epoch": epoch, "skipped": self.skipped}
            self.log.write("train", self.step, **done, **figures)
            reason = collapse_reason(figures)
            if reason and not self._collapsed:
                self.log.warn(self.step, f"possible collapse at step {self.step}: {reason}")
            self._collapsed = reason is not None
        if run.val_every and self.step % run.val_every == 0:
            self._validate()
        if self.step % run.save_every == 0:
            self.save()

    def _validate(self) -> None:
        """Validates the averaged weights on the main process; the others wait."""
        if self._validated == self.step or not self.config.run.val_every:
            return
        self._validated = self.step

        def alone() -> None:
            if self.log is None or not self.data.held_out:
                return
            run, best = self.config.run, [*self.models.values()][-1]
            size, weights = self.config.views.size, self._weights(validates=True)
            held_out = fixed_batches(self.data, self.model.config, size, self._unread)
            objective = Objective(weights, self.lpips)
            figures, rows = validate(best, held_out, objective, self.world.device)
            self._name_failures()
            if not rows:
                self.log.warn(self.step, "no validation: none of its objects can be read")
                return
            self.log.write("val", self.step, minutes=self.elapsed / 60, **figures)
            text = " ".join(f"{name} {value:.4g}" for name, value in figures.items())
            say(f"step {self.step}: validation {text}")
            self.log.sample(self.step, run.out / "samples" / f"step_{self.step:06d}.png", rows)
            self.log.page()

        self.world.on_main(alone)

    def save(self) -> None:
        """Writes a checkpoint on the main process, once per step; the others wait."""

        def write() -> None:
            if self._saved != self.step:
                run = self.config.run
                save_checkpoint(run.out, self.step, self.models, self.state(), run.keep)
                self._saved = self.step

        self.world.on_main(write)

    def state(self) -> dict:
        """Returns all that a continued run needs beside the weights: tensors and plain values."""
        return {
            "version": STATE_VERSION,
            "config": self.config.to_dict(),
            "objects": self.data.fingerprint,
            "step": self.step,
            "skipped": self.skipped,
            "skipped_in_row": self.skipped_in_row,
            "elapsed": self.elapsed,
            "world_size": self.world.size,
            "ema_updates": self.ema.updates if self.ema else 0,
            "new_length": asdict(self.schedule.since),
            "optimizer": self.optimizer.state_dict(),
            "rng": torch.get_rng_state(),
            "rng_cuda": torch.cuda.get_rng_state_all() if torch.cuda.is_available() else [],
        }

    def restore(self, checkpoint: Path) -> str | None:
        """Continues from a checkpoint, bit-identically on one device.

        Returns:
            A line about the learning rate if the run's length is another one now.

        Raises:
            UserError: the checkpoint is damaged, or belongs to a run with another configuration,
                data or number of processes; the message names the differing fields.
        """

        def read() -> tuple[Any, ...]:
            mine = {"objects": self.data.fingerprint, "world_size": self.world.size}
            state, length = read_run(checkpoint, self.config, mine)
            moments = checked_moments(self.optimizer, state.optimizer, checkpoint / "state.pt")
            files = {name: checkpoint / f"{name}.safetensors" for name in self.models}
            weights = {n: read_weights_of(files[n], model) for n, model in self.models.items()}
            return state, length, moments, weights

        # Everything is read and checked before any of it is loaded. The processes need no disk in
        # common: the main one reads.
        state, length, moments, weights = self.world.on_main(read)
        old = replace(self._schedule(length), since=state.new_length)
        for name, model in self.models.items():
            model.load_stored_state(weights[name])
        if self.ema is not None:
            self.ema.updates = state.ema_updates
        self.optimizer.load_state_dict(moments)
        self.step, self.skipped = state.step, state.skipped
        self.skipped_in_row, self.elapsed = state.skipped_in_row, state.elapsed
        self.schedule, note = self.schedule.after(old, self.step, self.elapsed)
        self._saved = self.step if checkpoint.parent.parent == self.config.run.out else -1
        torch.set_rng_state(state.rng)
        if len(state.rng_cuda) == torch.cuda.device_count():
            torch.cuda.set_rng_state_all(state.rng_cuda)
        return note
