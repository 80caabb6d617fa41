"""mamba-ssm's public names for Mamba-1 over our kernels, on CUDA and on plain CPUs."""

from ..causal_conv1d import causal_conv1d_fn, causal_conv1d_update
from .modules.mamba_simple import Mamba
from .ops.selective_scan_interface import (
    mamba_inner_fn,
    mamba_inner_ref,
    selective_scan_fn,
    selective_scan_ref,
)
from .ops.triton.selective_state_update import selective_state_update, selective_state_update_ref
from .utils.generation import InferenceParams

__all__ = [
    "InferenceParams",
    "Mamba",
    "causal_conv1d_fn",
    "causal_conv1d_update",
    "mamba_inner_fn",
    "mamba_inner_ref",
    "selective_scan_fn",
    "selective_scan_ref",
    "selective_state_update",
    "selective_state_update_ref",
]
