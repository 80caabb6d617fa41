"""The extension modules that layers call themselves, by every version's arguments."""

import pytest
import torch
import torch.nn.functional as F
from helpers import assert_all_rel_rms, assert_rel_rms, mamba
from helpers.children import ran
from helpers.forked import python
from helpers.mamba import BATCH, CHANNELS, LENGTH

from gamba_warp.compat.causal_conv1d import cpp_functions
from gamba_warp.compat.extensions import EXTENSIONS, extension
from gamba_warp.compat.mamba_ssm.ops import selective_scan_interface as interface
from gamba_warp.compat.mamba_ssm.ops.selective_scan_interface import bimamba_inner_fn

NAMES = ("u", "delta", "A", "B", "C", "D", "z", "delta_bias")
scan, conv = extension("selective_scan_cuda"), extension("causal_conv1d_cuda")


def given(without=(), dtype=torch.float32):
    """Return all tensors of the scan in the order of its arguments, None for those left out."""
    return dict.fromkeys(NAMES) | mamba.scan_inputs(mamba.GROUPED, mamba.GROUPED, dtype, without)


def in_float64(tensors, dout):
    """Output before and after the gate, the last state and the gradients by name."""
    wide = {k: v.double().requires_grad_() for k, v in tensors.items() if v is not None}
    out, last = mamba.scan_in_float64(**wide, softplus=True)
    ungated = mamba.scan_in_float64(**{k: v for k, v in wide.items() if k != "z"}, softplus=True)[0]
    grads = torch.autograd.grad(out, list(wide.values()), dout.double())
    return ungated, out, last, dict(zip(wide, grads))


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16], ids=str)
@pytest.mark.parametrize("without", [(), ("z",), ("D", "z", "delta_bias")], ids=str)
def test_the_scan_of_mamba_ssm(without, dtype):
    limit = 2e-6 if dtype == torch.float32 else 8e-3  # two roundings of 2^-9
    tensors, dout = given(without, dtype), torch.randn(BATCH, CHANNELS, LENGTH).to(dtype)
    ungated, gated, last, grads = in_float64(tensors, dout)
    out, x, *rest = scan.fwd(*tensors.values(), True)
    assert_rel_rms(out, ungated, limit, "out")
    assert_rel_rms(x[:, :, -1, 1::2], last, 2e-6, "last state")
    assert len(rest) == ("z" not in without) and out.is_contiguous() and out.dtype == dtype
    for value in rest:
        assert_rel_rms(value, gated, limit, "out_z")
    into = None if "z" in without else torch.empty(BATCH, 2 * CHANNELS, LENGTH).to(dtype)
    dz = None if into is None else into.chunk(2, 1)[1]
    for recompute in (False, True):
        *got, again = (*scan.bwd(*tensors.values(), dout, x, out, dz, True, recompute), None)
        order = [name for name in NAMES if name != "z"] + ["z"] * (dz is not None)
        if recompute:
            got, again = got[:-1], got[-1]
            assert_rel_rms(again, gated, limit, "out_z again")
        for name, value in zip(order, got, strict=True):
            if tensors[name] is None:
                assert value is None
            else:
                assert value.dtype == tensors[name].dtype
                assert_rel_rms(value, grads[name], 2 * limit, name)
    assert dz is None or got[-1] is dz


@pytest.mark.parametrize("name", ["selective_scan_cuda_core", "selective_scan_cuda_oflex"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float16], ids=str)
def test_the_scans_of_vmamba(name, dtype):
    module, tensors = extension(name), given(("z",), dtype)
    values = [v for k, v in tensors.items() if k != "z"]
    wide_output = [1, True] if name.endswith("oflex") else [1]
    out, x = module.fwd(*values, True, *wide_output)
    assert out.dtype == (torch.float32 if len(wide_output) == 2 else dtype)
    dout = torch.randn(out.shape).to(out.dtype)
    _, want, _, grads = in_float64(tensors, dout)
    assert_rel_rms(out, want, 2e-6 if out.dtype == torch.float32 else 5e-4, "out")
    got = module.bwd(*values, dout, x, True, 1)
    for key, value in zip([n for n in NAMES if n != "z"], got, strict=True):
        assert_rel_rms(value, grads[key], 4e-6 if dtype == torch.float32 else 1e-3, key)


def conv_in_float64(x, weight, bias, before, silu):
    padded = torch.cat([before, x], -1)
    out = F.conv1d(padded, weight[:, None], bias, groups=len(weight))
    return (F.silu(out) if silu else out), padded[..., x.shape[2] :]


@pytest.mark.parametrize("silu", [False, True])
def test_the_convolution_of_every_version(silu):
    x, dout = torch.randn(2, BATCH, CHANNELS, LENGTH)
    weight, bias = torch.randn(CHANNELS, 4), torch.randn(CHANNELS)
    first, dfinal = torch.randn(2, BATCH, CHANNELS, 3)
    for before in (torch.zeros_like(first), first):
        wide = [t.double().requires_grad_() for t in (x, weight, bias, before)]
        outs = conv_in_float64(*wide, silu)
        initial = first if before is first else None
        final, out = torch.empty_like(first), torch.empty_like(x)
        for rest in (
            *([(), (None,)] if initial is None else []),
            (None, initial, None),
            (None, initial, final),
            (None, initial, out, final),
        ):
            got = conv.causal_conv1d_fwd(x, weight, bias, *rest, silu)
            assert_rel_rms(got, outs[0], 1e-6, f"{len(rest)} arguments")
        assert_rel_rms(out, outs[0], 1e-6, "the given output")
        assert torch.equal(final, outs[1].float()), "the last tokens"
        for ends in (None, dfinal):
            douts = (dout.double(), torch.zeros_like(outs[1]) if ends is None else ends.double())
            want = torch.autograd.grad(outs, wide, douts, retain_graph=True)
            into = [torch.empty_like(t) for t in (x, weight, bias, first)]
            into[3] = into[3] if before is first else None
            dx = torch.empty_like(x)
            forms = [(None, initial, ends, dx, initial is not None), (None, initial, ends, *into)]
            oldest = [] if ends is not None or before is first else [(dx,), (None, dx)]
            for rest in (*oldest, *forms):
                got = conv.causal_conv1d_bwd(x, weight, bias, dout, *rest, silu)
                assert len(got) == (3 if len(rest) < 3 else 4)
                for name, value, exact in zip(("x", "weight", "bias", "initial"), got, want):
                    if name != "initial" or before is first:
                        assert_rel_rms(value, exact, 4e-6, f"{name}, {len(rest)} arguments")
                assert got[0] is (into[0] if len(rest) == 7 else dx)
            for value, exact in zip(into, want):
                if value is not None:
                    assert_rel_rms(value, exact, 4e-6, "a given gradient")


def test_packed_sequences_reach_the_convolution():
    x, weight = torch.randn(1, CHANNELS, LENGTH), torch.randn(CHANNELS, 3)
    seq_idx = (torch.arange(LENGTH) >= 5).int()[None]
    parts = x.split([5, LENGTH - 5], -1)
    want = torch.cat([conv.causal_conv1d_fwd(part, weight, None, True) for part in parts], -1)
    for rest in ((seq_idx,), (seq_idx, None, None)):
        assert torch.equal(conv.causal_conv1d_fwd(x, weight, None, *rest, True), want)


def test_the_update_of_every_version():
    x, weight, bias = torch.randn(BATCH, 16), torch.randn(16, 4), torch.randn(16)
    state = torch.randn(BATCH, 16, 4)
    padded = torch.cat([state[..., 1:], x[..., None]], -1)
    want = F.silu((padded * weight).sum(-1) + bias)
    out = torch.empty_like(x)
    for rest in ((True,), (True, None), (True, None, None), (out, True, None, None)):
        given = state.clone()
        got = conv.causal_conv1d_update(x, given, weight, bias, *rest)
        assert torch.allclose(got, want, atol=1e-6) and torch.equal(given, padded)
    assert torch.allclose(out, want, atol=1e-6)
    update = EXTENSIONS["causal_conv1d_cuda"]["causal_conv1d_update"]
    assert cpp_functions.causal_conv1d_update_function is update


@pytest.mark.parametrize("constant", [False, True])
def test_the_blocks_of_the_forks(constant):
    """Without the last projection, and in both directions."""
    tensors = {k: v for k, v in mamba.block_inputs(constant, constant).items() if v is not None}
    ends = {name: tensors.pop(name) for name in ("out_proj_weight", "out_proj_bias")}
    if not constant:
        del tensors["B_proj_bias"], tensors["C_proj_bias"]
    ends["A_b"] = -torch.rand(CHANNELS, mamba.STATES)
    for function, more in ((interface.mamba_inner_fn_no_out_proj, {}), (bimamba_inner_fn, ends)):
        got = mamba.run(function, tensors | more)
        want = mamba.run(mamba.block_in_float64, tensors | more, torch.float64)
        # Float32 through several products: the largest gradients add some hundred terms.
        assert_all_rel_rms(got, want, 5e-6, out=2e-6)
    if not constant:
        order = [*list(tensors)[:5], "out_proj_weight", "out_proj_bias", "A", "A_b"]
        given = tensors | ends
        places = *(given[k] for k in order), None, None, given["D"], given["delta_bias"]
        by_place = interface.bimamba_inner_ref(*places)
        assert torch.equal(by_place, bimamba_inner_fn(**given))


CLIENT = """
import importlib.util, sys
import causal_conv1d_cuda, selective_scan_cuda, selective_scan_cuda_core, selective_scan_cuda_oflex
from selective_scan_cuda import fwd
import gamba_warp.compat.gsplat.cuda._wrapper  # loads no gsplat

assert importlib.util.find_spec("selective_scan_cuda")
assert callable(causal_conv1d_cuda.causal_conv1d_fwd)
print(fwd.__module__, {"mamba_ssm", "gsplat"} & {*sys.modules}, *sys.argv[1:])
"""


def test_a_program_gets_them_by_name(tmp_path):
    (tmp_path / "client.py").write_text(CLIENT)
    words = ("--take", ",".join(EXTENSIONS), tmp_path / "client.py", 3)
    done = ran(python(), "-m", "gamba_warp.compat", *words)
    assert done.stdout == "gamba_warp.compat.extensions set() 3\n", done.stderr
