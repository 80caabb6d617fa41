"""Generation token by token, and the caches of a model between tokens."""

from __future__ import annotations

from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import torch
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


def sample(
    logits: Tensor, top_k: int = 1, top_p: float = 0.0, min_p: float = 0.0, temperature: float = 1.0
) -> Tensor:
    """Draw a token from ``logits [B, V]``: the largest if ``top_k`` is 1, one of all if it is 0.

    ``top_p`` keeps the most probable up to this sum, ``min_p`` those of this share of the largest.
    """
    if top_k == 1:
        return logits.argmax(-1)
    values, order = (logits / temperature).sort(descending=True)
    if top_k > 0:
        values[:, top_k:] = -torch.inf
    shares = values.softmax(-1)
    keep = shares >= min_p * shares[:, :1]
    if 0 < top_p < 1:
        keep &= shares.cumsum(-1) - shares < top_p
    return order.gather(1, torch.multinomial(shares * keep, 1))[:, 0]


@torch.no_grad()
def decode(
    input_ids: Tensor, model: Any, max_length: int, top_k: int = 1, top_p: float = 0.0,
    min_p: float = 0.0, temperature: float = 1.0, repetition_penalty: float = 1.0,
    eos_token_id: int | None = None, teacher_outputs: Tensor | None = None,
    vocab_size: int | None = None, cg=False, enable_timing=False, output_scores=False,
    streamer: Any = None,
) -> Any:  # fmt: skip
    """Continue prompts ``[B, L]`` to ``max_length`` tokens, or until all are ``eos_token_id``.

    Tokens come from ``teacher_outputs [B, ..]`` while it lasts, then from ``sample``. ``cg`` and
    ``enable_timing`` have no effect.

    Returns:
        ``sequences`` with the prompts, and ``scores``, the logits of each new token.
    """
    params = InferenceParams(max_length, len(input_ids))
    tokens, sequences, scores = input_ids, [input_ids], []
    while True:
        if streamer is not None:
            streamer.put(tokens.cpu())
        at = params.seqlen_offset
        at_ids = torch.full_like(tokens, at) if at else None
        given = {"position_ids": at_ids, "inference_params": params, "num_last_tokens": 1}
        logits = model(tokens, **given).logits[:, -1, :vocab_size]
        scores += [logits.clone()] if output_scores else []
        at = params.seqlen_offset = at + tokens.shape[1]
        if repetition_penalty != 1:
            said = torch.cat(sequences, 1)
            old = logits.gather(1, said)
            old = torch.where(old < 0, old * repetition_penalty, old / repetition_penalty)
            logits = logits.scatter(1, said, old)
        if teacher_outputs is not None and at < teacher_outputs.shape[1]:
            tokens = teacher_outputs[:, at : at + 1]
        else:
            tokens = sample(logits, top_k, top_p, min_p, temperature)[:, None]
        sequences.append(tokens)
        if at >= max_length - 1 or (eos_token_id is not None and (tokens == eos_token_id).all()):
            break
    if streamer is not None:
        streamer.put(tokens.cpu())
        streamer.end()
    return SimpleNamespace(sequences=torch.cat(sequences, 1), scores=tuple(scores) or None)


class GenerationMixin:
    """Add ``generate`` to a model with a cache."""

    def generate(self, input_ids: Tensor, max_length: int, *args: Any, **options: Any) -> Any:
        """Return the sequences of ``decode``; with ``return_dict_in_generate`` also the scores."""
        whole = options.pop("return_dict_in_generate", False)
        output = decode(input_ids, self, max_length, *args, **options)
        return output if whole else output.sequences
