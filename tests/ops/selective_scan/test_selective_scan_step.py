"""One token on a CPU: the two kernels against float64, and what they leave to torch."""

import pytest
import torch
import torch.nn.functional as F
from helpers.scan import on_threads
from torch._subclasses.fake_tensor import FakeTensorMode

from gamba_warp.compat.mamba_ssm import Mamba
from gamba_warp.kernels.selective_scan.cpu.step import conv_step, scan_step
from gamba_warp.kernels.selective_scan.reference import selective_scan_reference

# A few roundings of sums of at most 33 float32 numbers, and exponentials good to a last bit.
CLOSE = 1e-6


def far(got, want):
    return ((got - want).abs().max() / want.abs().max()).item()


def operands(batch, channels, states):
    """Rows of x, dt, B, C and z are strided, as those of a projection are."""
    rows = torch.randn(batch, 3 * channels + 2 * states + 5)
    x, dt, z, B, C, _ = rows.split([channels, channels, channels, states, states, 5], 1)
    A = -torch.rand(channels, states) * 4
    return torch.randn(batch, channels, states), x, dt, A, B, C, *torch.randn(2, channels), z


def oracle(state, *tensors, softplus):
    """State and output in float64 by the reference, for a sequence of one token."""
    state, *tensors = (None if v is None else v.double() for v in (state, *tensors))
    x, dt, A, B, C, D, bias, z = tensors
    x, dt, B, C, z = (None if v is None else v[:, None] for v in (x, dt, B, C, z))
    out, state = selective_scan_reference(
        x, dt, A, B, C, D, z, bias, delta_softplus=softplus, initial_state=state
    )
    return state, out[:, 0]


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("options", [True, False])
@pytest.mark.parametrize("batch, channels, states", [(1, 16, 16), (3, 368, 16), (2, 48, 48)])
def test_scan_equals_float64(batch, channels, states, options, threads):
    state, x, dt, A, B, C, D, bias, z = operands(batch, channels, states)
    if not options:
        D = bias = z = None
        dt = dt.abs()
    after, want = oracle(state, x, dt, A, B, C, D, bias, z, softplus=options)
    with on_threads(threads):
        got = scan_step(state, x, dt, A, B, C, D, z, bias, options)
    assert far(got, want) < CLOSE and far(state, after) < CLOSE


@pytest.mark.parametrize("taps", [2, 3, 4])
@pytest.mark.parametrize("silu", [True, False])
def test_convolution_equals_float64(taps, silu):
    rows, state = torch.randn(5, 100), torch.randn(5, 48, taps)
    x, weight, bias = rows[:, 7:55], torch.randn(48, taps), torch.randn(48) if silu else None
    seen = torch.cat([state[..., 1:], x[..., None]], -1)
    want = (seen.double() * weight).sum(-1) + (0 if bias is None else bias)
    got = conv_step(x, weight, bias, state, silu)
    assert torch.equal(state, seen)
    assert far(got, F.silu(want) if silu else want) < CLOSE


def test_what_the_kernels_do_not_take_is_untouched():
    def left(change, channels=32, states=16):
        given = change(list(operands(2, channels, states)))
        state, x, dt, A, B, C, D, bias, z = given
        before = state.clone()
        assert scan_step(state, x, dt, A, B, C, D, z, bias, True) is None
        assert torch.equal(state, before)

    def other(place, change):
        return lambda v: [*v[:place], change(v[place]), *v[place + 1 :]]

    left(lambda v: v, channels=24)
    left(lambda v: v, states=8)
    for place in range(9):
        left(other(place, torch.Tensor.bfloat16))
    for place in (0, 3):  # not in the order of memory
        left(other(place, lambda v: v.mT.contiguous().mT))
    left(other(1, lambda v: v.t().contiguous().t()))
    for place in range(9):  # of another shape
        left(other(place, lambda v: v[:1, :1] if v.dim() > 1 else v[:1]))
        if 0 < place < 6:
            left(other(place, lambda v: None))
    state, weight = torch.zeros(2, 32, 5), torch.zeros(32, 4)
    assert conv_step(torch.ones(2, 32), weight, None, state, True) is None and not state.any()
    with FakeTensorMode():
        state, x, dt, A, B, C, D, bias, z = operands(2, 32, 16)
        assert scan_step(state, x, dt, A, B, C, D, z, bias, True) is None


def test_rates_by_their_logarithms():
    state, x, dt, A, B, C, D, bias, z = operands(2, 32, 16)
    again = state.clone()
    got = scan_step(state, x, dt, (-A).log(), B, C, D, z, bias, True, logs=True)
    want = scan_step(again, x, dt, A, B, C, D, z, bias, True)
    assert far(got, want) < CLOSE and far(state, again) < CLOSE


def test_a_gradient_that_needs_the_old_state_is_refused():
    state, x, dt, A, B, C, *_ = operands(1, 16, 16)
    scale = torch.ones(1, requires_grad=True)
    product = scale * state
    scan_step(state, x, dt, A, B, C, None, None, None, True)
    with pytest.raises(RuntimeError, match="inplace operation"):
        product.sum().backward()
    with torch.inference_mode():
        state = torch.zeros(1, 16, 16)
        assert scan_step(state, x, dt, A, B, C, None, None, None, True) is not None


def test_the_layers_step_takes_them(monkeypatch):
    """With them and without, the same tokens."""
    from gamba_warp.compat.causal_conv1d import causal_conv1d_interface as conv
    from gamba_warp.compat.mamba_ssm.modules import mamba_simple as layers
    from gamba_warp.compat.mamba_ssm.ops.triton import selective_state_update as update

    taken = []

    def note(function):
        def run(*arguments, **options):
            out = function(*arguments, **options)
            taken.append(out is not None)
            return out

        return run

    layer, tokens, outs = Mamba(40), torch.randn(9, 3, 1, 40), []
    for functions in ((note(conv_step), note(scan_step)), 2 * (lambda *arguments, **_: None,)):
        monkeypatch.setattr(conv, "conv_step", functions[0])
        monkeypatch.setattr(layers, "scan_step", functions[1])
        monkeypatch.setattr(update, "scan_step", functions[1])
        cache = layer.allocate_inference_cache(3, 0)
        outs.append(torch.cat([layer.step(token, *cache)[0] for token in tokens], 1))
    assert len(taken) == 18 and all(taken)
    assert far(*outs) < CLOSE
