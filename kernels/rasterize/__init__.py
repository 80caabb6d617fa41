"""The differentiable Gaussian rasterizer."""

from .function import rasterization
from .quantile import depth_quantile
from .skip import Skip

__all__ = ["Skip", "depth_quantile", "rasterization"]
