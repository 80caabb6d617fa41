"""The differentiable Gaussian rasterizer."""

from .function import rasterization

__all__ = ["rasterization"]
