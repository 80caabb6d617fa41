"""Graphs of torch with a batch and a length that stay open: ``torch.export``, ``mark_dynamic``."""

import pytest
import torch

from gamba_warp.compat.mamba_ssm import Mamba
from gamba_warp.kernels import causal_conv1d_fn, selective_scan_fn

BATCH = torch.export.Dim("batch", max=64)
# The last tokens of a sequence shorter than the convolution's window are a case of its own.
LENGTH = torch.export.Dim("length", min=4, max=4096)
OPEN = {0: BATCH, 2: LENGTH}


class Scan(torch.nn.Module):
    def forward(self, u, delta, A, B, C, D, z):
        return selective_scan_fn(u, delta, A, B, C, D, z, None, True, return_last_state=True)


class Convolution(torch.nn.Module):
    def forward(self, x, weight):
        return causal_conv1d_fn(x, weight, activation="silu", return_final_states=True)


def scan(batch, length):
    u, delta, z = (torch.randn(batch, 5, length) for _ in range(3))
    B, C = (torch.randn(batch, 4, length) for _ in range(2))
    return u, delta, -torch.rand(5, 4), B, C, torch.randn(5), z


def convolution(batch, length):
    return torch.randn(batch, 5, length), torch.randn(5, 4)


def tokens(batch, length):
    return (torch.randn(batch, length, 6),)


CASES = {
    "scan": (Scan(), scan, (OPEN, OPEN, {}, OPEN, OPEN, {}, OPEN)),
    "convolution": (Convolution(), convolution, (OPEN, {})),
    "Mamba": (Mamba(6, d_state=4), tokens, ({0: BATCH, 1: LENGTH},)),
}


@pytest.mark.parametrize("name", CASES)
def test_an_exported_graph_takes_other_sizes(name):
    module, make, dims = CASES[name]
    exported = torch.export.export(module, make(3, 9), dynamic_shapes=dims).module()
    for sizes in ((5, 17), (2, 8)):
        inputs = make(*sizes)
        torch.testing.assert_close(exported(*inputs), module(*inputs), rtol=0, atol=0)


def test_a_compiled_layer_with_gradients_takes_other_sizes():
    """One graph: a second one would mean that a size was fixed."""
    module, make, _ = CASES["Mamba"]
    torch.compiler.reset()
    torch._dynamo.utils.counters.clear()
    compiled = torch.compile(module, backend="aot_eager", fullgraph=True)
    for sizes in ((3, 9), (5, 17)):
        (x,) = make(*sizes)
        torch._dynamo.mark_dynamic(x, (0, 1))
        sums = (run(x).square().sum() for run in (compiled, module))
        grads = [torch.autograd.grad(total, list(module.parameters())) for total in sums]
        torch.testing.assert_close(*grads)
    assert torch._dynamo.utils.counters["stats"]["unique_graphs"] == 1
