"""Caches of a model between tokens."""

from __future__ import annotations

from dataclasses import dataclass, field

from torch import Tensor


@dataclass
class InferenceParams:
    """Caches of all layers, and the position of the generation.

    Attributes:
        max_seqlen: largest number of tokens; unused.
        max_batch_size: largest batch size; unused.
        seqlen_offset: tokens so far, advanced by the caller. At 0 a layer starts afresh.
        batch_size_offset: unused.
        key_value_memory_dict: states of the layers by ``layer_idx``.
        lengths_per_sample: ``[B]``, or None; unused.
    """

    max_seqlen: int
    max_batch_size: int
    seqlen_offset: int = 0
    batch_size_offset: int = 0
    key_value_memory_dict: dict = field(default_factory=dict)
    lengths_per_sample: Tensor | None = None

    def reset(self, max_seqlen: int, max_batch_size: int) -> None:
        """Return to the first token, which overwrites the caches."""
        self.max_seqlen, self.max_batch_size = max_seqlen, max_batch_size
        self.seqlen_offset = 0
        if self.lengths_per_sample is not None:
            self.lengths_per_sample.zero_()
