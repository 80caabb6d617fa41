"""Operators of torch that cost little to call."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from operator import attrgetter
from typing import Any

import torch
from torch import Tensor
from torch.autograd import forward_ad

_PLAIN = {Tensor, torch.nn.Parameter}
_is_meta = attrgetter("is_meta")


def _tensors(values: Sequence[Any]) -> list[Tensor]:
    """The tensors among arguments and within their lists."""
    tensors = []
    for x in values:
        if isinstance(x, Tensor):
            tensors.append(x)
        elif isinstance(x, (list, tuple)):
            tensors += _tensors(x)
    return tensors


def has_tangent(*values: Any) -> bool:
    """True if a tensor carries a tangent, of ``torch.func.jvp`` or of a dual number."""
    if forward_ad._current_level < 0:  # outside of forward mode
        return False
    return any(forward_ad.unpack_dual(x).tangent is not None for x in _tensors(values))


def _needs_dispatcher(tensors: Sequence[Tensor]) -> bool:
    """True under a compiler, mode, transform, tracer or profiler, or for other kinds of tensors."""
    return (
        torch.compiler.is_compiling()
        or torch.autograd._profiler_enabled()  # pyright: ignore[reportPrivateImportUsage]
        or torch._C._len_torch_dispatch_stack() > 0
        or torch._C._are_functorch_transforms_active()
        or torch._C._get_tracing_state() is not None
        or not _PLAIN.issuperset(map(type, tensors))
        or any(map(_is_meta, tensors))
    )


def operator(
    op: Any,
    name: str,
    setup_context: Callable[..., None] | None = None,
    backward: Callable[..., Any] | None = None,
) -> Any:
    """Register a gradient, and return a function that calls the operator directly where it can.

    torch's dispatcher takes longer to call an operator that is written in Python than a launch of
    its kernel takes, and its first call imports torch's compiler, which takes a second. So in eager
    mode the body is called directly, or from a ``torch.autograd.Function`` with the same gradient:
    126 µs in place of 178 for a small one with gradients. Compilers, modes, transforms and
    profilers see the registered operator.

    Args:
        op: a ``torch.library.custom_op`` with its fake results.
        name: of the public function, for messages.
        setup_context: as ``op.register_autograd`` takes it, like ``backward``.
        backward: None: the operator is not part of a graph, or its gradient has no gradient.

    Returns:
        A function of the same positional arguments. It raises ``NotImplementedError`` for a
        tangent, which the operator would drop in silence, so that the derivative were zero.
    """
    body, function = op._init_fn, None
    if setup_context is not None and backward is not None:
        op.register_autograd(backward, setup_context=setup_context)

        class Direct(torch.autograd.Function):
            @staticmethod
            def forward(ctx, *args):  # with a ``setup_context`` torch would inspect its signature
                output = body(*args)
                setup_context(ctx, args, output)
                return output

            @staticmethod
            def backward(ctx, *cotangents):
                # torch.autograd.Function wants None for a list, the operator a list
                grads = backward(ctx, *cotangents)
                return tuple(None if isinstance(g, list) else g for g in grads)

        function = Direct.apply

    def call(*args: Any) -> Any:
        tensors = _tensors(args)
        if has_tangent(*tensors):
            raise NotImplementedError(
                f"{name}: forward-mode derivatives (torch.func.jvp, jacfwd, dual numbers) are not "
                "supported; only backward() is"
            )
        if _needs_dispatcher(tensors):
            return op(*args)
        if torch.is_grad_enabled() and any(x.requires_grad for x in tensors):
            return op(*args) if function is None else function(*args)
        return body(*args)

    return call
