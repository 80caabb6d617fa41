"""Matrix products of a run, repeated alone: the time of blocks if everything else were free."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

_PRODUCTS = {
    name: getattr(torch.ops.aten, name).default for name in ("mm", "addmm", "bmm", "baddbmm")
}


class _Recorder(TorchDispatchMode):
    """Records the shapes of all matrix products."""

    def __init__(self) -> None:
        super().__init__()
        self.products: list[tuple[Callable, list[tuple]]] = []

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        if function in _PRODUCTS.values():
            operands = [x for x in args if isinstance(x, Tensor)]
            self.products.append((function, [(x.shape, x.stride(), x.dtype) for x in operands]))
        return function(*args, **(kwargs or {}))


class Products:
    """The matrix products of a run, recorded so that they can be repeated alone.

    Attributes:
        count: number of products.
        flops: floating-point operations of all; a multiplication and an addition count as two.
    """

    def __init__(self, run: Callable[[], object], device: torch.device) -> None:
        with _Recorder() as recorder:
            run()
        self.count, self.flops = len(recorder.products), 0
        self._calls, self._device = [], device
        self._buffers: dict[tuple, Tensor] = {}
        for function, operands in recorder.products:
            tensors = [self._buffer(*operand, use=i) for i, operand in enumerate(operands)]
            a, b = tensors[-2:]
            shape = (*a.shape[:-1], b.shape[-1])
            self.flops += 2 * a.numel() * b.shape[-1]
            stride = torch.empty(shape, device="meta").stride()
            out = self._buffer(shape, stride, a.dtype, use=-1)
            name = function.overloadpacket.__name__
            self._calls.append(partial(getattr(torch, name), *tensors, out=out))

    def _buffer(self, shape, stride, dtype, use: int) -> Tensor:
        """Return a tensor of this shape; operands of the same shape and position share one."""
        key = (tuple(shape), tuple(stride), dtype, use)
        if key not in self._buffers:
            x = torch.empty_strided(shape, stride, dtype=dtype, device=self._device)
            self._buffers[key] = x.normal_()
        return self._buffers[key]

    def work(self) -> dict[str, int]:
        """Counts of the products."""
        return {"products": self.count, "flops": self.flops}

    @torch.no_grad()
    def run(self) -> None:
        """Repeat all products, with the library of the model; timed."""
        for call in self._calls:
            call()
