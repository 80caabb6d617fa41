"""causal-conv1d's own signature and ``[B, D, L]`` layout over our convolution."""

from __future__ import annotations

import torch
from torch import Tensor

from ..runtime.views import tokens_first
from .function import causal_conv1d


def causal_conv1d_fn(
    x: Tensor,
    weight: Tensor,
    bias: Tensor | None = None,
    seq_idx: None = None,
    initial_states: Tensor | None = None,
    return_final_states: bool = False,
    final_states_out: Tensor | None = None,
    activation: str | None = None,
) -> Tensor | tuple[Tensor, Tensor]:
    """Does what causal-conv1d's ``causal_conv1d_fn`` does, with the same arguments and layout.

    Args:
        x: ``[B, D, L]`` float32, bfloat16 or float16.
        weight: ``[D, W]``, W from 2 to 4.
        bias: ``[D]``, or None.
        seq_idx: must be None.
        initial_states: ``[B, D, W-1]``, or None.
        return_final_states: also return ``[B, D, W-1]``.
        final_states_out: where to write the final states, or None.
        activation: None, "silu" or "swish".

    Returns:
        ``[B, D, L]`` in x's dtype, and the final states if asked for.

    Raises:
        TypeError: as ``causal_conv1d``.
        ValueError: as ``causal_conv1d``; also for a ``seq_idx``.
    """
    if seq_idx is not None:
        raise ValueError("seq_idx is given; packed sequences are not supported")
    out, final = causal_conv1d(
        tokens_first(x, "x"),
        weight,
        bias,
        activation=activation,
        initial_state=tokens_first(initial_states, "initial_states"),
        return_final_state=True,
    )
    out, final = out.transpose(1, 2), final.transpose(1, 2)
    if final_states_out is not None:
        with torch.no_grad():
            final_states_out.copy_(final)
    return (out, final) if return_final_states else out
