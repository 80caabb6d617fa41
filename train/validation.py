"""Validation of a run: its figures, its best weights, and sample images."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable

import torch
from torch import Tensor

from gamba_warp.cameras import view_angles
from gamba_warp.conventions import GROUNDS, WHITE, over_another, over_background
from gamba_warp.errors import UserError
from gamba_warp.image_metrics import all_figures, mask_iou, measure
from gamba_warp.model.checkpoint import save_model
from gamba_warp.model.gamba import Gamba

from .batches import FixedObjects, TrainingData, fixed_batches
from .checkpoint import RunState, Score
from .config import TrainConfig
from .data.samples import Batch
from .log import RunLog, say
from .objective.losses import Progress, term_weights, translucency
from .step import Objective, StepResult, forward

FAR_VIEW, CLEAR = 60.0, 0.02  # degrees; alpha: see ``_far_figures``
STRIP_VIEWS, STRIP_OBJECTS = 6, 4  # views and objects of the sample images


class Validator:
    """Validations of a run, on its main process.

    Attributes:
        failures: reasons by uid, of the objects that could not be read.
    """

    def __init__(
        self,
        config: TrainConfig,
        data: TrainingData,
        lpips: Callable[[Tensor, Tensor], Tensor] | None,
        log: RunLog,
    ) -> None:
        self.config, self.data, self.lpips, self.log = config, data, lpips, log
        self.failures: dict[str, str] = {}

    def run(self, state: RunState, progress: Progress) -> None:
        """Validate the averaged weights: log figures, draw samples, write ``best.safetensors``.

        Args:
            state: of the run; its scores are updated.
            progress: of the run.
        """
        if self.data.held_out is None:
            return
        weights = term_weights(self.config.loss, progress._replace(validates=True))
        objective = Objective(weights, self.lpips)
        if self.data.seen is not None:
            self._figures("seen", "training objects", self.data.seen, state, objective)
        held_out = self.data.held_out
        figures, rows = self._figures("val", "validation", held_out, state, objective)
        if not rows:
            self.log.warn(state.step, "no validation: none of its objects can be read")
            return
        self._keep_best(state, Score(state.step, figures.get("psnr_novel", figures["psnr_input"])))
        path = self.config.run.out / "samples" / f"step_{state.step:06d}.png"
        self.log.sample(state.step, path, rows)

    def _figures(
        self, event: str, title: str, part: FixedObjects, state: RunState, objective: Objective
    ) -> tuple[dict[str, float], list[Tensor]]:
        """Return the result of ``validate``, logged and printed; empty if no object is readable."""
        model, size = state.result, self.config.views.size
        batches = fixed_batches(part, model.config, size, self.failures)
        figures, rows = validate(model, batches, objective, next(model.parameters()).device)
        self.log.warn_of_objects(state.step, self.failures)
        if rows:
            self.log.write(event, state.step, minutes=state.elapsed / 60, **figures)
            text = " ".join(f"{name} {value:.4g}" for name, value in figures.items())
            say(f"step {state.step}: {title} {text}")
        return figures, rows

    def _keep_best(self, state: RunState, score: Score) -> None:
        """Record a score, and write ``best.safetensors`` if it is the best so far."""
        if not math.isfinite(score.psnr):
            return
        state.scores.setdefault("first", score)
        state.scores["last"] = score
        if "best" in state.scores and score.psnr <= state.scores["best"].psnr:
            return
        try:
            save_model(self.config.run.out / "best.safetensors", state.result)
        except UserError as error:  # the run continues; a later write may succeed
            self.log.warn(state.step, str(error))
            return
        state.scores["best"] = score
        self.log.write("best", state.step, minutes=state.elapsed / 60, psnr=score.psnr)

    def conclude(self, state: RunState) -> None:
        """Print the best score; warn if the last is worse than the first."""
        if not {"first", "best", "last"} <= state.scores.keys():
            return
        first, best, last = (state.scores[name] for name in ("first", "best", "last"))
        if first.psnr > last.psnr:
            line = f"the last validation is worse than the first: PSNR {last}, {first}; "
            self.log.warn(state.step, f"{line}best.safetensors has {best}")
        else:
            say(f"best.safetensors: PSNR {best}; the last has {last}")


@torch.no_grad()
def validate(
    model: Gamba, batches: Iterable[Batch], objective: Objective, device: torch.device
) -> tuple[dict[str, float], list[Tensor]]:
    """Compute the validation's figures, as means over objects in float32.

    Args:
        model: the model; switched to eval mode, and back.
        batches: batches of one object each on white, the input view first, from
            ``fixed_batches``.
        objective: as for ``forward``.
        device: the model's device.

    Returns:
        Figures: ``loss``; ``psnr`` (dB), ``ssim``, ``mask_iou`` and, if given, ``lpips`` of whole
        images on white; ``psnr_black`` and ``psnr_grey`` on these backgrounds (LPIPS on them
        would nearly triple the time). All but ``loss`` end in ``_input`` for the input view and
        ``_novel`` for the mean over the others, if any; images under 11x11 have no ``ssim``.
        And rows ``[V, H, W, 3]`` for ``strip_of``: of the first objects ground truth, prediction.
    """
    was_training = model.training
    model.eval()
    sums: dict[str, list[float]] = {}
    rows: list[Tensor] = []
    for batch in batches:
        batch = batch.to(device)
        result = forward(model, batch, objective)
        measures = _measures(result, batch, objective.lpips)
        figures = {"loss": result.loss.item()}
        for key, values in measures.items():
            figures[f"{key}_input"] = values[0].item()
            if len(values) > 1:
                figures[f"{key}_novel"] = values[1:].mean().item()
        figures |= _far_figures(result, batch, objective.lpips)
        for name, value in figures.items():
            sums.setdefault(name, []).append(value)
        if len(rows) < 2 * STRIP_OBJECTS:
            rows += [result.target[0, :STRIP_VIEWS], result.rgb[0, :STRIP_VIEWS]]
    model.train(was_training)
    return {name: sum(values) / len(values) for name, values in sums.items()}, rows


def _far_figures(
    result: StepResult, batch: Batch, lpips: Callable[[Tensor, Tensor], Tensor] | None
) -> dict[str, float]:
    """Figures of views of one object more than ``FAR_VIEW`` degrees from the input; may be empty.

    ``translucency_far`` is the mean over pixels that are not clear: of rendered alpha, which shows
    a body of many faint Gaussians, and for scale of true alpha. LPIPS is on grey and on black.
    """
    far = view_angles(batch.cameras)[0] > FAR_VIEW
    if not far.any():
        return {}
    rgb, alpha, true = result.rgb[0][far], result.alpha[0][far], batch.targets[0][far]
    figures = {
        "mask_iou_far": mask_iou(alpha[..., 0] > 0.5, true[..., 3] > 0.5).mean().item(),
        "translucency_far": _mean_translucency(alpha[..., 0]),
        "translucency_far_true": _mean_translucency(true[..., 3]),
    }
    if lpips is not None:
        for name, grey in GROUNDS.items():
            got = over_another(rgb, alpha, WHITE, grey).clamp(0, 1)
            figures[f"lpips_{name}_far"] = lpips(got, over_background(true, grey)).mean().item()
    return figures


def _mean_translucency(alphas: Tensor) -> float:
    """Mean over views ``[V, H, W]`` of the mean over pixels that are not clear."""
    values = [translucency(a[a > CLEAR]).mean().item() for a in alphas if (a > CLEAR).any()]
    return sum(values) / max(1, len(values))


def _measures(
    result: StepResult, batch: Batch, lpips: Callable[[Tensor, Tensor], Tensor] | None
) -> dict[str, Tensor]:
    """Metrics of a validation object, each ``[V+1]``."""
    rgb, alpha, true = result.rgb[0], result.alpha[0], batch.targets[0]
    got, want = rgb.clamp(0, 1), result.target[0]

    def images(grey: float) -> tuple[Tensor, Tensor]:
        if grey == WHITE:
            return got, want
        return over_another(rgb, alpha, WHITE, grey).clamp(0, 1), over_background(true, grey)

    masks = alpha[..., 0] > 0.5, true[..., 3] > 0.5
    side = min(want.shape[-3:-1])
    keys = [key for key, metric in all_figures().items() if side >= metric.least_side]
    measures = measure(images, masks, keys)
    if lpips is not None:
        terms = result.terms
        measures["lpips"] = terms["lpips"][0] if "lpips" in terms else lpips(got, want)
    return measures
