"""Mamba's selective scan and its causal convolution, on CUDA and on the CPU."""

from .function import selective_scan

__all__ = ["selective_scan"]
