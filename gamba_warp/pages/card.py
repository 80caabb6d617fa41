"""Model cards: training data and metrics of a trained model.

A card is the file ``NAME.json`` next to the weights ``NAME.safetensors``. It is optional: pages of
a model without one state that its training is unknown.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import msgspec
from msgspec import Meta

from ..errors import UserError
from ..image_metrics import all_figures
from ..untrusted.documents import read_document

_LIMIT = 1 << 20  # bytes; a card usually has a few kB
_Text = Annotated[str, Meta(max_length=2000)]
_Count = Annotated[int, Meta(ge=0, le=10**12)]
_Name = Annotated[str, Meta(max_length=80)]
# Title and decimals of each metric.
METRICS = {
    **{key: (metric.head, metric.digits) for key, metric in all_figures().items()},
    "chamfer": ("Chamfer", 4),
    "normal_consistency": ("normal consistency", 3),
    "iou": ("Volume IoU", 3),
}


class Figure(msgspec.Struct, frozen=True, omit_defaults=True):
    """A mean over objects.

    Attributes:
        mean: of the objects' values.
        interval: its 95 % interval, or None.
    """

    mean: float
    interval: tuple[float, float] | None = None


class _Row(msgspec.Struct, frozen=True, omit_defaults=True):
    """Figures of a model or of a baseline: a field for each of ``METRICS``, None if not measured.

    Attributes:
        views: the compared views, or ``shape`` for the geometry.
        name: ``model``, or the baseline's name.
        objects: number of objects.
    """

    views: Literal["novel", "input", "shape"]
    name: _Name
    objects: _Count


if TYPE_CHECKING:

    class Row(_Row, frozen=True):
        """Type of the struct below."""

        def __getattr__(self, key: str) -> Figure | None: ...
else:
    _figures = [(key, Figure | None, None) for key in METRICS]
    Row = msgspec.defstruct("Row", _figures, bases=(_Row,), frozen=True, omit_defaults=True)


class ModelCard(msgspec.Struct, frozen=True):
    """Card of a trained model.

    Attributes:
        data: training data and its licences.
        objects: number of training objects.
        steps: number of optimizer steps.
        compute: time and machine.
        command: the training command.
        seed: of the training.
        use: intended use.
        limits: known weaknesses.
        measured: commands and data of the figures.
        figures: of the model and of the baselines.
    """

    data: _Text
    objects: _Count
    steps: _Count
    compute: _Text
    command: _Text
    seed: _Count
    use: _Text
    limits: Annotated[list[_Text], Meta(max_length=20)]
    measured: _Text = ""
    figures: Annotated[list[Row], Meta(max_length=100)] = []


def card_path(checkpoint: Path) -> Path:
    """Return the path of a model file's card, which may be missing."""
    return checkpoint.with_suffix(".json")


def read_card(checkpoint: Path) -> ModelCard | None:
    """Read the card of a model file.

    Args:
        checkpoint: the ``.safetensors`` file.

    Returns:
        The card, or None without one.

    Raises:
        UserError: the file is not a valid card.
    """
    path = card_path(checkpoint)
    return read_document(path, ModelCard, _LIMIT) if path.exists() else None


def about_model(checkpoint: Path) -> list[tuple[str, str]]:
    """Return labels and texts about a model for a page; an unreadable card is not an error.

    Args:
        checkpoint: the ``.safetensors`` file.
    """
    rows = [("Model", checkpoint.name)]
    try:
        card = read_card(checkpoint)
    except UserError:
        return [*rows, ("Trained on", f"not known: {card_path(checkpoint).name} is no model card")]
    if card is None:
        return [*rows, ("Trained on", "not known: this model has no card")]
    rows.append(("Trained on", card.data))
    rows.append(("Training", f"{card.objects:,} objects, {card.steps:,} steps; {card.compute}"))
    rows += [(f"Measured, {what}", text) for what, text in _in_short(card)]
    return [*rows, ("Meant for", card.use), ("Limits", " ".join(card.limits))]


def _in_short(card: ModelCard) -> Iterator[tuple[str, str]]:
    """Yield the model's figures, each with the best baseline's."""
    names = {"novel": "new views", "input": "input view", "shape": "shape"}
    for ours in card.figures:
        if ours.name != "model":
            continue
        others = [row for row in card.figures if row.views == ours.views and row is not ours]
        if ours.views == "input":
            others = []  # copying the input is trivial
        texts = []
        for key, (name, digits) in METRICS.items():
            value = getattr(ours, key)
            if value is None:
                continue
            metric = all_figures().get(key)
            pick = max if (metric.more_is_better if metric else key != "chamfer") else min
            known = [(figure.mean, row.name) for row in others if (figure := getattr(row, key))]
            best = pick(known, default=None)
            name, bracket, unit = name.partition(" [")
            unit = f" {unit[:-1]}" if bracket else ""
            beside = f" ({best[1]} {best[0]:.{digits}f})" if best else ""
            texts.append(f"{name} {value.mean:.{digits}f}{unit}{beside}")
        note = "; in brackets the best baseline" if others else ""
        yield names[ours.views], f"{', '.join(texts)}{note}. {ours.objects:,} objects."
