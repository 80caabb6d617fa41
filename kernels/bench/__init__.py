"""Benchmarks of run time against error: cases, and how they are measured, for ``gamba bench``."""

from .core.case import (
    BOTH,
    DIRECTIONS,
    LEVELS,
    Case,
    Error,
    Key,
    NotInstalled,
    Settings,
    Stopped,
    Target,
    Variant,
    compare,
)
from .core.measure import FORMAT, measure

__all__ = [
    "BOTH",
    "DIRECTIONS",
    "FORMAT",
    "LEVELS",
    "Case",
    "Error",
    "Key",
    "NotInstalled",
    "Settings",
    "Stopped",
    "Target",
    "Variant",
    "compare",
    "measure",
]
