"""Checks of arguments, and updates of rows of states, shared by the interfaces."""

from __future__ import annotations

import operator
from collections.abc import Callable
from inspect import Parameter, Signature, signature
from typing import Any

import torch
from torch import Tensor

DTYPES = (torch.float32, torch.bfloat16, torch.float16)
INDEX_DTYPES = (torch.int32, torch.int64)
MAX_SIDE = 2**15  # pixels of an image

Shape = tuple["int | str", ...]


def check_tensor(
    name: str,
    value: Any,
    *shapes: Shape,
    dtypes: tuple[torch.dtype, ...] = (),
    optional: bool = False,
) -> None:
    """Refuse a value that is not a tensor of an allowed shape and dtype.

    Args:
        name: of the argument.
        value: the argument.
        shapes: allowed ones; any by default. A word stands for any number, "S >= 3" for at least 3,
            and a leading ".." for any number of dimensions.
        dtypes: allowed ones; any by default.
        optional: None is allowed.

    Raises:
        TypeError: it is not a tensor, or has another dtype.
        ValueError: it has another shape.
    """
    if optional and value is None:
        return
    if not isinstance(value, Tensor):
        raise TypeError(f"{name} must be a tensor, got {type(value).__name__}")
    if dtypes and value.dtype not in dtypes:
        raise TypeError(f"{name} must have dtype {', '.join(map(str, dtypes))}, got {value.dtype}")
    size = tuple(value.shape)
    if shapes and size not in shapes and not any(_fits(size, shape) for shape in shapes):
        allowed = " or ".join(f"[{', '.join(map(str, shape))}]" for shape in shapes)
        raise ValueError(f"{name} must have shape {allowed}, got {list(size)}")


def _fits(size: tuple[int, ...], shape: Shape) -> bool:
    if shape[:1] == ("..",):
        shape = shape[1:]
        size = size[max(0, len(size) - len(shape)) :]
    return len(size) == len(shape) and all(
        n >= int(want.partition(" >= ")[2] or 0) if isinstance(want, str) else n == want
        for n, want in zip(size, shape)
    )


def one_of(name: str, value: Any, *allowed: Any) -> None:
    """Refuse a value of an option that is not allowed.

    Raises:
        ValueError: it has another value.
    """
    if isinstance(value, Tensor) or value not in allowed:
        got = "a tensor" if isinstance(value, Tensor) else repr(value)
        verdict = "is supported only as" if len(allowed) == 1 else "must be one of"
        raise ValueError(f"{name} {verdict} {', '.join(map(repr, allowed))}, got {got}")


def side(**pixels: Any) -> list[int]:
    """Return sizes of images or tiles as ints, given as any integers from 1 to 32,768.

    Raises:
        ValueError: one is not; numpy's integers and 0-d tensors of integers are.
    """
    sizes = []
    for name, value in pixels.items():
        try:
            number = 0 if isinstance(value, bool) else operator.index(value)
        except TypeError:
            number = 0
        if not 1 <= number <= MAX_SIDE:
            raise ValueError(f"{name} must be an integer from 1 to {MAX_SIDE}, got {value!r}")
        sizes.append(number)
    return sizes


def one_device(tensors: dict[str, Any]) -> None:
    """Refuse tensors on several devices, or on an unsupported one.

    Raises:
        ValueError: they are on more than one, or on one that is neither a CPU nor CUDA.
    """
    devices = {x.device for x in tensors.values() if isinstance(x, Tensor)}
    if len(devices) > 1 or not {device.type for device in devices} <= {"cpu", "cuda"}:
        names = ", ".join(f"{k} on {x.device}" for k, x in tensors.items() if isinstance(x, Tensor))
        raise ValueError(f"tensors must be on the same device, cpu or cuda, got {names}")


def with_order(function: Callable[..., Any], names: str, **fixed: Any) -> Callable[..., Any]:
    """Return a function whose parameters have another order, by place and to ``inspect``.

    Args:
        function: it takes all parameters by name.
        names: of the parameters in their order; others cannot be given.
        fixed: values of other parameters.
    """
    parameters = signature(function).parameters
    kind = Parameter.POSITIONAL_OR_KEYWORD
    order = Signature([parameters[name].replace(kind=kind) for name in names.split()])

    def call(*args: Any, **options: Any) -> Any:
        return function(**order.bind(*args, **options).arguments, **fixed)

    call.__doc__, call.__signature__ = function.__doc__, order  # pyright: ignore
    return call


@torch.no_grad()
def of_rows(update: Callable[[Tensor], Tensor], state: Tensor, indices: Tensor | None) -> Tensor:
    """Update selected rows of a state, and return the output of ``update`` for them.

    Args:
        update: updates rows ``[B, ..]`` in place and returns the output ``[B, ..]``.
        state: ``[rows, ..]``, updated in place.
        indices: ``[B]``; for negative ones the output is 0 and no row changes. None: all rows.
    """
    if indices is None:
        return update(state)
    rows, valid = state.index_select(0, indices.clamp(min=0)), indices >= 0
    out = update(rows)
    state.index_copy_(0, indices[valid].long(), rows[valid])
    return out.masked_fill(~valid.view(-1, *[1] * (out.dim() - 1)), 0)
