"""The causal convolution against its float64 oracle: outputs, gradients by name, states."""

import pytest
import torch
from helpers import assert_rel_rms
from helpers.kernels import conv_inputs as make
from helpers.scan import assert_gradient_alone, assert_gradients, leaves

from gamba_warp.kernels.causal_conv1d import causal_conv1d, causal_conv1d_fn
from gamba_warp.kernels.causal_conv1d.reference import causal_conv1d_reference
from gamba_warp.kernels.runtime import gpu
from gamba_warp.kernels.runtime.native import streams

FORWARD = 2e-7  # float32 rounding of four products and a SiLU
GRADIENT = 2e-6  # float32 sums over up to 2 * 577 tokens


def compare(inputs, activation, forward=FORWARD, gradient=GRADIENT):
    mine, theirs = leaves(inputs), leaves(inputs, torch.float64)
    out, final = causal_conv1d(**mine, activation=activation, return_final_state=True)
    want, want_final = causal_conv1d_reference(**theirs, activation=activation)
    assert_rel_rms(out, want, forward, "out")
    assert torch.equal(final.double(), want_final)
    assert_gradients((mine, (out, final)), (theirs, (want, want_final)), GRADIENT, gradient)


@pytest.mark.parametrize("activation", [None, "silu"])
@pytest.mark.parametrize(
    "batch, length, channels, width",
    [(1, 1, 1, 4), (2, 2, 17, 3), (1, 65, 16, 2), (2, 256, 5, 4), (1, 258, 40, 4), (2, 577, 33, 4)],
)
def test_matches_oracle(batch, length, channels, width, activation):
    compare(make(batch, length, channels, width), activation)


@pytest.mark.parametrize("dtype, limit", [(torch.bfloat16, 4e-3), (torch.float16, 5e-4)])
def test_half_precision(dtype, limit):
    """Limits: the rounding of the dtype itself, 2^-9 and 2^-12 at most, on output only."""
    compare(make(2, 65, 37, 4, dtype), "silu", limit, limit)


def test_without_bias_and_state():
    inputs = make(2, 20, 18, 4)
    compare({k: inputs[k] for k in ("x", "weight")}, "silu")


def test_equal_terms_of_a_sum():
    """Equal additions round to the same side, so not all tokens are added in a row.

    n of them are off by 3/8 n 2^-24 at most. A CPU adds runs of 16 (64 in a row
    were 5e-7 off), CUDA 64 in a row, as runs would take more registers.
    """
    inputs = make(1, 640, 37, 4)
    inputs["x"] = (0.1 + torch.rand(37)).expand_as(inputs["x"]).contiguous()
    inputs["initial_state"] = inputs["x"][:, :3].clone()
    mine = leaves(inputs)
    (got,) = torch.autograd.grad(causal_conv1d(**mine).sum(), [mine["weight"]])
    want = 640 * inputs["x"][0, 0].double()[:, None].expand_as(got)
    limit = {"cpu": 3e-7, "cuda": 3 / 8 * 64 * 2**-24}[gpu.kind_of(got.device)]
    assert_rel_rms(got, want, limit, "gradient of weight")


@pytest.mark.parametrize("cut", [1, 2, 300])
def test_split_consistency(cut):
    inputs = make(2, 310, 19, 4)
    whole = causal_conv1d(**inputs, activation="silu")
    parts, x, options = [], inputs["x"], {"activation": "silu", "return_final_state": True}
    for piece in (x[:, :cut], x[:, cut:]):
        out, inputs["initial_state"] = causal_conv1d(**inputs | {"x": piece}, **options)
        parts.append(out)
    assert torch.equal(torch.cat(parts, 1), whole)


def test_large_results_have_the_same_bits():
    """From 32 MiB on they are written past the caches; rows are strided, a strip is not full."""
    inputs = make(1, 8195, 2048, 4)
    inputs["x"] = inputs["x"][..., 512:1536]
    inputs |= {name: inputs[name][512:1536] for name in ("weight", "bias")}
    inputs.pop("initial_state", None)
    whole = causal_conv1d(**inputs, activation="silu")
    assert streams([whole]) and not streams([whole[:, :8000]]) and not streams([whole.bfloat16()])
    first = causal_conv1d(**inputs | {"x": inputs["x"][:, :4100]}, activation="silu")
    assert not streams([first]) and torch.equal(whole[:, :4100], first)
    exact = {name: x.double() for name, x in inputs.items()}
    want, _ = causal_conv1d_reference(**exact, activation="silu")
    assert_rel_rms(whole, want, 2e-7, "out")


@pytest.mark.parametrize("channels", [19, 64])
def test_bfloat16_rounds_to_the_nearest(channels):
    """Ties go to the even number, NaN and infinity stay, on every processor alike."""
    x = make(1, 70, channels, 4)["x"]
    x[0, :4, :5] = torch.tensor([torch.nan, torch.inf, -torch.inf, 3.0e38, -1.0])
    one = torch.zeros(channels, 4)
    one[:, 3] = 1 + 2**-8  # a tie for each power of two
    got = causal_conv1d(x.bfloat16(), one.float())
    want = (x.bfloat16().float() * one[0, 3]).bfloat16()
    assert torch.equal(got[:, 7:], want[:, 7:])  # 0 times NaN reaches three tokens further
    assert got[0, :4, 0].isnan().all() and got[0, 0, 3].isfinite()


@pytest.mark.parametrize("name", ["x", "weight", "bias", "initial_state"])
def test_one_gradient_alone(name):
    assert_gradient_alone(causal_conv1d, make(2, 30, 20, 4), name, activation="silu")


@pytest.mark.parametrize("batch, length", [(0, 5), (2, 0)])
def test_empty(batch, length):
    inputs = leaves(make(batch, length, 6, 4))
    out, final = causal_conv1d(**inputs, activation="silu", return_final_state=True)
    assert out.shape == (batch, length, 6) and final.shape == (batch, 3, 6)
    grads = torch.autograd.grad(out.sum() + final.sum(), [*inputs.values()], allow_unused=True)
    assert all(grad is None or torch.isfinite(grad).all() for grad in grads)


def test_strided_input():
    inputs = make(2, 40, 20, 4)
    dense = causal_conv1d(**inputs)
    x = inputs["x"]
    # CUDA loads two channels at once where their places allow it
    for strided in (torch.cat([x, x], -1)[..., :20], torch.cat([x[..., :1], x], -1)[..., 1:]):
        assert torch.equal(causal_conv1d(**inputs | {"x": strided}), dense)


def test_causal_conv1d_signature():
    inputs = make(2, 21, 18, 4)
    x, weight, bias, state = inputs.values()
    options = {"initial_states": state.mT, "return_final_states": True, "activation": "swish"}
    out, final = causal_conv1d_fn(x.mT, weight, bias, **options)
    want, want_final = causal_conv1d(**inputs, activation="silu", return_final_state=True)
    assert torch.equal(out.mT, want) and torch.equal(final.mT, want_final)
    assert torch.equal(causal_conv1d_fn(x.mT, weight), causal_conv1d(x, weight).mT)


@pytest.mark.parametrize(
    "name, change, error",
    [
        ("x", lambda x: x[0], ValueError),
        ("x", lambda x: x.double(), TypeError),
        ("weight", lambda x: x[:, :1], ValueError),
        ("weight", lambda x: x[:-1], ValueError),
        ("bias", lambda x: x[:-1], ValueError),
        ("initial_state", lambda x: x[:, :-1], ValueError),
        ("initial_state", lambda x: x.half(), TypeError),
    ],
)
def test_bad_input_names_the_argument(name, change, error):
    inputs = make(2, 5, 6, 4)
    inputs[name] = change(inputs[name])
    with pytest.raises(error, match=rf"^{name} "):
        causal_conv1d(**inputs)


def test_bad_options():
    inputs = make(2, 5, 6, 4)
    with pytest.raises(ValueError, match="activation must be one of .*got 'relu'"):
        causal_conv1d(**inputs, activation="relu")
    with pytest.raises(ValueError, match="seq_idx and states are given"):
        packed = {"seq_idx": torch.zeros(2, 5).int(), "return_final_states": True}
        causal_conv1d_fn(inputs["x"].mT, inputs["weight"], **packed)


def test_operator_contract():
    """Schema, fake tensors, autograd registration and AOT tracing, by torch's own checker."""
    arguments = (*leaves(make(2, 7, 5, 3)).values(), None, True)
    torch.library.opcheck(torch.ops.gamba_warp.causal_conv1d.default, arguments)


def test_devices_without_kernels_are_named():
    x, weight = torch.randn(1, 4, 8), torch.randn(8, 4)
    with pytest.raises(ValueError, match="^x must be on cpu or cuda, got meta$"):
        causal_conv1d(x.to("meta"), weight.to("meta"))
    with pytest.raises(ValueError, match="^weight must be on cpu, as x, got meta$"):
        causal_conv1d(x, weight.to("meta"))
