"""The convolution's kernels as CUDA runs them, one channel a thread, on the CPU."""

import pytest
import torch
from helpers import assert_rel_rms
from helpers.kernels import conv_inputs as make
from helpers.scan import assert_gradients, leaves

from gamba_warp.kernels.causal_conv1d import causal_conv1d, kernels, ops
from gamba_warp.kernels.causal_conv1d.reference import causal_conv1d_reference


@pytest.mark.parametrize("use_silu", [0, 1])
def test_convolution_kernels(monkeypatch, use_silu):
    """The scalar form of the shared kernel body, launched on the CPU."""
    inputs = make(2, 300, 19, 4)
    exact = leaves(inputs, torch.float64)
    activation = "silu" if use_silu else None
    out, _ = causal_conv1d_reference(**exact, activation=activation)
    as_cuda = kernels._values
    monkeypatch.setattr(kernels, "_values", lambda _, io: as_cuda("cuda", io))
    monkeypatch.setattr(ops, "cpu_values", ops.cuda_values)
    caches = (kernels.forward_kernel, kernels.backward_kernel)
    for cached in caches:
        cached.cache_clear()
    try:
        mine = leaves(inputs)
        got = causal_conv1d(**mine, activation=activation)
        assert_gradients((mine, [got]), (exact, [out]), 2e-6)
    finally:
        for cached in caches:
            cached.cache_clear()
    assert_rel_rms(got, out, 2e-7, "out")
