"""``gamba gpu-check``'s checks of CUDA graphs, with a graph that runs its function on a CPU."""

import pytest
import torch

from gamba_warp.gpu_check import checks as graphs

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
    """Puts such graphs in place of CUDA's; ``spoil`` may change what a replay returns."""

    def switch(spoil=None):
        def captured(run, device):
            graph = Graph(run, spoil)
            return graph, graph.made, 0

        monkeypatch.setattr(graphs, "captured", captured)
        monkeypatch.setattr(graphs, "lists_outgrown", lambda: True)
        monkeypatch.setattr(torch.cuda, "synchronize", lambda device: None)

    return switch


def test_rendering(graph, monkeypatch):
    graph()
    found = graphs.raster_graph(CPU)
    pairs = [int(n) for n in found.removeprefix("equal, with ").removesuffix(" pairs").split(", ")]
    assert pairs[2] > 1.5 * pairs[0] and pairs[2] > 1.5 * pairs[1]  # more than there is room for
    monkeypatch.setattr(graphs, "lists_outgrown", lambda: False)
    with pytest.raises(AssertionError, match="not meant"):
        graphs.raster_graph(CPU)
    graph(lambda made: made["quats"].mul_(1 + 1e-6))
    with pytest.raises(AssertionError, match="result 4 differs"):
        graphs.raster_graph(CPU)


def test_a_training_step(graph):
    """The same start gives the same bits on a CPU."""
    graph()
    assert graphs.step_graph(CPU) == "losses to 0.0e+00, the weights' change to 0.0e+00"
    graph(lambda loss: loss.mul_(1.001))
    with pytest.raises(AssertionError, match="losses: relative rms error 0.001"):
        graphs.step_graph(CPU)


def test_nothing_waits(monkeypatch):
    """The first calls may wait, the second ones run under torch's own watch, which is put back."""
    modes, ran = ["default"], []

    def run(name):
        ran.append((name, modes[-1]))
        if name == "steps" and modes[-1] == "error":
            raise RuntimeError("called a synchronizing CUDA operation")

    monkeypatch.setattr(torch.cuda, "get_sync_debug_mode", lambda: modes[-1])
    monkeypatch.setattr(torch.cuda, "set_sync_debug_mode", modes.append)
    monkeypatch.setattr(graphs, "render_all", lambda scene: run("splats"))
    monkeypatch.setattr(graphs.TrainingStep, "run", lambda self: run("steps"))
    with pytest.raises(RuntimeError, match="synchronizing"):
        graphs.no_wait(CPU)
    assert ran == [(name, mode) for name in ("splats", "steps") for mode in ("default", "error")]
    assert modes[-1] == "default"
