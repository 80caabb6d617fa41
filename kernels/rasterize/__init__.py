"""The differentiable Gaussian rasterizer."""

from .cuda.capacity import lists_outgrown
from .function import rasterization
from .quantile import depth_quantile
from .skip import Skip

__all__ = ["Skip", "depth_quantile", "lists_outgrown", "rasterization"]
