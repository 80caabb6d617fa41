"""Studies of the project itself, measured by the clock of ``gamba bench``: ``make study``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from gamba_warp.kernels.bench.core.case import Settings


@dataclass(frozen=True)
class StudySettings(Settings):
    """Settings of a run of studies.

    Attributes:
        data: folder of posed views for the cases of training; None for made-up views.
    """

    data: Path | None = None
