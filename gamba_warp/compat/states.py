"""What both updates of a state share: checks of tensors, and the rows that indices choose."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import TypeVar, cast

import torch
from torch import Tensor

_Function = TypeVar("_Function", bound=Callable)

DTYPES = (torch.float32, torch.bfloat16, torch.float16)
INDEX_DTYPES = (torch.int32, torch.int64)


def without_gradient(function: _Function) -> _Function:
    """Runs a function under ``no_grad``, at no cost where that is so already: a step takes it."""

    @wraps(function)
    def run(*args, **kwargs):
        if not torch.is_grad_enabled():
            return function(*args, **kwargs)
        with torch.no_grad():
            return function(*args, **kwargs)

    return cast(_Function, run)


def check_tensors(shapes: dict[str, tuple[Tensor | None, tuple[int, ...]]]) -> None:
    """Checks tensors against the shapes that they must have; None is no tensor, and right.

    Args:
        shapes: by name a tensor, or None, and its shape.

    Raises:
        TypeError: a value is no tensor, or is not float32, bfloat16 or float16.
        ValueError: a tensor has another shape.
    """
    for name, (x, shape) in shapes.items():
        if x is None:
            continue
        check_dtype(name, x)
        if x.shape != shape:
            raise ValueError(f"{name} has shape {tuple(x.shape)}, must be {tuple(shape)}")


def check_dtype(name: str, x: Tensor, dtypes: tuple[torch.dtype, ...] = DTYPES) -> None:
    """Checks that ``x`` is a tensor of one of the dtypes.

    Raises:
        TypeError: it is not.
    """
    if not isinstance(x, Tensor):
        raise TypeError(f"{name} is {type(x).__name__}, must be a tensor")
    if x.dtype not in dtypes:
        raise TypeError(f"{name} has dtype {x.dtype}, allowed: {', '.join(map(str, dtypes))}")


def check_indices(name: str, indices: Tensor, batch: int) -> None:
    """Checks the numbers of rows or of tokens, one for each element of the batch.

    Raises:
        TypeError: they are no int32 or int64 tensor.
        ValueError: they have another shape than ``(batch,)``.
    """
    check_dtype(name, indices, INDEX_DTYPES)
    if indices.shape != (batch,):
        raise ValueError(f"{name} has shape {tuple(indices.shape)}, must be {(batch,)}")


def take_rows(state: Tensor, indices: Tensor) -> Tensor:
    """The rows of ``state`` that the indices name, copied; row 0 for an index below 0.

    Args:
        state: ``[rows, ..]``.
        indices: ``[batch]`` int32 or int64; below 0 is padding.

    Returns:
        ``[batch, ..]``.
    """
    return state.index_select(0, indices.clamp(min=0))


def put_rows(state: Tensor, indices: Tensor, rows: Tensor, out: Tensor) -> Tensor:
    """Writes rows back into ``state``, those of padding excepted.

    Args:
        state: ``[rows, ..]``, updated in place.
        indices: ``[batch]``, as ``take_rows``.
        rows: ``[batch, ..]``, in any float dtype.
        out: ``[batch, ..]``, the output that belongs to the rows.

    Returns:
        ``out`` with zeros for padding.
    """
    padding = indices < 0
    if not padding.any():
        state.index_copy_(0, indices.long(), rows.to(state.dtype))
        return out
    kept = ~padding
    state.index_copy_(0, indices[kept].long(), rows[kept].to(state.dtype))
    return out.masked_fill(padding.view(-1, *[1] * (out.dim() - 1)), 0)
