"""Training loop: ``Trainer.run`` is the loop, ``Trainer.train_step`` one optimizer step."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import torch
from torch import Tensor
from tqdm import tqdm

from gamba_warp.data.shard_cache import Unreachable
from gamba_warp.errors import UserError
from gamba_warp.files import write_json
from gamba_warp.image_metrics import METRICS
from gamba_warp.model.checkpoint import save_model
from gamba_warp.model.gamba import Gamba
from gamba_warp.processes import stop_requests

from .batches import Batches, HeldOut, TrainingData, fixed_batches
from .checkpoint import STATE_VERSION, read_run, read_weights_of, save_checkpoint
from .config import LengthConfig, TrainConfig, command_line, stored_option
from .ddp import World
from .log import RunLog, run_bar, say
from .objective.losses import Progress, term_weights
from .optim import (
    Ema,
    NewBatch,
    Schedule,
    build_optimizer,
    checked_moments,
    novel_views,
    rate_factors,
)
from .profiler import STEPS, WARM_STEPS, profiled
from .step import Objective, collapse_reason, compute_gradients, health, validate


class Score(NamedTuple):
    """Result of a validation.

    Attributes:
        step: optimizer steps done; None if unknown.
        value: the figure of ``--best-by``, the mean over the datasets.
    """

    step: int | None
    value: float


class Trainer:
    """Training of a model: holds the model, its optimizer and their state."""

    def __init__(
        self,
        config: TrainConfig,
        model: Gamba,
        data: TrainingData,
        world: World,
        lpips: Callable[[Tensor, Tensor], Tensor] | None,
    ) -> None:
        """Set up the training of a ``model`` that is on the world's device."""
        self.config, self.data, self.world, self.lpips = config, data, world, lpips
        self.log: RunLog | None = None  # set on the main process before it runs
        self.model = model
        factors = rate_factors(model, config.optim.lr_of)
        self.optimizer = build_optimizer(model, config.optim, factors)
        self.ema = Ema(model, config.optim.ema) if config.optim.ema else None
        # By file stem; the last one is used for validation and as the result.
        self.models = {"model": model} | ({"ema": self.ema.model} if self.ema else {})
        self.parameters = [p for group in self.optimizer.param_groups for p in group["params"]]
        self.wrapped = world.wrap(model)
        self.precision = world.precision(config.optim.precision, model.config.width)
        self.accumulate = config.views.accumulate
        self.step = self.skipped = self.skipped_in_row = 0
        self.elapsed = 0.0  # seconds of training, resumed parts included
        self._collapsed = False
        self.scores: dict[str, Score] = {}  # of the "first", "best" and "last" validation
        self._unread: dict[str, str] = {}  # reasons by uid, of validation objects
        self._named: set[str] = set()  # uids whose failure was reported
        self._saved = self._validated = -1  # step of the last checkpoint and validation
        self.step_size = data.batch_size * world.size * self.accumulate
        self.steps_per_epoch = len(data.objects) / self.step_size
        self.schedule = self._schedule(config.length, NewBatch())
        self.total = total = self.schedule.total
        self._batches = Batches(
            data,
            config,
            world,
            novel=lambda number: self.novel_views(number // self.accumulate),
            last=None if total is None else total * self.accumulate,
        )

    def _schedule(self, length: LengthConfig, since: NewBatch) -> Schedule:
        total = length.steps
        if total is None and (length.epochs or not length.minutes):
            left = (length.epochs or 400) - since.samples / len(self.data.objects)
            total = since.step + math.ceil(left * self.steps_per_epoch)
        return Schedule(self.config.optim, total, length.minutes)

    @property
    def epochs(self) -> float:
        """Passes over the objects so far."""
        since = self._batches.since
        before = since.samples / len(self.data.objects)
        return before + (self.step - since.step) / self.steps_per_epoch

    @property
    def failures(self) -> dict[str, str]:
        """Reasons by uid, for the objects that could not be read so far."""
        return self._unread | self._batches.failures

    def _name_failures(self) -> None:
        """Warn once of each object that could not be read."""
        for uid in [uid for uid in self.failures if uid not in self._named]:
            self._named.add(uid)
            if self.log is not None:
                self.log.warn(self.step, f"{uid} is skipped: {self.failures[uid]}")

    def novel_views(self, step: int) -> int:
        """Return V, the number of novel views at a step."""
        views = self.config.views
        if self.data.novel is not None:
            return self.data.novel
        done = self.schedule.progress(step, self.elapsed)
        return novel_views(done, views.views_first, views.views_last)

    def _weights(self, validates: bool = False) -> dict[str, float]:
        done = self.schedule.progress(self.step, self.elapsed)
        return term_weights(self.config.loss, Progress(self.step, self.epochs, done, validates))

    def train_step(self) -> dict[str, float]:
        """Make one optimizer step; return its figures, some of them of the last batch only.

        With several processes, losses and the model's health are means over all of them.

        A step with a non-finite loss or gradient leaves the weights unchanged and is counted.

        Raises:
            UserError: too many such steps in a row, or data cannot be read.
        """
        started = time.perf_counter()
        config, batches, first = self.config, self._batches, self.step * self.accumulate
        rate = config.optim.lr * self.schedule.share(self.step, self.elapsed)
        for group in self.optimizer.param_groups:
            group["lr"] = rate * group["factor"]
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
        number, total = self.world.total(bad, loss)  # all processes must act alike
        self._apply(number > 0, "gradient" if math.isfinite(total) else "loss")
        loss = total / self.world.size
        seconds = time.perf_counter() - started
        views = made.batch.cameras.viewmats[..., 0, 0].numel() * self.accumulate * self.world.size
        figures = {"loss": loss, "grad_norm": norm, "lr": rate}
        figures |= {"seconds": seconds, "wait_share": batches.waited / seconds}
        figures["views_per_second"] = views / seconds
        if self.step % config.run.log_every == 0:
            terms = made.result.terms.items()
            losses = {f"loss_{name}": term.mean().item() for name, term in terms}
            state = health(made.result, made.batch).items()
            figures |= self.world.mean(losses | {name: value.item() for name, value in state})
        return figures

    def _apply(self, bad: bool, what: str) -> None:
        """Update the weights, or skip the step because its ``what`` is not finite; count it."""
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
        """Train until the end, the time limit or a signal, then save a checkpoint.

        Returns:
            0, or 128 + the number of the signal that stopped the run.

        Raises:
            UserError: as ``train_step``, or the run folder cannot be written.
        """
        minutes = self.config.length.minutes
        bar = run_bar(self.total, minutes, self.step, self.elapsed / 60, self.world.main)
        began, before, stop = time.monotonic(), self.elapsed, 0.0
        self.model.train()
        if self.step == 0 and (self.config.run.init or self.config.run.init_partial):
            self._validate()
        try:
            with stop_requests(insist=True) as received, self._profiled() as profile_step:
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
                    profile_step()
                if not stop:
                    self._validate()
                    self._compare_ends()
                self.save()
        except Unreachable:
            if self.world.size == 1:  # else the others wait for this process in an exchange
                self.save()
            raise
        finally:
            self._batches.close()
            bar.close()
        if stop:
            return 128 + int(stop)
        if self.world.main:
            self._save_model(self.config.run.out / "model.safetensors")
        return 0

    @contextmanager
    def _profiled(self) -> Iterator[Callable[[], None]]:
        """Profile steps of the main process, if ``--profile`` is given."""
        if self.log is None or not self.config.run.profile:
            yield lambda: None
            return
        folder, began = self.config.run.out / "profile", self.step
        with profiled(folder, self.world.device) as profile_step:
            yield profile_step
        steps = min(STEPS, self.step - began - WARM_STEPS)
        say(f"profile of {steps} steps: {folder}" if steps > 0 else "--profile: too few steps")

    def _save_model(self, path: Path) -> None:
        """Write the result's weights, with a card if scanned objects must not judge them."""
        from gamba_warp.pages.card import ModelCard, card_path

        save_model(path, [*self.models.values()][-1])
        if not (names := self.data.scanned):
            return
        values, objects = self.config.to_dict(), set(self.data.objects)
        folders = [self.config.data, *self.config.views.extra]
        card = ModelCard(
            data=", ".join(folder.name for folder in folders)[:2000],
            objects=len(objects),
            steps=self.step,
            compute=f"{self.elapsed / 60:.0f} minutes, {self.world.size} x {self.world.device}",
            command=command_line(values)[:2000],
            seed=self.config.run.seed,
            use="not stated",
            limits=[
                f"Trained or validated on {len(names)} of Google Scanned Objects (--train-on-gso): "
                f"figures on them are not of unseen objects: {', '.join(names)}"[:2000]
            ],
        )
        write_json(card_path(path), msgspec.to_builtins(card))

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
            done = {"minutes": self.elapsed / 60, "epoch": self.epochs, "skipped": self.skipped}
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
        """Validate the averaged weights on the main process; the others wait."""
        if self._validated == self.step or not self.config.run.val_every:
            return
        self._validated = self.step

        def validate_all() -> None:
            if self.log is None or not self.data.held_out:
                return
            objective = Objective(self._weights(validates=True), self.lpips)
            scores, rows = [], []
            for part in self.data.held_out:
                figures, pictures = self._validate_on(part, objective)
                if not pictures:
                    about = f" on {part.name}" if part.name else ""
                    reason = "none of its objects can be read"
                    self.log.warn(self.step, f"no validation{about}: {reason}")
                    continue
                by = self.config.run.best_by
                scores.append(figures.get(f"{by}_novel", figures[f"{by}_input"]))
                rows += pictures
            if len(scores) == len(self.data.held_out):  # else not comparable with earlier ones
                self._keep_best(Score(self.step, sum(scores) / len(scores)))
            if rows:
                path = self.config.run.out / "samples" / f"step_{self.step:06d}.png"
                self.log.sample(self.step, path, rows)

        self.world.on_main(validate_all)

    def _validate_on(
        self, part: HeldOut, objective: Objective
    ) -> tuple[dict[str, float], list[Tensor]]:
        """Validate on the objects of one dataset; log and return the figures."""
        assert self.log is not None
        best, size = [*self.models.values()][-1], self.config.views.size
        about = (self.data.val_views, best.config, size, self._unread)
        figures, rows = validate(best, fixed_batches(part, *about), objective, self.world.device)
        self._name_failures()
        if rows:
            event, name = (f"val/{part.name}", f" on {part.name}") if part.name else ("val", "")
            self.log.write(event, self.step, minutes=self.elapsed / 60, **figures)
            text = " ".join(f"{name} {value:.4g}" for name, value in figures.items())
            say(f"step {self.step}: validation{name} {text}")
        return figures, rows

    def _better(self, score: Score, name: str) -> bool:
        """True if a score is better than that of ``name``, or there is none; False for NaN."""
        other = self.scores.get(name)
        sign = 1 if METRICS[self.config.run.best_by].more_is_better else -1
        return score.value == score.value and (
            other is None or sign * score.value > sign * other.value
        )

    def _keep_best(self, score: Score) -> None:
        """Write ``best.safetensors`` if a validation is better than all before."""
        assert self.log is not None
        if math.isfinite(score.value):
            self.scores.setdefault("first", score)
            self.scores["last"] = score
        if not self._better(score, "best"):
            return
        path = self.config.run.out / "best.safetensors"
        try:
            self._save_model(path)
        except UserError as error:  # the run continues; a later write may succeed
            self.log.warn(self.step, str(error))
            return
        self.scores["best"] = score
        by = self.config.run.best_by
        self.log.write("best", self.step, minutes=self.elapsed / 60, **{by: score.value})
        if len(self.data.held_out) > 1:
            text = f"best so far, mean {METRICS[by].title} of the datasets {score.value:.4g}"
            say(f"step {self.step}: {text} -> {path}")

    def _compare_ends(self) -> None:
        """Name the best validation; warn if the last is worse than the first."""
        if self.log is None or "best" not in self.scores:
            return
        metric = METRICS[self.config.run.best_by]

        def shown(name: str) -> str:
            step, value = self.scores[name]
            where = "" if step is None else f" at step {step}"
            return f"{value:.4g}{f' {metric.unit}' if metric.unit else ''}{where}"

        if {"first", "last"} <= self.scores.keys() and self._better(self.scores["first"], "last"):
            self.log.warn(
                self.step,
                f"the last validation is worse than the first: {metric.title} {shown('last')}, "
                f"{shown('first')}; best.safetensors has {shown('best')}",
            )
        else:
            say(f"best.safetensors: {metric.title} {shown('best')}; the last has {shown('last')}")

    def save(self) -> None:
        """Write a checkpoint on the main process, once per step; the others wait."""

        def write() -> None:
            if self._saved != self.step:
                run = self.config.run
                save_checkpoint(run.out, self.step, self.models, self.state(), run.keep)
                self._saved = self.step

        self.world.on_main(write)

    def state(self) -> dict:
        """Return everything a resumed run needs beside the weights: tensors and plain values."""
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
            "scores": {name: tuple(score) for name, score in self.scores.items()},
            "new_length": asdict(self.schedule.since),
            "new_batch": asdict(self._batches.since),
            "optimizer": self.optimizer.state_dict(),
            "rng": torch.get_rng_state(),
            "rng_cuda": torch.cuda.get_rng_state_all() if torch.cuda.is_available() else [],
        }

    def restore(self, checkpoint: Path) -> list[str]:
        """Continue from a checkpoint, bit-identically on one device.

        Returns:
            Lines about what has changed: options of ``--override``, and the learning rate if the
            run has another length.

        Raises:
            UserError: the checkpoint is damaged, or belongs to a run with another configuration,
                data or number of objects a step; the message names the differing fields.
        """

        def read() -> tuple[Any, ...]:
            stored = read_run(checkpoint, self.config, self.data.fingerprint, self.world.size)
            state = stored.state
            moments = checked_moments(self.optimizer, state.optimizer, checkpoint / "state.pt")
            files = {name: checkpoint / f"{name}.safetensors" for name in self.models}
            weights = {n: read_weights_of(files[n], model) for n, model in self.models.items()}
            return stored, moments, weights

        # Everything is read and checked before anything is loaded. Only the main process reads, so
        # no shared disk is needed.
        stored, moments, weights = self.world.on_main(read)
        state = stored.state
        since = state.new_batch
        self.steps_per_epoch = len(self.data.objects) / stored.step_size
        old = self._schedule(stored.length, since)
        old = replace(old, optim=stored.optim, since=state.new_length)
        if stored.step_size != self.step_size:
            since = NewBatch(state.step, since.taken(state.step, stored.step_size))
        self.steps_per_epoch = len(self.data.objects) / self.step_size
        self.schedule = self._schedule(self.config.length, since)
        for name, model in self.models.items():
            model.load_stored_state(weights[name])
        if self.ema is not None:
            self.ema.updates = state.ema_updates
        self.optimizer.load_state_dict(moments)
        self.step, self.skipped = state.step, state.skipped
        self.skipped_in_row, self.elapsed = state.skipped_in_row, state.elapsed
        if stored_option(state.config, "run.best_by") == self.config.run.best_by:
            self.scores = {name: Score(*score) for name, score in state.scores.items()}
            if state.best > -math.inf:
                self.scores["best"] = Score(None, state.best)
        self.schedule, note = self.schedule.after(old, self.step, self.elapsed)
        self.total = self.schedule.total
        self._batches.since = since
        self._batches.last = None if self.total is None else self.total * self.accumulate
        self._saved = self.step if checkpoint.parent.parent == self.config.run.out else -1
        torch.set_rng_state(state.rng)
        if len(state.rng_cuda) == torch.cuda.device_count():
            torch.cuda.set_rng_state_all(state.rng_cuda)
        return [*stored.changed, *filter(None, [note])]
