"""Objects without end, made of a seed: toys, animals, shoes, bags, tools, packages, furniture.

Each is a union of solids, so that it is closed and has a volume; what it is made of comes from
plans, which build things as things are built, and from free compositions. y is up, the front looks
along +z. Nobody has rights in them.
"""

from __future__ import annotations

from .objects import make_files, make_object

__all__ = ["make_files", "make_object"]
