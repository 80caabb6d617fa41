"""Studies of the project itself, measured by the clock of ``gamba bench``: ``make study``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from gamba_warp.kernels.bench.core.case import Settings


@dataclass(frozen=True)
class StudySettings(Settings):
    """What a run of studies was asked for.

    Attributes:
        data: folder of posed views for the cases of training; None: made-up views.
    """

    data: Path | None = None


def data_of(settings: Settings) -> Path | None:
    """The folder of posed views; None of a run that has no such choice."""
    return getattr(settings, "data", None)
