"""Layouts on a CPU: mamba-ssm's, its slices, and mixtures have the bits of channels last."""

import pytest
import torch
from helpers import on_threads
from helpers.kernels import conv_inputs
from helpers.scan import make

from gamba_warp.kernels import causal_conv1d_fn, selective_scan_fn
from gamba_warp.kernels.causal_conv1d import causal_conv1d
from gamba_warp.kernels.selective_scan import selective_scan, selective_scan_state

TOKENS = ("u", "delta", "B", "C", "z", "x", "out")  # tensors [B, L, ..]


def lay(x, layout):
    """The same values: "last" is dense, "transposed" [B, D, L], "slice" a half of that along D,
    "cut" a part of it along L, so that no row begins at a cache line."""
    if layout == "last":
        return x.contiguous()
    x = x.transpose(1, -1).contiguous()
    if layout == "slice":
        x = torch.cat([x, x], 1).chunk(2, dim=1)[1]
    if layout == "cut":
        x = torch.cat([x[..., :1], x, x, x], -1)[..., 1 : 1 + x.shape[-1]]
    return x.transpose(1, -1)


MIXTURES = {
    "transposed": dict.fromkeys(TOKENS, "transposed"),
    "slices": dict.fromkeys(TOKENS, "slice") | {"B": "cut", "C": "cut"},
    "cuts": dict.fromkeys(TOKENS, "cut") | {"z": "slice"},
    "u and x": {"u": "transposed", "x": "slice"},
    "delta": {"delta": "slice", "C": "transposed"},
    "z": {"z": "transposed"},
    "the gradient of the output": {"out": "cut"},
    "all but u and x": dict.fromkeys(TOKENS, "transposed") | {"u": "last", "x": "last"},
}
every_mixture = pytest.mark.parametrize("mixture", MIXTURES.values(), ids=MIXTURES)


def assert_same(function, inputs, mixture, seed=0):
    """Results and gradients by name have the bits of channels last, in the layout of their input.

    The first result has that of u or x.
    """
    results = []
    for layouts in ({}, mixture):
        torch.manual_seed(seed)
        laid = {k: lay(x, layouts.get(k, "last")) if k in TOKENS else x for k, x in inputs.items()}
        mine = {k: x.detach().requires_grad_() for k, x in laid.items()}
        outs = function(**mine)
        out, *others = (torch.randn_like(x) for x in map(torch.Tensor.contiguous, outs))
        heads = [lay(out, layouts.get("out", "last")), *others]
        # no product: autograd hands the cotangents over as they lie
        grads = torch.autograd.grad(outs, [*mine.values()], heads, allow_unused=True)
        results.append(dict(enumerate(outs)) | dict(zip(mine, grads)))
    mine[0] = mine["u" if "u" in mine else "x"]
    for name, want in results[0].items():
        got = results[1][name]
        assert torch.equal(got, want), name
        if name not in (0, *TOKENS) or got.shape != mine[name].shape:
            continue
        if 1 not in (got.shape[1], got.shape[-1]):
            transposed = [x.stride(-1) != 1 and x.stride(1) == 1 for x in (got, mine[name])]
            assert transposed[0] == transposed[1], name
            assert got.is_contiguous() or got.transpose(1, -1).is_contiguous(), name


def scan(**x):
    return selective_scan(**x, delta_softplus=True, return_last_state=True)


def conv(**x):
    return (causal_conv1d(**x, activation="silu"),)


SIZES = [(1, 1, 17), (2, 33, 5), (1, 130, 37), (2, 64, 80), (1, 97, 1), (1, 15, 48)]


@every_mixture
@pytest.mark.parametrize("batch, length, channels", SIZES)
def test_scan(batch, length, channels, mixture):
    assert_same(scan, make(batch, length, channels, 5), mixture)


@every_mixture
@pytest.mark.parametrize("batch, length, channels", SIZES)
def test_conv(batch, length, channels, mixture):
    assert_same(conv, conv_inputs(batch, length, channels, 4), mixture)


@pytest.mark.parametrize("mixture", ["slices", "delta", "the gradient of the output"])
def test_bfloat16(mixture):
    assert_same(scan, make(1, 75, 37, 3, 1, torch.bfloat16), MIXTURES[mixture])
    assert_same(conv, conv_inputs(1, 75, 37, 3, torch.bfloat16), MIXTURES[mixture])


@pytest.mark.parametrize("lengths", [[0, 1, 2, 17, 64, 65, 0, 130, 1], [700, 40]])
@pytest.mark.parametrize("mixture", ["transposed", "cuts", "u and x"])
def test_packed_rows(lengths, mixture):
    cuts = torch.tensor([0, *lengths]).cumsum(0)
    inputs = make(1, sum(lengths), 37, 3)
    inputs["initial_state"] = torch.randn(len(lengths), 37, 3)
    assert_same(lambda **x: scan(**x, cu_seqlens=cuts), inputs, MIXTURES[mixture])
    inputs = conv_inputs(1, sum(lengths), 37, 4)
    inputs["initial_state"] = torch.randn(len(lengths), 3, 37)
    assert_same(lambda **x: conv(**x, cu_seqlens=cuts), inputs, MIXTURES[mixture])


@pytest.mark.parametrize("mixture", ["transposed", "all but u and x"])
def test_segments_groups_and_no_options(mixture):
    """Tokens that are cut for a second thread, groups of channels, another rule, no gate."""
    layouts = MIXTURES[mixture]
    with on_threads(2):
        assert_same(scan, make(1, 1111, 21, 3), layouts)
    assert_same(scan, make(2, 70, 40, 3, groups=2), layouts)
    inputs = {k: x for k, x in make(1, 70, 40, 3).items() if k not in ("D", "z", "delta_bias")}
    inputs["delta"] = inputs["delta"].exp()
    options = {"discretization": "bilinear", "return_last_state": True}
    assert_same(lambda **x: selective_scan(**x, **options), inputs, layouts)
    inputs = {k: x for k, x in make(1, 70, 40, 3).items() if k not in ("C", "D", "z")}
    assert_same(lambda **x: (selective_scan_state(**x, delta_softplus=True),), inputs, layouts)


@pytest.mark.parametrize(
    "length, mixture", [(8208, "transposed"), (8200, "transposed"), (8208, "delta")]
)
def test_large_results(length, mixture):
    """From 32 MiB on they bypass the caches, if all cache lines are whole."""
    inputs = make(1, length, 1024, 1)
    assert_same(scan, inputs, MIXTURES[mixture])
    inputs = conv_inputs(1, length, 1024, 4)
    assert_same(conv, inputs, MIXTURES[mixture])
    cuts = torch.tensor([0, 1001, length])  # where lines are not whole at a sequence's begin
    inputs["initial_state"] = torch.randn(2, 3, 1024)
    assert_same(lambda **x: conv(**x, cu_seqlens=cuts), inputs, MIXTURES[mixture])


def test_mamba_ssm_calls_copy_no_tensor():
    """As Mamba calls them: x and z are halves of one projection, [B, 2 D, L]."""
    x, z = torch.randn(1, 2 * 96, 130).requires_grad_().chunk(2, dim=1)
    inputs = make(1, 130, 96, 4)
    B, C = (inputs[k][:, :, 0].transpose(1, 2).contiguous() for k in "BC")
    delta = inputs["delta"].transpose(1, 2).contiguous().requires_grad_()

    def run():
        u = causal_conv1d_fn(x, torch.ones(96, 4), None, activation="silu")
        out = selective_scan_fn(u, delta, inputs["A"], B, C, None, z, None, True)
        assert u.is_contiguous() and out.is_contiguous()
        du, ddelta, dz = torch.autograd.grad(out, [x, delta, z], torch.randn(out.shape))
        assert du.is_contiguous() and ddelta.is_contiguous() and dz.is_contiguous()

    run()
    with torch.profiler.profile(record_shapes=True) as profile:
        run()
    shapes = [shape for event in profile.events() for shape in event.input_shapes[:1]
              if event.name in ("aten::clone", "aten::copy_")]  # fmt: skip
    assert not [shape for shape in shapes if torch.Size(shape).numel() >= x.numel()]
