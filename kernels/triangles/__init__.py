"""Triangles of one mesh that cut each other."""

from .function import cuts_itself

__all__ = ["cuts_itself"]
