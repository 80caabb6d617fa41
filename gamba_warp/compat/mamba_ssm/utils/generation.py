"""What a model remembers between the tokens that it generates."""

from __future__ import annotations

from dataclasses import dataclass, field

from torch import Tensor


@dataclass
class InferenceParams:
    """The caches of all layers, and how far a generation has come.

    Attributes:
        max_seqlen: number of tokens at most; nothing here needs it.
        max_batch_size: size of the batch at most; nothing here needs it.
        seqlen_offset: tokens seen so far; the caller raises it. At 0 a layer begins anew.
        batch_size_offset: nothing here needs it.
        key_value_memory_dict: by ``layer_idx`` the states of that layer.
        lengths_per_sample: ``[B]``, or None; nothing here needs it.
    """

    max_seqlen: int
    max_batch_size: int
    seqlen_offset: int = 0
    batch_size_offset: int = 0
    key_value_memory_dict: dict = field(default_factory=dict)
    lengths_per_sample: Tensor | None = None

    def reset(self, max_seqlen: int, max_batch_size: int) -> None:
        """Goes back to the first token; the caches stay, and are overwritten by it."""
        self.max_seqlen, self.max_batch_size = max_seqlen, max_batch_size
        self.seqlen_offset = 0
        if self.lengths_per_sample is not None:
            self.lengths_per_sample.zero_()
