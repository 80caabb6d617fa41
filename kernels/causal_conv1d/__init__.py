"""Mamba's causal convolution, on CUDA and on the CPU."""

from .dropin import causal_conv1d_fn
from .function import causal_conv1d

__all__ = ["causal_conv1d", "causal_conv1d_fn"]
