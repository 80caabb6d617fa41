"""The differentiable Gaussian rasterizer."""

from .api import rasterization
from .cuda.capacity import forget_graphs, lists_outgrown
from .quantile import depth_quantile
from .skip import Skip

__all__ = ["Skip", "depth_quantile", "forget_graphs", "lists_outgrown", "rasterization"]
