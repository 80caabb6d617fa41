"""Extension modules of mamba-ssm, causal-conv1d and VMamba, with their signatures.

Layers that call these modules, instead of a package over them, run unchanged. A gradient runs the
forward pass again, so that the modules' own ``x`` and ``out`` are not needed.
"""

from __future__ import annotations

import importlib.util
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

import torch
from torch import Tensor

from ..kernels.selective_scan import selective_scan_fn
from .causal_conv1d.causal_conv1d_interface import causal_conv1d_fn, causal_conv1d_update


@torch.no_grad()
def scan_fwd(u, delta, A, B, C, D, z, delta_bias, delta_softplus) -> list[Tensor]:
    """Return the scan's output, ``x [B, D, 1, 2 N]``, and with a z also the output after the gate.

    The arguments are ``selective_scan_fn``'s; ``x[..., 1::2]`` is the last state.
    """
    wide = u if z is None else u.float()
    y, last = selective_scan_fn(wide, delta, A, B, C, D, None, delta_bias, delta_softplus, True)
    x = torch.stack([torch.zeros_like(last), last], -1).flatten(-2)[:, :, None]
    gated = [] if z is None else [y * torch.nn.functional.silu(z.float())]
    out, *gated = (part.to(u.dtype).contiguous() for part in (y, *gated))
    return [out, x, *gated]


def scan_bwd(
    u, delta, A, B, C, D, z, delta_bias, dout, x, out, dz, delta_softplus, recompute_out_z
) -> list[Any]:
    """Return the gradients of u, delta, A, B, C, D, delta_bias and, with a z, of z, in ``dz``.

    With ``recompute_out_z`` the output after the gate follows.
    """
    y, grads = _gradients(
        lambda u, *more: selective_scan_fn(u.to(dout.dtype), *more, delta_softplus=delta_softplus),
        (u, delta, A, B, C, D, z, delta_bias),
        dout,
    )
    gate = grads.pop(6)
    if z is not None:
        grads.append(gate if dz is None else dz.copy_(gate))
    return [*grads, y.detach()] if recompute_out_z else grads


def flex_fwd(u, delta, A, B, C, D, delta_bias, delta_softplus, nrows=1, oflex=False):
    """Do the same without a z; with ``oflex`` the output is float32. ``nrows`` has no effect."""
    u = u.float() if oflex else u
    return scan_fwd(u, delta, A, B, C, D, None, delta_bias, delta_softplus)


def flex_bwd(u, delta, A, B, C, D, delta_bias, dout, x, delta_softplus, nrows=1):
    """Return the gradients of u, delta, A, B, C, D and delta_bias."""
    more = dout, x, None, None, delta_softplus, False
    return scan_bwd(u, delta, A, B, C, D, None, delta_bias, *more)


def _gradients(function, tensors, *douts) -> tuple[Any, list[Any]]:
    """Run a function, and return its result and the gradients of the given tensors or None."""
    leaves = [None if t is None else t.detach().requires_grad_() for t in tensors]
    with torch.enable_grad():
        outs = function(*leaves)
    grads = iter(torch.autograd.grad(outs, [t for t in leaves if t is not None], douts))
    return outs, [None if t is None else next(grads) for t in leaves]


@torch.no_grad()
def conv_fwd(x, weight, bias, *rest) -> Tensor:
    """Return the convolution. The last argument is ``silu``; those between are by their number.

    None: causal-conv1d 1.0; ``seq_idx``: 1.1; ``seq_idx, initial_states, final_states_out``: from
    1.2; ``seq_idx, initial_states, out, final_states_out``: from 1.6.
    """
    *between, silu = rest
    outs: list[Any]
    seq_idx, initial, *outs = (*between, None, None)[: max(2, len(between))]
    final = outs[-1] if outs else None
    states = initial, final is not None, final, "silu" if silu else None
    y = causal_conv1d_fn(x, weight, bias, seq_idx, *states)
    y = y[0] if isinstance(y, tuple) else y
    return outs[0].copy_(y) if len(outs) == 2 else y


def conv_bwd(x, weight, bias, dout, *rest) -> list[Any]:
    """Return the gradients of x, in ``dx``, weight, bias and from 1.2 on the initial states.

    The last argument is ``silu``; those between are by their number. ``dx``: causal-conv1d 1.0;
    ``seq_idx, dx``: 1.1; ``seq_idx, initial_states, dfinal_states, dx`` and a switch: from 1.2; in
    its place ``dweight, dbias, dinitial_states``, written: from 1.6.
    """
    *rest, silu = rest
    early = len(rest) <= 2
    *between, dx = rest if early else rest[:4]
    seq_idx, initial, dfinal = (*between, None, None, None)[:3]

    def run(x, weight, bias, initial):
        states = initial, dfinal is not None, None, "silu" if silu else None
        return causal_conv1d_fn(x, weight, bias, seq_idx, *states)

    douts = [part for part in (dout, dfinal) if part is not None]
    _, grads = _gradients(run, (x, weight, bias, initial), *douts)
    for place, into in enumerate((dx, *(rest[4:] if len(rest) == 7 else ()))):
        if into is not None and grads[place] is not None:
            grads[place] = into.copy_(grads[place])
    return grads[:3] if early else grads


def conv_update(x, conv_state, weight, bias, *rest) -> Tensor:
    """Return ``causal_conv1d_update`` with ``silu, cache_seqlens, conv_state_indices``.

    From causal-conv1d 1.6 on an output tensor stands before these.
    """
    out, rest = (rest[0], rest[1:]) if isinstance(rest[0], Tensor) else (None, rest)
    y = causal_conv1d_update(x, conv_state, weight, bias, "silu" if rest[0] else None, *rest[1:])
    return y if out is None else out.copy_(y)


_FLEX = {"fwd": flex_fwd, "bwd": flex_bwd}
_CONV = {"fwd": conv_fwd, "bwd": conv_bwd, "update": conv_update}
EXTENSIONS: dict[str, dict[str, Any]] = {
    "selective_scan_cuda": {"fwd": scan_fwd, "bwd": scan_bwd},
    "selective_scan_cuda_core": _FLEX,
    "selective_scan_cuda_oflex": _FLEX,
    "causal_conv1d_cuda": {f"causal_conv1d_{name}": f for name, f in _CONV.items()},
}


def extension(name: str) -> ModuleType:
    """Return the module of that name."""
    module = importlib.util.module_from_spec(ModuleSpec(name, None))
    vars(module).update(EXTENSIONS[name])
    return module
