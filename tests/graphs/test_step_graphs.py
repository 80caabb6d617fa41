"""Steps repeated by graphs: the same bits as steps one by one, on a recording of operators."""

import gc
import weakref
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from helpers import micro

from gamba_warp.model.gamba import Gamba
from gamba_warp.train import graphs
from gamba_warp.train.batches import Batches, open_data
from gamba_warp.train.checkpoint import RunState, Setup
from gamba_warp.train.log import NoLog
from gamba_warp.train.loop import Outcomes
from gamba_warp.train.objective.losses import Progress, term_weights
from gamba_warp.train.step import Objective, make_step, means

from .recording import RecordedGraphs

RAYS = (*micro.MODEL, "decoder=rays", "ray_cells=2", "ray_layers=3", "ray_features=8")
LOSSES = {
    "rays": {"mask_l1_weight": 0.5, "translucency_weight": 0.1, "radial_mask": False},
    "bins": {"radial_mask": True},  # whose weight falls from step to step
}
STEPS, BAD = 12, 7  # the number of a step whose loss is not finite


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return micro.write_dataset(tmp_path_factory.mktemp("data"), 4)


def squares(got, want):
    return (got - want).square().mean((-3, -2, -1))


def trained(data, out, kind, most):
    """Train with at most so many graphs; return the state, the graphs, and each step's figures.

    As on a GPU, a step's numbers are read with the next step, whose graph has overwritten its own.
    """
    model, lpips = (RAYS, squares) if kind == "rays" else (micro.MODEL, None)
    loss = LOSSES[kind] | ({"lpips_crop": 16} if lpips else {})
    optim = {"ema": 0.9, "lr": 1e-2, "warmup_steps": 1}
    length = {"steps": STEPS}
    config = micro.options(data, out, model, loss=loss, optim=optim, length=length)
    setup = Setup(config, open_data(config), micro.ALONE)
    torch.manual_seed(1)
    state = RunState.begin(Gamba(config.model_config()).train(), setup)

    def changed():
        moments = (x for entry in state.optimizer.state.values() for x in entry.values())
        return [*state.model.parameters(), *state.result.parameters(), *moments]

    kept = RecordedGraphs(changed, most)
    objective = Objective({}, lpips, config.loss.lpips_crop)
    step = make_step(state.model, state.optimizer, state.ema, objective, graphs=kept)
    batches = Batches(setup.data, config, micro.ALONE, lambda number: 2, STEPS)
    outcomes, figures = Outcomes(state, micro.ALONE, NoLog()), []
    for number in range(STEPS):
        batch = batches.take(number)  # with images' stems, as on a GPU
        own = batch.foreground and replace(batch.foreground, boxes=[])
        targets = batch.targets + (torch.nan if number == BAD else 0)
        progress = Progress(number, number / setup.steps_per_epoch, number / STEPS)
        rate = config.optim.lr * state.schedule.fraction(number, 0.0)
        parts = [replace(batch, foreground=own, targets=targets)]
        outcome = step(parts, term_weights(config.loss, progress), rate)
        result = outcome.result
        shown = result.loss, result.rgb, *result.gaussians.tensors().values()
        assert all(x.grad_fn is None for x in shown)  # a graph keeps what it returns
        state.step += 1
        outcomes.add(outcome.stats)
        figures.append(means(outcome) | {"late": outcomes.read(1)})
    outcomes.read()
    batches.close()
    return state, kept, figures


@pytest.mark.parametrize("kind", ["rays", "bins"])
def test_repeated_steps_have_the_same_bits(data, tmp_path, kind):
    one, none, wanted = trained(data, tmp_path / "one", kind, 0)
    other, kept, got = trained(data, tmp_path / "other", kind, 64)
    assert none.replays == 0 and kept.replays >= STEPS // 2
    assert not kept.said
    assert one.skipped == other.skipped == 1
    for a, b in zip(wanted, got, strict=True):
        for name in a:
            np.testing.assert_equal(b[name], a[name], name)  # of the bad step they are NaN
    for name, model in one.models.items():
        theirs = other.models[name].state_dict()
        for key, value in model.state_dict().items():
            assert torch.equal(value, theirs[key]), (name, key)


@dataclass
class Numbers:
    """A batch of one tensor."""

    values: torch.Tensor


@pytest.fixture
def outgrown(monkeypatch):
    """A list; while it is not empty, the lists of the rasterizer are outgrown."""
    found = []
    monkeypatch.setattr(graphs, "lists_outgrown", lambda: bool(found))
    monkeypatch.setattr(graphs, "forget_graphs", found.clear)
    return found


def test_graphs_whose_lists_are_outgrown_are_captured_again(outgrown):
    made, kept = [], RecordedGraphs(list, most=1)

    def doubled(batch):
        made.append(2 * batch.values)
        return made[-1]

    # Of two kinds of steps the first one has the only graph; calls of ``doubled`` after each step.
    batches = [Numbers(torch.full((2,), float(number))) for number in range(8)]
    for number, (key, calls) in enumerate(zip("aaabbbaa", (1, 2, 2, 3, 4, 5, 5, 6))):
        if number == 7:
            outgrown.append("by the step before")
        result = kept.run(batches[number], key, doubled)
        assert result.tolist() == [2.0 * number] * 2 and len(made) == calls
    assert kept.count == 1 and not outgrown
    assert [batch.values[0].item() for batch in batches] == [*range(8)]  # no graph writes to one


class Pools:
    """torch's rule for the pool of a capture: it is new, or one of its graphs still lives."""

    def __init__(self, monkeypatch):
        self.graphs = {}
        monkeypatch.setattr(torch.cuda, "graph_pool_handle", object)
        graph = type("Graph", (), {"replay": lambda self: None})
        monkeypatch.setattr(torch.cuda, "CUDAGraph", graph)
        monkeypatch.setattr(torch.cuda, "graph", self.capture)

    @contextmanager
    def capture(self, graph, pool, stream, capture_error_mode):
        known = self.graphs.setdefault(pool, weakref.WeakSet([graph]))
        gc.collect()
        assert len(known), "the pool's graphs are gone"
        known.add(graph)
        yield


def test_graphs_of_a_grown_scene_have_a_pool_of_their_own(monkeypatch, outgrown):
    said = []
    Pools(monkeypatch)
    monkeypatch.setattr(graphs.StepGraphs, "_on_stream", lambda self: nullcontext())
    kept = graphs.StepGraphs(torch.device("cpu"), said.append)
    batch = Numbers(torch.ones(2))
    for number in range(6):
        if number == 4:
            outgrown.append("by the step before")
        kept.run(batch, "a", lambda batch: batch.values)
    assert said == [] and kept.count == 1


def test_the_graph_of_a_rare_shape_is_dropped():
    kept = RecordedGraphs(list, most=2)
    batch = Numbers(torch.ones(2))
    for key in "aabbbcccc":
        kept.run(batch, key, lambda batch: 2 * batch.values)
    assert [shape[0] for shape in kept._graphs] == ["b", "c"]


def test_a_capture_without_memory_leaves_the_others(monkeypatch):
    kept = RecordedGraphs(list, most=8)
    batch, record = Numbers(torch.ones(2)), kept._record

    def full(run):
        if kept.count:
            raise torch.cuda.OutOfMemoryError("CUDA out of memory")
        return record(run)

    monkeypatch.setattr(kept, "_record", full)
    for key in "aabbaab":
        kept.run(batch, key, lambda batch: 2 * batch.values)
    line = "no CUDA graph of a step: CUDA out of memory; such steps run one by one"
    assert kept.count == 1 and kept.said == [line]


def test_a_step_that_cannot_be_captured_runs_as_before(data, tmp_path, monkeypatch):
    def refuse(self, run):
        raise RuntimeError("operation not permitted\nwhen stream is capturing")

    one, _, _ = trained(data, tmp_path / "one", "bins", 0)
    monkeypatch.setattr(RecordedGraphs, "_record", refuse)
    other, kept, _ = trained(data, tmp_path / "other", "bins", 64)
    line = "no CUDA graph of a step: operation not permitted; such steps run one by one"
    assert kept.replays == 0 and kept.said == [line]
    for name, value in one.model.state_dict().items():
        assert torch.equal(value, other.model.state_dict()[name]), name
