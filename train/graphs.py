"""CUDA graphs of the training step, one for each shape of a batch.

A graph repeats the launches of its capture. Whatever changes from step to step is therefore in
tensors of fixed addresses: the batch, which is copied there, and the numbers of ``number``.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Hashable, Iterator
from contextlib import contextmanager
from dataclasses import is_dataclass
from typing import Any, NamedTuple, TypeVar

import torch
from torch import Tensor

from gamba_warp.errors import first_line
from gamba_warp.kernels.rasterize import forget_graphs, lists_outgrown

from .config import TrainConfig
from .data.samples import Batch, copied
from .ddp import World
from .log import say

MOST = 64  # graphs that are kept; each holds the results of a step
Result = TypeVar("Result")


class _Recorded(NamedTuple):
    """Graph of a step, the batch that it reads, and the results that it overwrites."""

    graph: torch.cuda.CUDAGraph
    batch: Batch
    result: Any


def open_graphs(
    config: TrainConfig, world: World, optimizer: torch.optim.Optimizer
) -> StepGraphs | None:
    """Prepare CUDA graphs of the steps; None on a CPU, or if a step has several parts."""
    if world.device.type != "cuda":
        return None
    if config.views.accumulate > 1 or world.size > 1:
        if world.main and config.run.graph == "auto":
            why = "--accumulate" if config.views.accumulate > 1 else "several processes"
            say(f"no CUDA graphs with {why}")
        return None
    for group in optimizer.param_groups:
        group["capturable"] = True
    return StepGraphs(world.device, say, MOST if config.run.graph == "auto" else 0)


class StepGraphs:
    """Graphs of a run on one GPU.

    The first step of a shape has no graph: it finds the rasterizer's capacity, and libraries set
    themselves up. The second one is captured. All run on one stream, which is not torch's default.
    """

    def __init__(self, device: torch.device, say: Callable[[str], None], most: int = MOST) -> None:
        """Make no graph yet.

        Args:
            device: a GPU.
            say: gets one line if a step cannot be captured.
            most: graphs that are kept; 0 for none.
        """
        self._device, self._say, self._most = device, say, most
        self._stream: Any = None
        self._pool: Any = None
        self._numbers: dict[str, Tensor] = {}
        self._times: Counter[Hashable] = Counter()  # how often a shape occurred
        self._graphs: dict[Hashable, _Recorded] = {}

    @property
    def count(self) -> int:
        """Number of graphs."""
        return len(self._graphs)

    def number(self, name: str, value: float) -> Tensor:
        """Return a float32 scalar on the device, the same tensor each time, with a new value."""
        if name not in self._numbers:
            self._numbers[name] = torch.zeros((), device=self._device)
        return self._numbers[name].fill_(value)

    def run(self, batch: Batch, key: Hashable, step: Callable[[Batch], Result]) -> Result:
        """Run a step, or repeat the graph of an equal one.

        Args:
            batch: on the device.
            key: whatever else decides which launches a step makes.
            step: makes a step with a batch; it must not wait for the device.

        Returns:
            The result of ``step``. The next step of its shape overwrites its tensors.
        """
        with self._on_stream():
            return self._run(batch, key, step)

    def _run(self, batch: Batch, key: Hashable, step: Callable[[Batch], Result]) -> Result:
        if self._graphs and lists_outgrown():
            self._graphs.clear()
            self._pool = None  # torch refuses one whose graphs are all gone while tensors use it
            forget_graphs()
        shape = key, *((x.shape, x.dtype) if isinstance(x, Tensor) else x for x in _fields(batch))
        recorded = self._graphs.get(shape)
        if recorded is None and self._times[shape] and self._can_add(shape):
            recorded = self._capture(shape, batch, step)
        self._times[shape] += 1
        if recorded is None:
            return step(batch)
        for static, fresh in zip(_fields(recorded.batch), _fields(batch), strict=True):
            if isinstance(static, Tensor):
                static.copy_(fresh)
        recorded.graph.replay()
        return recorded.result

    def _can_add(self, shape: Hashable) -> bool:
        """Return True if a graph may be added, in place of one of a rarer shape if need be."""
        if len(self._graphs) < self._most:
            return True
        rarest = min(self._graphs, key=self._times.__getitem__, default=None)
        if rarest is None or self._times[rarest] >= self._times[shape]:
            return False
        del self._graphs[rarest]
        return True

    def _capture(
        self, shape: Hashable, batch: Batch, step: Callable[[Batch], Any]
    ) -> _Recorded | None:
        """Capture a step, which does not run it; None if that fails."""
        static = copied(batch)
        on_gpu = self._device.type == "cuda"
        state = torch.cuda.get_rng_state(self._device) if on_gpu else None
        try:
            graph, result = self._record(lambda: step(static))
        except Exception as error:  # of torch, a library or the driver; steps work without graphs
            if state is not None:  # which a capture that failed may have left unusable
                torch.cuda.set_rng_state(state, self._device)
            self._most = len(self._graphs)  # of steps that fit, which stay
            self._say(f"no CUDA graph of a step: {first_line(error)}; such steps run one by one")
            return None
        recorded = self._graphs[shape] = _Recorded(graph, static, result)
        return recorded

    @contextmanager
    def _on_stream(self) -> Iterator[None]:
        if self._stream is None:
            self._stream = torch.cuda.Stream(self._device)
        current = torch.cuda.current_stream(self._device)
        self._stream.wait_stream(current)
        with torch.cuda.stream(self._stream):
            yield
        current.wait_stream(self._stream)

    def _record(self, run: Callable[[], Result]) -> tuple[torch.cuda.CUDAGraph, Result]:
        if self._pool is None:  # graphs that never run together may share their memory
            self._pool = torch.cuda.graph_pool_handle()
        graph = torch.cuda.CUDAGraph()
        # The threads that load data allocate memory meanwhile, which "global" would forbid.
        mode = "thread_local"
        with torch.cuda.graph(graph, self._pool, self._stream, capture_error_mode=mode):
            result = run()
        return graph, result


def _fields(value: Any) -> Iterator[Any]:
    """Yield the fields of a dataclass and of those in it, in order, without lists.

    Shapes of the tensors and all other values are baked into the launches of a step.
    """
    for field in vars(value).values():
        if is_dataclass(field):
            yield from _fields(field)
        elif not isinstance(field, list):  # names, and images that only a CPU uses
            yield field
