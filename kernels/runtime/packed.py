"""Packed rows: several sequences one after the other in a row of tokens, as the kernels take them.

A list of sequences is an int32 tensor ``[S, 3]`` on the tokens' device: for each its row of the
batch, its first token, and the token behind its last. They follow one another and leave no token
out.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

_DTYPES = (torch.int32, torch.int64)


class Packed(NamedTuple):
    """Sequences of one packed row, for several calls of operators; its values are not checked.

    Attributes:
        cu_seqlens: ``[S + 1]`` int64, ascending from 0 to L.
        rows: ``[S, 3]`` int32, the list of sequences.
    """

    cu_seqlens: Tensor
    rows: Tensor

    @classmethod
    def of(cls, cu_seqlens: Tensor) -> Packed:
        """Make the list of sequences of their borders."""
        begins, ends = cu_seqlens[:-1], cu_seqlens[1:]
        return cls(cu_seqlens, torch.stack([torch.zeros_like(begins), begins, ends], 1).int())


def sequences(
    x: Tensor, cu_seqlens: Tensor | Packed | None, seq_idx: Tensor | None
) -> Tensor | None:
    """The list of sequences of a call, or None where each row is one.

    Args:
        x: ``[B, L, D]``, the tokens.
        cu_seqlens: ``[S + 1]`` int32 or int64, ascending from 0 to L, where B is 1: sequence s has
            the tokens from ``cu_seqlens[s]`` to before ``cu_seqlens[s + 1]``, perhaps none. On CUDA
            the values are not looked at, which would wait for the device, but bounded: by 0, L and
            those before them. Results of tokens in no sequence are then undefined. Or a
            ``Packed``, which costs no further operation.
        seq_idx: ``[B, L]`` int32 or int64: a sequence is a run of equal numbers in a row. To find
            the runs waits for a CUDA device.

    Raises:
        TypeError: an argument is not a dense tensor, or of another dtype.
        ValueError: both are given, a shape or device differs, ``cu_seqlens`` falls, does not begin
            at 0 or end at L, or ``seq_idx`` repeats an earlier number of its row.
    """
    if cu_seqlens is None and seq_idx is None:
        return None
    if cu_seqlens is not None and seq_idx is not None:
        raise ValueError("pass either cu_seqlens or seq_idx, got both")
    batch, length = x.shape[:2]
    if isinstance(cu_seqlens, Packed) and seq_idx is None:
        return cu_seqlens.rows
    name, given = ("seq_idx", seq_idx) if cu_seqlens is None else ("cu_seqlens", cu_seqlens)
    if not isinstance(given, Tensor):
        raise TypeError(f"{name} must be a tensor, got {type(given).__name__}")
    if given.layout != torch.strided:
        raise TypeError(f"{name} must be dense (torch.strided), got {given.layout}")
    if given.dtype not in _DTYPES:
        raise TypeError(f"{name} must have dtype {', '.join(map(str, _DTYPES))}, got {given.dtype}")
    if given.device != x.device:
        raise ValueError(f"{name} must be on {x.device}, as the tokens, got {given.device}")
    if cu_seqlens is None:
        if tuple(given.shape) != (batch, length):
            raise ValueError(f"seq_idx must have shape {(batch, length)}, got {tuple(given.shape)}")
        return _runs(given)
    if given.dim() != 1 or len(given) == 0 or batch != 1:
        raise ValueError(
            "cu_seqlens must have shape [S + 1] with one row of tokens, "
            f"got {tuple(given.shape)} with {batch}"
        )
    if given.device.type == "cpu" and not torch.compiler.is_compiling():
        first, last, fall = int(given[0]), int(given[-1]), (given.diff() < 0).nonzero()
        if first or last != length:
            raise ValueError(f"cu_seqlens goes from {first} to {last}, must go from 0 to {length}")
        if len(fall):
            s = int(fall[0])
            raise ValueError(f"cu_seqlens decreases from {given[s]} to {given[s + 1]} at {s + 1}")
    ends = given.clamp(0, length).int().cummax(0).values  # no two sequences have a token in common
    begins = ends[:-1]
    return torch.stack([torch.zeros_like(begins), begins, ends[1:]], 1)


def _runs(seq_idx: Tensor) -> Tensor:
    length = seq_idx.shape[1]
    new = torch.ones_like(seq_idx, dtype=torch.bool)
    new[:, 1:] = seq_idx[:, 1:] != seq_idx[:, :-1]
    row, begin = new.nonzero().unbind(1)
    of_row = torch.stack([row, seq_idx[row, begin].long()], 1)
    if len(of_row.unique(dim=0)) < len(of_row):
        values, counts = of_row.unique(dim=0, return_counts=True)
        b, number = values[counts > 1][0].tolist()
        raise ValueError(f"seq_idx of row {b} repeats {number}; equal numbers must be contiguous")
    last = torch.cat([row[1:] != row[:-1], torch.ones_like(row[:1], dtype=torch.bool)])
    end = torch.where(last, length, torch.cat([begin[1:], begin[:1]]))
    return torch.stack([row, begin, end], 1).int()


def slots(rows: Tensor, length: int, tokens: int) -> Tensor:
    """Upper bounds of the slots, of ``tokens`` tokens each, before each sequence: ``[S]``.

    Sequence s needs a slot for each ``tokens`` tokens, from its first token on. There are
    ``count_slots`` in all, whatever the values, so no call waits for these.

    Args:
        rows: the sequences.
        length: L, tokens of a row.
        tokens: of a slot.
    """
    at = rows[:, 0] * length + rows[:, 1]
    return (at // tokens + torch.arange(len(rows), device=rows.device)).int()


def count_slots(rows: Tensor, batch: int, length: int, tokens: int) -> int:
    """Total number of slots; a sequence's last slot may be unused."""
    return batch * length // tokens + len(rows)


def pieces(rows: Tensor, batch: int, length: int, tokens: int) -> Tensor:
    """The slots: ``[P, 5]`` int32, each its sequence's row, begin and end, its own first token, and
    the sequence, which is -1 where it has no token.
    """
    first = slots(rows, length, tokens)
    p = torch.arange(count_slots(rows, batch, length, tokens), device=rows.device)
    s = torch.searchsorted(first.long(), p, right=True) - 1
    own = rows[s].long()
    t0 = own[:, 1] + (p - first[s]) * tokens
    s = torch.where(t0 < own[:, 2], s, -1)
    return torch.cat([own, t0[:, None], s[:, None]], 1).int()
