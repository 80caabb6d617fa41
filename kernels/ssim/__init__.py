"""1 - SSIM of images with its gradient."""

from .api import dissimilarity

__all__ = ["dissimilarity"]
