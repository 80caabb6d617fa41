"""What the interfaces share: checks, which name the argument in one line, and rows of states."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

DTYPES = (torch.float32, torch.bfloat16, torch.float16)
INDEX_DTYPES = (torch.int32, torch.int64)
MAX_SIDE = 2**15  # pixels of a picture

Shape = tuple["int | str", ...]


def check_tensor(
    name: str,
    value: Any,
    *shapes: Shape,
    dtypes: tuple[torch.dtype, ...] = (),
    optional: bool = False,
) -> None:
    """Refuses what is no tensor, or one of another shape or dtype.

    Args:
        name: of the argument.
        value: what it got.
        shapes: those that it may have, all if there are none. A word is any number, "S >= 3" one
            from 3 on, and ".." in the first place any number of dimensions.
        dtypes: those that it may have, all if there are none.
        optional: whether it may be None.

    Raises:
        TypeError: it is no tensor, or has another dtype.
        ValueError: it has another shape.
    """
    if optional and value is None:
        return
    if not isinstance(value, Tensor):
        raise TypeError(f"{name} is {type(value).__name__}, allowed is a tensor")
    if dtypes and value.dtype not in dtypes:
        raise TypeError(f"{name} has dtype {value.dtype}, allowed: {', '.join(map(str, dtypes))}")
    size = tuple(value.shape)
    if shapes and size not in shapes and not any(_fits(size, shape) for shape in shapes):
        allowed = " or ".join(f"[{', '.join(map(str, shape))}]" for shape in shapes)
        raise ValueError(f"{name} has shape {list(size)}, allowed is {allowed}")


def _fits(size: tuple[int, ...], shape: Shape) -> bool:
    if shape[:1] == ("..",):
        shape = shape[1:]
        size = size[max(0, len(size) - len(shape)) :]
    return len(size) == len(shape) and all(
        n >= int(want.partition(" >= ")[2] or 0) if isinstance(want, str) else n == want
        for n, want in zip(size, shape)
    )


def one_of(name: str, value: Any, *allowed: Any) -> None:
    """Refuses an option at other values than the allowed ones.

    Raises:
        ValueError: it has another value.
    """
    if isinstance(value, Tensor) or value not in allowed:
        got = "a tensor" if isinstance(value, Tensor) else repr(value)
        verdict = "which is not supported: allowed is" if len(allowed) == 1 else "allowed are"
        raise ValueError(f"{name} is {got}, {verdict} {', '.join(map(repr, allowed))}")


def positive(**numbers: float) -> None:
    """Refuses numbers that are not above 0, by their names.

    Raises:
        ValueError: one is not.
    """
    for name, value in numbers.items():
        if not value > 0:
            raise ValueError(f"{name} is {value}, allowed is > 0")


def side(**pixels: int) -> None:
    """Refuses sizes of a picture that are no integers from 1 to 32,768, by their names.

    Raises:
        ValueError: one is not.
    """
    for name, value in pixels.items():
        if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= MAX_SIDE:
            raise ValueError(f"{name} is {value!r}, allowed are integers from 1 to {MAX_SIDE}")


def one_device(tensors: dict[str, Any]) -> None:
    """Refuses tensors of several devices, or of one that has no kernels.

    Raises:
        ValueError: they are on more than one, or on one that is neither a CPU nor CUDA.
    """
    devices = {x.device for x in tensors.values() if isinstance(x, Tensor)}
    if len(devices) > 1 or not {device.type for device in devices} <= {"cpu", "cuda"}:
        names = ", ".join(sorted(map(str, devices)))
        raise ValueError(f"{', '.join(tensors)} are on {names}: allowed is one, cpu or cuda")


@torch.no_grad()
def of_rows(update: Callable[[Tensor], Tensor], state: Tensor, indices: Tensor | None) -> Tensor:
    """Updates those rows of a state that indices choose; returns what ``update`` returns for them.

    Args:
        update: takes ``[B, ..]`` rows, updates them in place and returns the output ``[B, ..]``.
        state: ``[rows, ..]``, updated in place.
        indices: ``[B]``; below 0 the output is 0 and no row is touched. Or None: all rows.
    """
    if indices is None:
        return update(state)
    rows, kept = state.index_select(0, indices.clamp(min=0)), indices >= 0
    out = update(rows)
    state.index_copy_(0, indices[kept].long(), rows[kept])
    return out.masked_fill(~kept.view(-1, *[1] * (out.dim() - 1)), 0)
