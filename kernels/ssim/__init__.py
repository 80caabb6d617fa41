"""1 - SSIM of pictures with its gradient, on the CPU."""

from .function import dissimilarity

__all__ = ["dissimilarity"]
