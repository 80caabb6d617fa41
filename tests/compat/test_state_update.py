"""One step of the scan, with heads, groups, chosen rows: against the formula in float64."""

from itertools import product

import pytest
import torch
from helpers import assert_rel_rms

from gamba_warp.compat.mamba_ssm.ops.triton import selective_state_update as updates
from gamba_warp.compat.mamba_ssm.ops.triton.selective_state_update import selective_state_update

# Half an ulp of what is stored; float32 has a few roundings of its own.
LIMITS = {torch.float32: 1e-6, torch.float16: 5e-4, torch.bfloat16: 4e-3}
SHAPES = [(7, 5, None, None), (3, 17, 4, 2), (5, 16, 6, 1), (4, 1, 3, 3)]  # D, N, heads, groups


def make(channels, states, heads, groups, dtype, rows=3, batch=3):
    """The state and all arguments by name; without heads for None."""
    heads, groups = ([] if n is None else [n] for n in (heads, groups))
    token = (batch, *heads, channels)
    return torch.randn(rows, *heads, channels, states).to(dtype), {
        "x": torch.randn(token).to(dtype),
        "dt": torch.randn(token).to(dtype),
        "A": -torch.rand(*heads, channels, states) - 0.1,
        "B": torch.randn(batch, *groups, states),
        "C": torch.randn(batch, *groups, states),
        "D": torch.randn(*heads, channels),
        "z": torch.randn(token).to(dtype),
        "dt_bias": torch.rand(*heads, channels) - 2,
    }


def in_float64(state, given, softplus):
    """The step written out: the output, and the state after it."""
    x, dt, A, B, C = (given[name] for name in ("x", "dt", "A", "B", "C"))
    D, z, dt_bias = (given.get(name) for name in ("D", "z", "dt_bias"))
    if state.dim() == 4:
        B, C = (m.repeat_interleave(state.shape[1] // m.shape[1], dim=1) for m in (B, C))
    step = dt if dt_bias is None else dt + dt_bias
    step = torch.log1p(torch.exp(step)) if softplus else step
    after = torch.exp(step[..., None] * A) * state + (step * x)[..., None] * B[..., None, :]
    out = (after * C[..., None, :]).sum(-1) + (0 if D is None else D * x)
    return (out if z is None else out * z * torch.sigmoid(z)), after


def compare(state, given, indices=None, softplus=True):
    """The update against float64, on the rows that the indices choose; the reference in float64."""
    dtype, rows = state.dtype, slice(None) if indices is None else indices.long()
    wide, doubles = state[rows].double(), {name: x.double() for name, x in given.items()}
    want, after = in_float64(wide, doubles, softplus)
    got = updates.selective_state_update_ref(wide, **doubles, dt_softplus=softplus)
    assert torch.allclose(got, want, rtol=1e-11) and torch.allclose(wide, after, rtol=1e-11)
    got = selective_state_update(state, **given, dt_softplus=softplus, state_batch_indices=indices)
    assert got.dtype == given["x"].dtype and state.dtype == dtype
    assert_rel_rms(got, want, LIMITS[got.dtype], "out")
    assert_rel_rms(state[rows], after, LIMITS[dtype], "state")


@pytest.mark.parametrize("dtype", LIMITS, ids=str)
@pytest.mark.parametrize("shape", SHAPES, ids=str)
def test_matches_the_formula(shape, dtype):
    for has_D, has_z, has_bias, softplus in product([False, True], repeat=4):
        state, given = make(*shape, dtype)
        wanted = {"D": has_D, "z": has_z, "dt_bias": has_bias}
        given = {name: x for name, x in given.items() if wanted.get(name, True)}
        if not softplus:
            given["dt"] = given["dt"].sigmoid()
        compare(state, given, softplus=softplus)


@pytest.mark.parametrize("dtype", LIMITS, ids=str)
@pytest.mark.parametrize("shape", SHAPES[:2], ids=str)
def test_rows_by_indices(shape, dtype):
    state, given = make(*shape, dtype, rows=8)
    before = state.clone()
    compare(state, given, torch.tensor([5, 0, 7], dtype=torch.int32))
    others = [1, 2, 3, 4, 6]
    assert torch.equal(state[others], before[others])


def test_padding_gives_zero_and_touches_nothing():
    state, given = make(7, 5, None, None, torch.float32, rows=4)
    before = state.clone()
    indices = torch.tensor([-1, 0, -1])
    out = selective_state_update(state, **given, state_batch_indices=indices)
    assert torch.equal(state[1:], before[1:]) and not torch.equal(state[0], before[0])
    assert (out[[0, 2]] == 0).all() and (out[1] != 0).all()


def test_parameters_tied_within_a_head():
    state, given = make(3, 5, 4, 2, torch.float32)
    for name in ("dt", "D", "dt_bias"):
        given[name] = given[name][..., :1].expand_as(given[name])
    given["A"] = given["A"][:, :1, :1].expand_as(given["A"])
    compare(state, given)


def test_autocast_rounds_nothing():
    state, given = make(7, 16, None, None, torch.float32)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        compare(state, given)


def test_no_gradient_flows():
    state, given = make(7, 5, None, None, torch.float32)
    given["A"].requires_grad_()
    assert not selective_state_update(state, **given).requires_grad and not state.requires_grad


def test_refuses_groups_that_do_not_divide_the_heads():
    state, given = make(3, 5, 4, 3, torch.float32)
    text = r"^B must have shape \[3, 5\] or .* \[3, 4, 5\].*, got \[3, 3, 5\]$"
    with pytest.raises(ValueError, match=text):
        selective_state_update(state, **given)
