"""Procedural objects from a seed: compositions of random parts.

Each is a union of solids, so it is closed and has a volume. y is up, the front looks along +z. All
are CC0.
"""

from __future__ import annotations

from .objects import make_files, make_object

__all__ = ["make_files", "make_object"]
