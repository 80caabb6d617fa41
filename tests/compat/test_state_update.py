"""One step of the scan, with heads, groups, chosen rows: against the reference in float64."""

from itertools import product

import pytest
import torch
from helpers import assert_rel_rms

from gamba_warp.compat.mamba_ssm.ops.triton.selective_state_update import (
    selective_state_update,
    selective_state_update_ref,
)

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


def compare(state, given, indices=None, softplus=True):
    """The update against the reference in float64, on the rows that the indices choose."""
    dtype = state.dtype
    rows = state if indices is None else state[indices.long()]
    want_state = rows.double()
    doubles = {name: x.double() for name, x in given.items()}
    want = selective_state_update_ref(want_state, **doubles, dt_softplus=softplus)
    got = selective_state_update(state, **given, dt_softplus=softplus, state_batch_indices=indices)
    assert got.dtype == given["x"].dtype and state.dtype == dtype
    assert_rel_rms(got, want, LIMITS[got.dtype], "out")
    rows = state if indices is None else state[indices.long()]
    assert_rel_rms(rows, want_state, LIMITS[dtype], "state")


@pytest.mark.parametrize("dtype", LIMITS, ids=str)
@pytest.mark.parametrize("shape", SHAPES, ids=str)
def test_matches_the_reference(shape, dtype):
    for has_D, has_z, has_bias, softplus in product([False, True], repeat=4):
        state, given = make(*shape, dtype)
        wanted = {"D": has_D, "z": has_z, "dt_bias": has_bias}
        given = {name: x for name, x in given.items() if wanted.get(name, True)}
        if not softplus:
            given["dt"] = given["dt"].sigmoid()
        compare(state, given, softplus=softplus)


def test_the_reference_is_the_formula():
    state, given = make(3, 2, None, None, torch.float64)
    given = {name: x.double() for name, x in given.items()}
    x, dt, A, B, C, D, z, bias = given.values()
    want = torch.empty_like(x)
    after = state.clone()
    for b, d in product(range(3), range(3)):
        step = torch.log1p(torch.exp(dt[b, d] + bias[d]))
        after[b, d] = torch.exp(step * A[d]) * state[b, d] + step * B[b] * x[b, d]
        want[b, d] = (after[b, d] @ C[b] + D[d] * x[b, d]) * z[b, d] * torch.sigmoid(z[b, d])
    got = selective_state_update_ref(state, **given, dt_softplus=True)
    assert torch.allclose(got, want, rtol=1e-13) and torch.allclose(state, after, rtol=1e-13)


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


@pytest.mark.parametrize(
    "name, value, error, text",
    [
        (
            "A",
            torch.ones(7, 5, dtype=torch.complex64),
            TypeError,
            "A has dtype torch.complex64, al",
        ),
        ("dt", torch.ones(3, 7).double(), TypeError, "dt has dtype torch.float64, allowed"),
        ("C", None, TypeError, "C is NoneType, allowed is a tensor"),
        ("B", torch.ones(3, 2, 5), ValueError, r"B has shape \[3, 2, 5\], allowed is \[3, 5\] or"),
        ("D", torch.ones(5), ValueError, r"D has shape \[5\], allowed is \[7\]$"),
    ],
)
def test_refuses(name, value, error, text):
    state, given = make(7, 5, None, None, torch.float32)
    with pytest.raises(error, match=f"^{text}"):
        selective_state_update(state, **given | {name: value})


def test_refuses_groups_that_do_not_divide_the_heads():
    state, given = make(3, 5, 4, 3, torch.float32)
    with pytest.raises(
        ValueError, match=r"^B has shape \[3, 3, 5\], allowed is \[3, 5\] or .* \[3, 4, 5\]$"
    ):
        selective_state_update(state, **given)
