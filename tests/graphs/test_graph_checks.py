"""The checks of CUDA graphs (tests/gpu), with a graph that runs its function on a CPU."""

import pytest
import torch
from gpu import checks

from gamba_warp.train import timing

CPU = torch.device("cpu")


class Graph:
    """Graph that runs a function at each replay, and copies the result into the first one."""

    def __init__(self, run, spoil=None):
        self.run, self.spoil, self.made = run, spoil, run()

    def replay(self):
        made = self.run()
        if self.spoil is not None:
            self.spoil(made)
        pairs = [(self.made, made)]
        if isinstance(made, dict):
            pairs = [(self.made[name], value) for name, value in made.items()]
        for old, new in pairs:
            old.copy_(new)


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
    graph()
    pairs = checks.check_raster_graph(CPU)
    assert pairs[2] > 1.5 * pairs[0] and pairs[2] > 1.5 * pairs[1]  # more than there is room for
    monkeypatch.setattr(checks, "lists_outgrown", lambda: False)
    with pytest.raises(AssertionError, match="have room"):
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


@pytest.mark.parametrize("check", ["check_no_wait", "check_step"])
def test_no_wait(monkeypatch, check):
    """The first call may wait, the second one runs under torch's own watch, which is put back."""
    modes, ran = ["default"], []

    def run(*_):
        ran.append(modes[-1])
        if modes[-1] == "error":
            raise RuntimeError("called a synchronizing CUDA operation")

    monkeypatch.setattr(torch.cuda, "get_sync_debug_mode", lambda: modes[-1])
    monkeypatch.setattr(torch.cuda, "set_sync_debug_mode", modes.append)
    monkeypatch.setattr(checks, "render_all", run)
    monkeypatch.setattr(timing.Step, "run", run)
    with pytest.raises(RuntimeError, match="synchronizing"):
        getattr(checks, check)(CPU)
    assert ran == ["default", "error"] and modes[-1] == "default"


def test_compiled():
    checks.check_compiled("aot_eager", CPU)
