"""Training loop: ``Trainer.run`` is the loop, ``Trainer.train_step`` one optimizer step."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor
from tqdm import tqdm

from gamba_warp.errors import UserError
from gamba_warp.model.checkpoint import save_model
from gamba_warp.model.gamba import Gamba
from gamba_warp.processes import stop_requests

from .batches import Batches, FixedObjects, TrainingData, fixed_batches
from .checkpoint import STATE_VERSION, read_run, read_weights_of, save_checkpoint
from .config import LengthConfig, TrainConfig
from .data.samples import Batch
from .data.shards import Unreachable
from .ddp import World
from .graphs import MOST, StepGraphs
from .log import RunLog, run_bar, say
from .objective.losses import Progress, term_weights
from .optim import Ema, Schedule, build_optimizer, checked_moments, novel_views
from .step import (
    Gradients,
    Objective,
    collapse_reason,
    compute_gradients,
    health,
    update,
    validate,
)

CLIP = 1.0  # largest norm of the gradient (paper, §4.1)
MAX_SKIPPED = 20  # a run ends after so many steps in a row that are not finite
KEPT = 2  # checkpoints that remain


class Score(NamedTuple):
    """Result of a validation.

    Attributes:
        step: optimizer steps done.
        psnr: of novel views (of inputs without novel ones), dB, the mean over the datasets.
    """

    step: int
    psnr: float

    def __str__(self) -> str:
        return f"{self.psnr:.4g} dB at step {self.step}"


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
        self.optimizer = build_optimizer(model)
        self.ema = Ema(model, config.optim.ema) if config.optim.ema else None
        # By file stem; the last one is used for validation and as the result.
        self.models = {"model": model} | ({"ema": self.ema.model} if self.ema else {})
        self.parameters = [p for group in self.optimizer.param_groups for p in group["params"]]
        self.wrapped = world.wrap(model)
        self.precision = world.precision(config.optim.precision, model.config.width)
        self.accumulate = config.views.accumulate
        self.graphs = self._open_graphs()
        self.step = self.skipped = self.skipped_in_row = 0
        # Step, and the tensor of ``update``, of the steps whose numbers are not read yet.
        self._unread_steps: deque[tuple[int, Tensor]] = deque()
        self.elapsed = 0.0  # seconds of training, resumed parts included
        self._collapsed = False
        self.scores: dict[str, Score] = {}  # of the "first", "best" and "last" validation
        self._unread: dict[str, str] = {}  # reasons by uid, of validation objects
        self._named: set[str] = set()  # uids whose failure was reported
        self._saved = self._validated = -1  # step of the last checkpoint and validation
        self.step_size = config.views.batch_size * world.size * self.accumulate
        self.steps_per_epoch = len(data.objects) / self.step_size
        self.schedule = self._schedule(config.length)
        self.total = total = self.schedule.total
        self._batches = Batches(
            data,
            config,
            world,
            novel=lambda number: self.novel_views(number // self.accumulate),
            last=None if total is None else total * self.accumulate,
        )

    def _open_graphs(self) -> StepGraphs | None:
        """Prepare CUDA graphs of the steps; None on a CPU or if a step has several parts."""
        if self.world.device.type != "cuda":
            return None
        if self.accumulate > 1 or self.world.size > 1:
            if self.world.main and self.config.run.graph == "auto":
                why = "--accumulate" if self.accumulate > 1 else "several processes"
                say(f"no CUDA graphs with {why}")
            return None
        for group in self.optimizer.param_groups:
            group["capturable"] = True
        return StepGraphs(self.world.device, say, MOST if self.config.run.graph == "auto" else 0)

    def _schedule(self, length: LengthConfig) -> Schedule:
        total = length.steps
        if total is None and (length.epochs or not length.minutes):
            total = math.ceil((length.epochs or 400) * self.steps_per_epoch)
        return Schedule(self.config.optim, total, length.minutes)

    @property
    def epochs(self) -> float:
        """Passes over the objects so far."""
        return self.step / self.steps_per_epoch

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
        fixed = self.config.views.views_per_object
        if fixed is not None:
            return fixed
        return novel_views(self.schedule.progress(step, self.elapsed))

    def _weights(self, validates: bool = False) -> dict[str, float]:
        done = self.schedule.progress(self.step, self.elapsed)
        return term_weights(self.config.loss, Progress(self.step, self.epochs, done, validates))

    def train_step(self) -> dict[str, float]:
        """Make one optimizer step.

        A step with a non-finite loss or gradient leaves the weights unchanged and is counted. A GPU
        is not waited for: its numbers are read with the next step, a log step's at once.

        Returns:
            On log steps the figures, some of them of the last batch only; with several processes,
            losses and the model's health are means over all of them. Else nothing.

        Raises:
            UserError: too many such steps in a row, or data cannot be read.
        """
        started = time.perf_counter()
        config, batches, first = self.config, self._batches, self.step * self.accumulate
        rate = config.optim.lr * self.schedule.share(self.step, self.elapsed)
        share = self.ema.next_share() if self.ema else 1.0
        weights, batches.waited = self._weights(), 0.0
        if self.graphs is None:
            taken = map(batches.take, range(first, first + self.accumulate))
            made, numbers = self._optimize(taken, weights, rate, share)
        else:
            number, key = self.graphs.number, tuple(sorted(n for n, w in weights.items() if w))
            given = {n: w if n == "novel" else number(n, w) for n, w in weights.items() if w}
            rest = number("learning rate", rate), number("share of the average", share)
            made, numbers = self.graphs.run(
                batches.take(first), key, lambda batch: self._optimize([batch], given, *rest)
            )
            numbers = numbers.clone()  # the next step of a graph overwrites them
        self.step += 1
        self._unread_steps.append((self.step, numbers))
        logs = self.step % config.run.log_every == 0
        loss, norm = self._read_steps(late=1 if self.world.device.type == "cuda" else 0)
        if not logs:
            return {}
        if self._unread_steps:
            loss, norm = self._read_steps()
        seconds = time.perf_counter() - started
        views = made.batch.cameras.viewmats[..., 0, 0].numel() * self.accumulate * self.world.size
        figures = {"loss": loss, "grad_norm": norm, "lr": rate}
        figures |= {"seconds": seconds, "wait_share": batches.waited / seconds}
        figures["views_per_second"] = views / seconds
        terms = {f"loss_{name}": term.detach().mean() for name, term in made.result.terms.items()}
        found = terms | health(made.result, made.batch)
        values = torch.stack([value.double() for value in found.values()]).tolist()
        return figures | self.world.mean(dict(zip(found, values)))

    def _optimize(
        self,
        batches: Iterable[Batch],
        weights: dict[str, Any],
        rate: float | Tensor,
        share: float | Tensor,
    ) -> tuple[Gradients, Tensor]:
        """Compute the gradients of a step and update the weights, as ``update``."""
        for group in self.optimizer.param_groups:
            group["lr"] = rate
        made = compute_gradients(
            self.wrapped,
            self.optimizer,
            batches,
            Objective(weights, self.lpips, self.config.loss.lpips_crop, self.precision),
            clip=CLIP,
            count=self.accumulate,
        )
        return made, update(self.optimizer, self.ema, share, made, self.wrapped)

    def _read_steps(self, late: int = 0) -> tuple[float, float]:
        """Read the numbers of all steps but the last ``late``, and count those that were skipped.

        Returns:
            Loss, the mean over all processes, and norm of the gradient, of the last one read.
        """
        loss = norm = math.nan
        while len(self._unread_steps) > late:
            step, numbers = self._unread_steps.popleft()
            own, norm, bad = numbers.tolist()
            (total,) = self.world.total(own)
            loss = total / self.world.size
            if not bad:
                self.skipped_in_row = 0
                continue
            self.skipped += 1
            self.skipped_in_row += 1
            if self.ema is not None:
                self.ema.updates -= 1
            if self.log is not None:
                what = "gradient" if math.isfinite(total) else "loss"
                self.log.warn(step, f"step {step} skipped: its {what} is not finite")
            if self.skipped_in_row >= MAX_SKIPPED:
                raise UserError(
                    f"{self.skipped_in_row} steps in a row were not finite (step {step}); "
                    "lower --lr, or resume from an older checkpoint"
                )
        return loss, norm

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
        if self.step == 0 and self.config.run.init:
            self._validate()
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
                if late and self.log is not None and self.step < (self.total or 0):
                    line = f"--minutes ends the run at step {self.step} of {self.total}, "
                    self.log.warn(self.step, line + "before the learning rate's schedule ends")
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
            save_model(self.config.run.out / "model.safetensors", [*self.models.values()][-1])
        return 0

    def _after_step(self, figures: dict[str, float], bar: tqdm) -> None:
        run, minutes = self.config.run, self.config.length.minutes
        if minutes is None:
            bar.update(1)
        self._name_failures()
        if self.log is not None and figures:
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
            if self.log is None or self.data.held_out is None:
                return
            if self.data.seen is not None:
                self._figures_of("seen", "training objects", self.data.seen)
            figures, rows = self._figures_of("val", "validation", self.data.held_out)
            if not rows:
                self.log.warn(self.step, "no validation: none of its objects can be read")
                return
            score = figures.get("psnr_novel", figures["psnr_input"])
            self._keep_best(Score(self.step, score))
            path = self.config.run.out / "samples" / f"step_{self.step:06d}.png"
            self.log.sample(self.step, path, rows)

        self.world.on_main(validate_all)

    def _figures_of(
        self, event: str, words: str, part: FixedObjects
    ) -> tuple[dict[str, float], list[Tensor]]:
        """Return the result of ``validate``, logged and printed; empty if no object is readable."""
        objective = Objective(self._weights(validates=True), self.lpips)
        best, size = [*self.models.values()][-1], self.config.views.size
        batches = fixed_batches(part, best.config, size, self._unread)
        figures, rows = validate(best, batches, objective, self.world.device)
        self._name_failures()
        if rows and self.log is not None:
            self.log.write(event, self.step, minutes=self.elapsed / 60, **figures)
            text = " ".join(f"{name} {value:.4g}" for name, value in figures.items())
            say(f"step {self.step}: {words} {text}")
        return figures, rows

    def _better(self, score: Score, name: str) -> bool:
        """True if a score is better than ``name``'s, or the first; False for NaN."""
        other = self.scores.get(name)
        return score.psnr == score.psnr and (other is None or score.psnr > other.psnr)

    def _keep_best(self, score: Score) -> None:
        """Write ``best.safetensors`` if a validation is better than all before."""
        assert self.log is not None
        if math.isfinite(score.psnr):
            self.scores.setdefault("first", score)
            self.scores["last"] = score
        if not self._better(score, "best"):
            return
        path = self.config.run.out / "best.safetensors"
        try:
            save_model(path, [*self.models.values()][-1])
        except UserError as error:  # the run continues; a later write may succeed
            self.log.warn(self.step, str(error))
            return
        self.scores["best"] = score
        self.log.write("best", self.step, minutes=self.elapsed / 60, psnr=score.psnr)

    def _compare_ends(self) -> None:
        """Name the best validation; warn if the last is worse than the first."""
        if self.log is None or "best" not in self.scores:
            return
        first, best, last = (self.scores.get(name) for name in ("first", "best", "last"))
        if first is not None and last is not None and first.psnr > last.psnr:
            self.log.warn(
                self.step,
                f"the last validation is worse than the first: PSNR {last}, {first}; "
                f"best.safetensors has {best}",
            )
        else:
            say(f"best.safetensors: PSNR {best}; the last has {last}")

    def save(self) -> None:
        """Write a checkpoint on the main process, once per step; the others wait."""
        self._read_steps()

        def write() -> None:
            if self._saved != self.step:
                run = self.config.run
                save_checkpoint(run.out, self.step, self.models, self.state(), KEPT)
                self._saved = self.step

        self.world.on_main(write)

    def state(self) -> dict:
        """Return everything a resumed run needs besides the weights: tensors and plain values."""
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
            "optimizer": self.optimizer.state_dict(),
            "rng": torch.get_rng_state(),
            "rng_cuda": torch.cuda.get_rng_state_all() if torch.cuda.is_available() else [],
        }

    def restore(self, checkpoint: Path) -> str | None:
        """Continue from a checkpoint, bit-identically on one device.

        Returns:
            A line about the learning rate if the run has another length.

        Raises:
            UserError: the checkpoint is damaged, or belongs to a run with another configuration,
                data or number of objects a step; the message names the differing fields.
        """

        def read() -> tuple[Any, ...]:
            state, length = read_run(
                checkpoint, self.config, self.data.fingerprint, self.world.size
            )
            moments = checked_moments(self.optimizer, state.optimizer, checkpoint / "state.pt")
            files = {name: checkpoint / f"{name}.safetensors" for name in self.models}
            weights = {n: read_weights_of(files[n], model) for n, model in self.models.items()}
            return state, length, moments, weights

        # Everything is read and checked before anything is loaded. Only the main process reads, so
        # no shared disk is needed.
        state, length, moments, weights = self.world.on_main(read)
        old = replace(self._schedule(length), since=state.new_length)
        for name, model in self.models.items():
            model.load_stored_state(weights[name])
        if self.ema is not None:
            self.ema.updates = state.ema_updates
        self.optimizer.load_state_dict(moments)
        self.step, self.skipped = state.step, state.skipped
        self.skipped_in_row, self.elapsed = state.skipped_in_row, state.elapsed
        self.scores = {name: Score(*score) for name, score in state.scores.items()}
        self.schedule, note = self.schedule.after(old, self.step, self.elapsed)
        self.total = self.schedule.total
        self._batches.last = None if self.total is None else self.total * self.accumulate
        self._saved = self.step if checkpoint.parent.parent == self.config.run.out else -1
        torch.set_rng_state(state.rng)
        if len(state.rng_cuda) == torch.cuda.device_count():
            torch.cuda.set_rng_state_all(state.rng_cuda)
        return note
