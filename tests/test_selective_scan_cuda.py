"""The CUDA kernels without a GPU: small shapes on CPU blocks, and compiled ahead of time."""

import pytest
import torch
import warp as wp
from helpers import assert_rel_rms, resources
from test_causal_conv1d import make as make_conv
from test_selective_scan import leaves, make

from gamba_warp.kernels.selective_scan import causal_conv1d, conv, cpu, cuda, selective_scan
from gamba_warp.kernels.selective_scan.reference import (
    causal_conv1d_reference,
    selective_scan_reference,
)

ORDER = ("u", "delta", "A", "B", "C", "D", "z", "delta_bias")


@pytest.fixture
def cpu_blocks(monkeypatch):
    """CPU launches with real blocks; without it a sum over a block is one thread's own value."""
    monkeypatch.setattr(wp.config, "enable_cpu_blocks", True)


def run(module, inputs, discretization, v_out, v_last):
    tensors = [inputs.get(k) for k in ORDER]
    state = inputs.get("initial_state")
    out, last, saved = module.forward(*tensors, state, True, discretization, True)
    needs = [k in inputs for k in (*ORDER, "initial_state")]
    grads = module.backward(v_out, v_last, *tensors, saved, True, discretization, needs)
    return out, last, *(grad for grad in grads if grad is not None)


@pytest.mark.parametrize(
    "shape, discretization",
    [
        ((2, 139, 37, 3, 1), "mamba"),
        ((1, 70, 80, 3, 2), "mamba"),
        ((2, 1, 1, 3, 1), "mamba"),
        ((1, 67, 35, 16, 1), "mamba"),
        ((1, 70, 20, 3, 1), "bilinear"),
        ((1, 70, 20, 3, 1), "zoh"),
    ],
)
def test_block_kernels_equal_lane_kernels_and_oracle(cpu_blocks, shape, discretization):
    inputs = make(*shape)
    v_out, v_last = torch.randn_like(inputs["u"]), torch.randn_like(inputs["initial_state"])
    blocks = run(cuda, inputs, discretization, v_out, v_last)
    by_lanes = run(cpu, inputs, discretization, v_out, v_last)
    exact = leaves(inputs, torch.float64)
    out, last = selective_scan_reference(
        **exact, delta_softplus=True, discretization=discretization
    )
    total = (out * v_out.double()).sum() + (last * v_last.double()).sum()
    wants = (out, last, *torch.autograd.grad(total, [*exact.values()]))
    for name, block, lane, want in zip(("out", "last", *exact), blocks, by_lanes, wants):
        assert_rel_rms(block, want, 5e-6, name)  # float32 sums over 2 * 139 tokens
        assert_rel_rms(block, lane, 5e-6, name)


def test_block_kernels_in_bfloat16_without_options(cpu_blocks):
    inputs = {k: make(1, 20, 34, 3, dtype=torch.bfloat16)[k] for k in ORDER[:5]}
    v_out = torch.randn_like(inputs["u"])
    blocks = run(cuda, inputs, "mamba", v_out, None)
    by_lanes = run(cpu, inputs, "mamba", v_out, None)
    for name, block, lane in zip(("out", "last", *inputs), blocks, by_lanes):
        assert_rel_rms(block, lane, 4e-3, name)  # one bfloat16 rounding, 2^-9


def test_sums_need_blocks():
    """Without CPU blocks dB is wrong, so the tests above do see the reduction."""
    inputs = make(1, 5, 20, 3)
    v_out = torch.randn_like(inputs["u"])
    assert not wp.config.enable_cpu_blocks
    blocks = run(cuda, inputs, "mamba", v_out, None)
    by_lanes = run(cpu, inputs, "mamba", v_out, None)
    place = 2 + ORDER.index("B")
    assert not torch.allclose(blocks[place], by_lanes[place], rtol=0.1)


@pytest.mark.parametrize("use_silu", [0, 1])
def test_convolution_kernels(monkeypatch, use_silu):
    """The scalar form of the shared kernel body, launched on the CPU."""
    inputs = make_conv(2, 300, 19, 4)
    exact = leaves(inputs, torch.float64)
    activation = "silu" if use_silu else None
    out, _ = causal_conv1d_reference(**exact, activation=activation)
    v_out = torch.randn_like(inputs["x"])
    wants = torch.autograd.grad((out * v_out.double()).sum(), [*exact.values()])
    as_cuda = conv._values
    monkeypatch.setattr(conv, "_values", lambda _, io: as_cuda("cuda", io))
    monkeypatch.setattr(conv, "cpu_values", conv.cuda_values)
    caches = (conv._forward_kernel, conv._backward_kernel)
    for cached in caches:
        cached.cache_clear()
    try:
        mine = leaves(inputs)
        got = causal_conv1d(**mine, activation=activation)
        grads = torch.autograd.grad((got * v_out).sum(), [*mine.values()])
    finally:
        for cached in caches:
            cached.cache_clear()
    assert_rel_rms(got, out, 2e-7, "out")
    for name, grad, want in zip(mine, grads, wants):
        assert_rel_rms(grad, want, 2e-6, f"gradient of {name}")


# registers and stack bytes, about a tenth above what the compiler used when this was written
BOUNDS = {
    "summarise_forward": (88, 0),
    "scan_forward": (88, 0),
    "summarise_backward": (104, 0),
    "scan_backward": (240, 2400),  # the stack holds 8 + 8 states of 16 floats, and their zeros
}


@pytest.mark.parametrize("name", BOUNDS)
def test_compiles_ahead_of_time(tmp_path, name):
    kernel = cuda.kernels(torch.bfloat16, torch.bfloat16, "mamba", 16)[name]
    module = kernel.module
    before = module.options["block_dim"]
    module.options["block_dim"] = cuda.BLOCK
    try:
        paths = wp.compile_aot_module(module, arch=[80, 90], module_dir=tmp_path, use_ptx=False)
    finally:
        module.options["block_dim"] = before
    assert len(paths) == 2
    for path in paths:
        registers, stack = resources(path.read_bytes())
        assert 16 <= registers <= BOUNDS[name][0], (path.name, registers)
        assert stack <= BOUNDS[name][1], (path.name, stack)


@pytest.mark.gpu
@pytest.mark.parametrize("dtype, limit", [(torch.float32, 5e-6), (torch.bfloat16, 4e-3)])
@pytest.mark.parametrize("shape", [(2, 577, 70, 16, 1), (1, 65, 40, 3, 2)])
def test_on_a_gpu(shape, dtype, limit):
    inputs = make(*shape, dtype=dtype)
    exact = leaves(inputs, torch.float64)
    mine = {k: v.cuda().requires_grad_() for k, v in inputs.items()}
    out, last = selective_scan(**mine, delta_softplus=True, return_last_state=True)
    want, want_last = selective_scan_reference(**exact, delta_softplus=True)
    v_out, v_last = torch.randn_like(want), torch.randn_like(want_last)
    v_out = v_out.to(dtype).double()
    grads = torch.autograd.grad(
        (out * v_out.cuda().to(dtype)).sum() + (last * v_last.cuda().float()).sum(),
        [*mine.values()],
    )
    wants = torch.autograd.grad(
        (want * v_out).sum() + (want_last * v_last).sum(), [*exact.values()]
    )
    assert_rel_rms(out.cpu(), want, limit, "out")
    assert_rel_rms(last.cpu(), want_last, 5e-6, "last state")
    for name, grad, expected in zip(mine, grads, wants):
        assert_rel_rms(grad.cpu(), expected, limit, f"gradient of {name}")
