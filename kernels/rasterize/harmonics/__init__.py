"""Colours from spherical harmonics, which depend on where they are seen from."""

from .autograd import colors_from_harmonics, colors_seen_from, sums_seen_from
from .formula import harmonics_basis

__all__ = ["colors_from_harmonics", "colors_seen_from", "harmonics_basis", "sums_seen_from"]
