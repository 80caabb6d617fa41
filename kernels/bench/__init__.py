"""Run time against error: what is measured, and how. ``gamba bench`` runs it."""

from .core.case import LEVELS, Case, Error, Key, NotInstalled, Settings, Target, Variant, compare
from .core.measure import FORMAT, measure

__all__ = [
    "FORMAT",
    "LEVELS",
    "Case",
    "Error",
    "Key",
    "NotInstalled",
    "Settings",
    "Target",
    "Variant",
    "compare",
    "measure",
]
