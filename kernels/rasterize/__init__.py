"""The differentiable Gaussian rasterizer."""

from .function import rasterization
from .skip import Skip

__all__ = ["Skip", "rasterization"]
