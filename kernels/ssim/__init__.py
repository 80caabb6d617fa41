"""1 - SSIM of pictures with its gradient."""

from .api import dissimilarity

__all__ = ["dissimilarity"]
