"""mamba-ssm's arguments of the scan, in all combinations, against float64; what is refused."""

from itertools import product

import pytest
import torch
from helpers import assert_rel_rms

from gamba_warp.compat.mamba_ssm.ops.selective_scan_interface import (
    selective_scan_fn,
    selective_scan_ref,
)

BATCH, CHANNELS, STATES, LENGTH = 2, 6, 5, 19
SWITCHES = list(product([False, True], repeat=5))  # D, z, delta_bias, softplus, last state
# How B and C vary: with the token or not, and in how many groups.
MATRICES = [(False, False, 1), (False, True, 1), (True, False, 1), (True, True, 1), (True, True, 2)]
# Half an ulp of the output is 2^-12 of float16 and 2^-9 of bfloat16; the interior is float32.
LIMITS = {torch.float32: 2e-6, torch.float16: 5e-4, torch.bfloat16: 4e-3}


def matrix(varies, groups, dtype):
    """B or C in one of mamba-ssm's shapes; one that does not vary is float32."""
    if not varies:
        return torch.randn(CHANNELS, STATES)
    shape = (BATCH, STATES, LENGTH) if groups == 1 else (BATCH, groups, STATES, LENGTH)
    return torch.randn(shape).to(dtype)


def inputs(varies_B, varies_C, groups, has_D, has_z, has_bias, dtype):
    """All tensors by name."""
    shape = (BATCH, CHANNELS, LENGTH)
    made = {
        "u": torch.randn(shape).to(dtype),
        "delta": (0.5 * torch.rand(shape)).to(dtype),
        "A": -0.5 * torch.rand(CHANNELS, STATES),
        "B": matrix(varies_B, groups, dtype),
        "C": matrix(varies_C, groups, dtype),
    }
    if has_D:
        made["D"] = torch.randn(CHANNELS)
    if has_z:
        made["z"] = torch.randn(shape).to(dtype)
    if has_bias:
        made["delta_bias"] = 0.5 * torch.rand(CHANNELS)
    return made


def in_float64(u, delta, A, B, C, D=None, z=None, delta_bias=None, softplus=False):
    """The scan written out, channel by channel, for any shapes of B and C."""

    def at(matrix, t):  # [B or 1, D, N]
        if matrix.dim() == 2:
            return matrix[None]
        if matrix.dim() == 3:
            return matrix[:, None, :, t]
        return matrix[..., t].repeat_interleave(u.shape[1] // matrix.shape[1], dim=1)

    if delta_bias is not None:
        delta = delta + delta_bias[:, None]
    if softplus:
        delta = torch.log1p(delta.exp())
    h, rows = u.new_zeros(*u.shape[:2], A.shape[1]), []
    for t in range(u.shape[2]):
        step = delta[:, :, t, None]
        h = (step * A).exp() * h + step * at(B, t) * u[:, :, t, None]
        rows.append((h * at(C, t)).sum(-1))
    y = torch.stack(rows, -1)
    if D is not None:
        y = y + D[:, None] * u
    return (y if z is None else y * z * torch.sigmoid(z)), h


def run(scan, tensors, **options):
    """Outputs, and gradients by name for one cotangent of the output."""
    leaves = {name: x.detach().clone().requires_grad_() for name, x in tensors.items()}
    out, last = scan(**leaves, **options)
    generator = torch.Generator().manual_seed(1)
    out.backward(torch.randn(out.shape, generator=generator).to(out.dtype))
    return {"out": out, "last": last} | {name: x.grad for name, x in leaves.items()}


@pytest.mark.parametrize("dtype", LIMITS, ids=str)
@pytest.mark.parametrize("matrices", MATRICES, ids=str)
def test_the_grid(matrices, dtype):
    for has_D, has_z, has_bias, softplus, return_last in SWITCHES:
        tensors = inputs(*matrices, has_D, has_z, has_bias, dtype)
        given = f"D {has_D}, z {has_z}, bias {has_bias}, softplus {softplus}"
        if not return_last:  # the same numbers, as one tensor
            alone = selective_scan_fn(**tensors, delta_softplus=softplus)
            both = selective_scan_fn(**tensors, delta_softplus=softplus, return_last_state=True)
            assert isinstance(alone, torch.Tensor) and torch.equal(alone, both[0]), given
            continue
        got = run(selective_scan_fn, tensors, delta_softplus=softplus, return_last_state=True)
        doubles = {name: x.double() for name, x in tensors.items()}
        want = run(in_float64, doubles, softplus=softplus)
        assert got["out"].dtype == dtype and got["last"].dtype == torch.float32
        for name, value in want.items():
            # A cotangent in the output's dtype, and a sum of rounded products, in each gradient.
            assert_rel_rms(got[name], value, 2 * LIMITS[dtype], f"{name} ({given})")


@pytest.mark.parametrize("matrices", MATRICES, ids=str)
def test_the_reference(matrices):
    tensors = inputs(*matrices, True, True, True, torch.float32)
    got = run(selective_scan_ref, tensors, delta_softplus=True, return_last_state=True)
    want = run(in_float64, {k: x.double() for k, x in tensors.items()}, softplus=True)
    for name, value in want.items():
        assert_rel_rms(got[name], value, 2e-6, name)  # float32, sums of at most 228 terms
    assert isinstance(selective_scan_ref(**tensors), torch.Tensor)


@pytest.mark.parametrize("scan", [selective_scan_fn, selective_scan_ref])
@pytest.mark.parametrize("name", ["A", "B", "C"])
def test_complex_states_are_refused(scan, name):
    tensors = inputs(False, False, 1, False, False, False, torch.float32)
    tensors[name] = tensors[name].to(torch.complex64)
    with pytest.raises(TypeError, match=f"^{name} has dtype torch.complex64; complex states are"):
        scan(**tensors)


def test_float64_is_refused():
    tensors = inputs(True, True, 1, False, False, False, torch.float32)
    tensors["u"] = tensors["u"].double()
    with pytest.raises(TypeError, match="^u has dtype torch.float64, allowed: torch.float32"):
        selective_scan_fn(**tensors)
