"""Mamba's causal convolution, on CUDA and on the CPU."""

from .api import causal_conv1d, causal_conv1d_fn

__all__ = ["causal_conv1d", "causal_conv1d_fn"]
