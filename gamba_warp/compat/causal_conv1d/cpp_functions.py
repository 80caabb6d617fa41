"""Calls of the extension module, under causal-conv1d's path."""

from ..extensions import conv_bwd as causal_conv1d_bwd_function
from ..extensions import conv_fwd as causal_conv1d_fwd_function
from ..extensions import conv_update as causal_conv1d_update_function

__all__ = [
    "causal_conv1d_bwd_function",
    "causal_conv1d_fwd_function",
    "causal_conv1d_update_function",
]
