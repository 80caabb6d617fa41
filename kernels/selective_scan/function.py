"""The public scan: checks at the door, one torch operator with its gradient, a kernel by device."""

from __future__ import annotations

import torch
from torch import Tensor

from . import cpu

DTYPES = (torch.float32, torch.bfloat16, torch.float16)
DISCRETIZATIONS = ("mamba", "bilinear", "zoh")
MAX_STATES = 256


def _implementation(tensor: Tensor):
    if tensor.device.type == "cpu":
        return cpu
    from . import cuda

    return cuda


@torch.library.custom_op("gamba_warp::selective_scan", mutates_args=())
def _scan(
    u: Tensor,
    delta: Tensor,
    A: Tensor,
    B: Tensor,
    C: Tensor,
    D: Tensor | None,
    z: Tensor | None,
    delta_bias: Tensor | None,
    initial_state: Tensor | None,
    softplus: bool,
    discretization: str,
    save: bool,
) -> tuple[Tensor, Tensor, Tensor]:
    run = _implementation(u).forward
    return run(u, delta, A, B, C, D, z, delta_bias, initial_state, softplus, discretization, save)


@_scan.register_fake
def _(u, delta, A, B, C, D, z, delta_bias, initial_state, softplus, discretization, save):
    out = torch.empty_like(u, memory_format=torch.contiguous_format)
    last = A.new_empty(u.shape[0], *A.shape)
    return out, last, A.new_empty(_implementation(u).saved_shape(u, A, B, save))


@torch.library.custom_op("gamba_warp::selective_scan_backward", mutates_args=())
def _scan_backward(
    dout: Tensor,
    dlast: Tensor | None,
    u: Tensor,
    delta: Tensor,
    A: Tensor,
    B: Tensor,
    C: Tensor,
    D: Tensor | None,
    z: Tensor | None,
    delta_bias: Tensor | None,
    saved: Tensor,
    softplus: bool,
    discretization: str,
    needs: list[bool],
) -> list[Tensor]:
    run = _implementation(u).backward
    grads = run(
        dout, dlast, u, delta, A, B, C, D, z, delta_bias, saved, softplus, discretization, needs
    )
    return [grad for grad in grads if grad is not None]


@_scan_backward.register_fake
def _(dout, dlast, u, delta, A, B, C, D, z, delta_bias, saved, softplus, discretization, needs):
    state = A.new_empty(u.shape[0], *A.shape)
    inputs = (u, delta, A, B, C, D, z, delta_bias, state)
    return [
        torch.empty_like(x, memory_format=torch.contiguous_format)
        for x, needed in zip(inputs, needs)
        if needed
    ]


def _setup_context(ctx, inputs, output):
    u, delta, A, B, C, D, z, delta_bias, _, softplus, discretization, save = inputs
    _, _, saved = output
    ctx.mark_non_differentiable(saved)
    ctx.set_materialize_grads(False)
    ctx.save_for_backward(u, delta, A, B, C, D, z, delta_bias, saved)
    ctx.softplus, ctx.discretization, ctx.saved = softplus, discretization, save


def _gradient(ctx, dout, dlast, _):
    if not ctx.saved:
        raise RuntimeError("selective_scan: this call kept nothing for a gradient")
    u, delta, A, B, C, D, z, delta_bias, saved = ctx.saved_tensors
    needs = list(ctx.needs_input_grad[:9])
    if dout is None:
        dout = torch.zeros_like(u)
    grads = iter(
        _scan_backward(
            dout, dlast, u, delta, A, B, C, D, z, delta_bias, saved,
            ctx.softplus, ctx.discretization, needs,
        )
    )  # fmt: skip
    return (*(next(grads) if needed else None for needed in needs), None, None, None)


def _no_second_gradient(ctx, *grads):
    raise RuntimeError("selective_scan: second derivatives are not supported")


_scan.register_autograd(_gradient, setup_context=_setup_context)
_scan_backward.register_autograd(_no_second_gradient)


def _check(name: str, x: Tensor, shape: tuple[int, ...], dtypes: tuple, device) -> None:
    if not isinstance(x, Tensor):
        raise TypeError(f"{name} is {type(x).__name__}, must be a tensor")
    if tuple(x.shape) != shape:
        raise ValueError(f"{name} has shape {tuple(x.shape)}, must be {shape}")
    if x.dtype not in dtypes:
        raise TypeError(f"{name} has dtype {x.dtype}, allowed: {', '.join(map(str, dtypes))}")
    if x.device != device:
        raise ValueError(f"{name} is on {x.device}, u is on {device}")


def _check_groups(name: str, x: Tensor, u: Tensor, states: int) -> Tensor:
    """``[B, L, N]`` or ``[B, L, G, N]`` to ``[B, L, G, N]``."""
    if not isinstance(x, Tensor):
        raise TypeError(f"{name} is {type(x).__name__}, must be a tensor")
    batch, length, channels = u.shape
    if x.dim() == 3:
        _check(name, x, (batch, length, states), DTYPES, u.device)
        return x[:, :, None]
    groups = x.shape[2] if x.dim() == 4 else 0
    if groups == 0 or channels % groups:
        raise ValueError(
            f"{name} has shape {tuple(x.shape)}, must be {(batch, length, states)} or "
            f"[{batch}, {length}, G, {states}] with G a divisor of {channels}"
        )
    _check(name, x, (batch, length, groups, states), DTYPES, u.device)
    return x


def selective_scan(
    u: Tensor,
    delta: Tensor,
    A: Tensor,
    B: Tensor,
    C: Tensor,
    D: Tensor | None = None,
    z: Tensor | None = None,
    delta_bias: Tensor | None = None,
    delta_softplus: bool = False,
    *,
    initial_state: Tensor | None = None,
    return_last_state: bool = False,
    discretization: str = "mamba",
) -> Tensor | tuple[Tensor, Tensor]:
    """Mamba's selective scan, channels last (Gu and Dao 2023, algorithm 2; README for the maths).

    With δ = softplus(delta + delta_bias): h_t = f(δA) h_{t-1} + g(δA) δ B_t u_t,
    out_t = (Σ_n C_t h_t + D u_t) · silu(z_t). Interior and states are float32 whatever the inputs;
    gradients reach every tensor, the initial state included, also through the last state.

    Args:
        u: ``[B, L, D]`` float32, bfloat16 or float16.
        delta: ``[B, L, D]``, one of the same dtypes; before the softplus if there is one.
        A: ``[D, N]`` float32, N from 1 to 256; negative in a model.
        B: ``[B, L, N]`` or ``[B, L, G, N]``: group d // (D / G) serves channel d.
        C: as B, the same G.
        D: ``[D]`` float dtype, or None for 0.
        z: ``[B, L, D]`` in u's dtype, or None for no gate.
        delta_bias: ``[D]`` float dtype, or None for 0.
        delta_softplus: whether δ is a softplus.
        initial_state: ``[B, D, N]`` float32, h before the first token; None for 0.
        return_last_state: also return h after the last token.
        discretization: "mamba" (f = e^x, g = 1), "zoh" (f = e^x, g = (e^x - 1) / x) or "bilinear"
            (f = (1 + x/2) / (1 - x/2), g = 1 / (1 - x/2)), with x = δA.

    Returns:
        ``out [B, L, D]`` in u's dtype; with ``return_last_state`` also ``[B, D, N]`` float32.

    Raises:
        TypeError: an argument is not a tensor or has another dtype.
        ValueError: a shape, a device or ``discretization`` is not one of the above.
    """
    if not isinstance(u, Tensor):
        raise TypeError(f"u is {type(u).__name__}, must be a tensor")
    if u.dim() != 3 or u.shape[2] == 0:
        raise ValueError(f"u has shape {tuple(u.shape)}, must be [B, L, D] with D >= 1")
    _check("u", u, tuple(u.shape), DTYPES, u.device)
    if u.device.type not in ("cpu", "cuda"):
        raise ValueError(f"u is on {u.device}, allowed are cpu and cuda")
    if discretization not in DISCRETIZATIONS:
        raise ValueError(f"discretization is {discretization!r}, allowed: {DISCRETIZATIONS}")
    batch, _, channels = u.shape
    states = A.shape[1] if isinstance(A, Tensor) and A.dim() == 2 else 0
    _check("A", A, (channels, states), (torch.float32,), u.device)
    if not 1 <= states <= MAX_STATES:
        raise ValueError(f"A has shape {tuple(A.shape)}, must be [D, N] with N from 1 to 256")
    _check("delta", delta, tuple(u.shape), DTYPES, u.device)
    B, C = _check_groups("B", B, u, states), _check_groups("C", C, u, states)
    if B.shape != C.shape:
        raise ValueError(f"C has {C.shape[2]} groups, B has {B.shape[2]}; they must be equal")
    for name, x, shape, dtypes in (
        ("D", D, (channels,), DTYPES),
        ("z", z, tuple(u.shape), (u.dtype,)),
        ("delta_bias", delta_bias, (channels,), DTYPES),
        ("initial_state", initial_state, (batch, channels, states), (torch.float32,)),
    ):
        if x is not None:
            _check(name, x, shape, dtypes, u.device)
    tensors = (u, delta, A, B, C, D, z, delta_bias, initial_state)
    save = torch.is_grad_enabled() and any(x is not None and x.requires_grad for x in tensors)
    out, last, _ = _scan(*tensors, delta_softplus, discretization, save)
    return (out, last) if return_last_state else out
