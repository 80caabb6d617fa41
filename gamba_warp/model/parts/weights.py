"""Initial weights of the network's parts."""

from __future__ import annotations

from torch import Tensor, nn


def init_normal(weight: Tensor, std: float) -> None:
    """Draw a weight from a normal distribution of mean 0.

    On the meta device nothing is drawn: torch's first draw there takes seconds.
    """
    if not weight.is_meta:
        nn.init.normal_(weight, std=std)
