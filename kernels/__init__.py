"""Mamba's selective scan and causal convolution, and a Gaussian rasterizer, in NVIDIA Warp.

The public functions load when they are used. ``selective_scan`` and ``causal_conv1d`` are also
folders: their modules are imported by ``from gamba_warp.kernels.selective_scan import reference``.
"""

from typing import TYPE_CHECKING

from .lazy import load_when_used

if TYPE_CHECKING:
    from .causal_conv1d import causal_conv1d, causal_conv1d_fn
    from .rasterize import Skip, rasterization
    from .selective_scan import selective_scan, selective_scan_fn, selective_scan_state

__all__ = [
    "Skip",
    "causal_conv1d",
    "causal_conv1d_fn",
    "rasterization",
    "selective_scan",
    "selective_scan_fn",
    "selective_scan_state",
]

load_when_used(
    __name__,
    {
        "Skip": ".rasterize",
        "causal_conv1d": ".causal_conv1d",
        "causal_conv1d_fn": ".causal_conv1d",
        "rasterization": ".rasterize",
        "selective_scan": ".selective_scan",
        "selective_scan_fn": ".selective_scan",
        "selective_scan_state": ".selective_scan",
    },
)
