"""Strategies of an installed gsplat, for any device."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from gsplat.strategy import DefaultStrategy, Strategy
from gsplat.strategy import MCMCStrategy as _MCMCStrategy

from .relocation import torch_strategies

__all__ = ["DefaultStrategy", "MCMCStrategy", "Strategy"]


@dataclass
class MCMCStrategy(_MCMCStrategy):
    """gsplat's ``MCMCStrategy`` without its CUDA extension: see ``relocation.torch_strategies``.

    Options, state and steps are gsplat's.
    """

    def step_post_backward(self, *args: Any, **kwargs: Any) -> None:
        """Like gsplat's, with the same arguments."""
        with torch_strategies():
            super().step_post_backward(*args, **kwargs)
