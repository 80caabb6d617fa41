"""Gamba: one image to 3D Gaussians, with NVIDIA Warp kernels."""

from pathlib import Path

from .versions import __version__

_root = Path(__file__).resolve().parent.parent
if (_root / "setup.cfg").is_file():  # a checkout: sub-packages sit beside this folder
    __path__.append(str(_root))

__all__ = ["__version__"]
