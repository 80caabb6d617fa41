"""Mamba's selective scan and its causal convolution, on CUDA and on the CPU."""

from .conv import causal_conv1d
from .dropin import causal_conv1d_fn, selective_scan_fn
from .function import selective_scan, selective_scan_state

__all__ = [
    "causal_conv1d",
    "causal_conv1d_fn",
    "selective_scan",
    "selective_scan_fn",
    "selective_scan_state",
]
