"""The checks of CUDA graphs (tests/gpu), with a graph that runs its function on a CPU."""

import pytest
import torch
from gpu import checks
from torch.utils._pytree import tree_map

CPU = torch.device("cpu")


class Graph:
    """Graph that runs a function at each replay, and copies the result into the first one."""

    def __init__(self, run, spoil=None):
        self.run, self.spoil, self.made = run, spoil, run()

    def replay(self):
        made = self.run()
        if self.spoil is not None:
            self.spoil(made)
        tree_map(torch.Tensor.copy_, self.made, made)


@pytest.fixture
def graph(monkeypatch):
    """Function that puts such graphs in place of CUDA's; ``spoil`` may change a replay's result."""

    def switch(spoil=None):
        def captured(run, device):
            graph = Graph(run, spoil)
            return graph, graph.made

        monkeypatch.setattr(checks, "captured", captured)
        monkeypatch.setattr(checks, "lists_outgrown", lambda: True)
        monkeypatch.setattr(torch.cuda, "synchronize", lambda device: None)

    return switch


def test_rendering(graph, monkeypatch):
    counts = []

    def spoil(made):  # as where the lists are too short
        counts.append(int(made["pairs"]))
        if counts[-1] > 1.5 * counts[0]:
            made["renders"].fill_(torch.nan)
            made["alphas"].fill_(torch.nan)

    graph(spoil)
    pairs = checks.check_raster_graph(CPU)
    assert pairs[2] > 1.5 * pairs[0] and pairs[2] > 1.5 * pairs[1]
    monkeypatch.setattr(checks, "lists_outgrown", lambda: False)
    with pytest.raises(AssertionError, match="the lists hold"):
        checks.check_raster_graph(CPU)
    graph(lambda made: made["quats"].mul_(1 + 1e-6))
    with pytest.raises(AssertionError, match="result 4 differs"):
        checks.check_raster_graph(CPU)


def test_layer(graph):
    graph()
    checks.check_layer_graph(CPU)
    graph(lambda out: out[0, 0, 0].add_(1e-6))
    with pytest.raises(AssertionError, match="result 0 differs"):
        checks.check_layer_graph(CPU)


def test_compiled():
    checks.check_compiled("aot_eager", CPU)
