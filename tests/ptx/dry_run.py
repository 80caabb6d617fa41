"""Lists of the kernels that operators launch on CUDA, found without a GPU.

The operators run on tensors that have a shape, a dtype and the device cuda, but no memory. Their
launches are recorded (``simulated.py``), so their own code chooses the kernels.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import NamedTuple
from unittest.mock import patch

import torch
import warp as wp
from torch import Tensor
from torch._library.custom_ops import OPDEFS
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.utils._python_dispatch import TorchDispatchMode

from gamba_warp.kernels.rasterize.cuda import capacity

from .simulated import simulated

_READ_BACK = (torch.ops.aten.item.default, torch.ops.aten._local_scalar_dense.default)
# The number of pairs, which the rasterizer reads back from the device, is taken to be this.
COUNT = 1 << 20
# The multiprocessors of the imagined device: an A100 has 108, an H100 or H200 has 132.
MULTIPROCESSORS = 132


class Launch(NamedTuple):
    """A kernel and the threads of its block."""

    kernel: wp.Kernel
    block: int


class _Inside(TorchDispatchMode):
    """Runs the body of our operators on fake tensors, in place of their fake results."""

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        if function in _READ_BACK:
            return COUNT
        body = OPDEFS.get(function.name()) if function.namespace == "gamba_warp" else None
        if body is None:
            return function(*args, **(kwargs or {}))
        with self:
            return body._init_fn(*args, **(kwargs or {}))


def can_dry_run() -> bool:
    """True if torch slices CUDA tensors without a GPU; older versions do not."""
    with FakeTensorMode():
        try:
            torch.empty(1, device="cuda")[:]
        except RuntimeError:  # the guard of the device asks the driver
            return False
    return True


@contextmanager
def dry_run() -> Iterator[list[Launch]]:
    """Make tensors on the device cuda fake, and only record launches on it, within the block.

    Yields the list of launches, which grows. Gradients come from ``run_backward``.
    """
    launches: list[Launch] = []

    def note(kernel, dim, arguments, block_dim: int, device) -> None:
        launches.append(Launch(kernel, block_dim))

    with (
        simulated(note, MULTIPROCESSORS),
        patch.object(Tensor, "data_ptr", lambda x: 0),
        patch.object(capacity, "is_capturing", lambda device: False),
        patch.object(capacity, "note_count", lambda key, device, count: None),
        FakeTensorMode(),
        _Inside(),
    ):
        yield launches


def run_backward(outputs: Sequence[Tensor]) -> None:
    """Compute all gradients of the outputs, node by node: torch's engine would ask for the GPU."""
    pending: dict = {}

    def give(node, index: int, gradient: Tensor | None) -> None:
        if node is None or gradient is None:
            return
        wanted = node._input_metadata[index].shape
        if gradient.shape != wanted:  # the engine undoes what broadcasting did
            gradient = gradient.sum_to_size(wanted)
        waiting = pending.setdefault(node, [None] * len(node._input_metadata))
        waiting[index] = gradient if waiting[index] is None else waiting[index] + gradient

    for x in outputs:
        give(x.grad_fn, x.output_nr, torch.ones_like(x))
    while pending:
        node = max(pending, key=lambda node: node._sequence_nr())
        gradients = pending.pop(node)
        if node.name() == "torch::autograd::AccumulateGrad":
            continue
        following, needed = node.next_functions, getattr(node, "needs_input_grad", None)
        if needed is None:  # a node of C++
            found = node(*gradients)
            found = found if isinstance(found, tuple) else (found,)
        else:
            following = [f for f in following if f[0] is not None]
            found = [x for x, asked in zip(node.apply(*gradients), needed) if asked]
        for (after, index), gradient in zip(following, found):
            give(after, index, gradient)


def launches_of(run: Callable[[], Sequence[Tensor]]) -> dict[str, list[Launch]]:
    """Return the distinct launches of ``run`` on CUDA: "forward", and "gradient" of its result."""
    with dry_run() as launches:
        outputs = run()
        forward = len(launches)
        run_backward([x for x in outputs if x.requires_grad])
    parts = {"forward": launches[:forward], "gradient": launches[forward:]}
    return {name: list(dict.fromkeys(part)) for name, part in parts.items()}
