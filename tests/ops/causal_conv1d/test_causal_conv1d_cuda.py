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
    monkeypatch.setattr(ops, "VALUES", {"cpu": kernels.VALUES["cuda"]})
    for name in ("forward_kernel", "backward_kernel"):
        made = getattr(kernels, name)
        monkeypatch.setattr(ops, name, lambda _, io, made=made: made("cuda", io))
    mine = leaves(inputs)
    got = causal_conv1d(**mine, activation=activation)
    assert_gradients((mine, [got]), (exact, [out]), 2e-6)
    assert_rel_rms(got, out, 2e-7, "out")
