"""causal-conv1d's public names over our convolution, and its reference functions."""

from ..absent import complete
from .causal_conv1d_interface import (
    causal_conv1d_fn,
    causal_conv1d_ref,
    causal_conv1d_update,
    causal_conv1d_update_ref,
)

__all__ = [
    "causal_conv1d_fn",
    "causal_conv1d_ref",
    "causal_conv1d_update",
    "causal_conv1d_update_ref",
]

ABSENT = complete(
    __name__,
    "causal-conv1d",
    "causal_conv1d_fn and causal_conv1d_update are",
    {"causal_conv1d_interface": "CausalConv1dFn"},
)
