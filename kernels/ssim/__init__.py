"""1 - SSIM of pictures with its gradient."""

from .function import dissimilarity

__all__ = ["dissimilarity"]
