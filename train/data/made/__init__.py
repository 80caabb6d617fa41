"""Procedural objects from a seed: toys, animals, shoes, bags, tools, packages, furniture.

Each is a union of solids, so it is closed and has a volume. Objects come from plans, which assemble
typical parts, and from free compositions. y is up, the front looks along +z. All are CC0.
"""

from __future__ import annotations

from .objects import make_files, make_object

__all__ = ["make_files", "make_object"]
