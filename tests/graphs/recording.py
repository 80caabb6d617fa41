"""A recording of torch's operators on a CPU, which repeats them as a CUDA graph does launches.

Numbers that Python passed to an operator are repeated as they were; tensors have their new content.
"""

import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from gamba_warp.train.graphs import StepGraphs


class Recording(TorchDispatchMode):
    """Operators of a function, in their order, with the tensors that each took and gave."""

    def __init__(self):
        super().__init__()
        self.calls = []

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        given = kwargs or {}
        made = func(*args, **given)
        self.calls.append((func, args, given, made))
        return made

    @torch.no_grad()
    def replay(self):
        """Repeat all operators, into the tensors that they gave before."""
        for func, args, kwargs, made in self.calls:
            pairs = zip(tree_leaves(made), tree_leaves(func(*args, **kwargs)), strict=True)
            for old, new in pairs:
                if not isinstance(old, torch.Tensor) or old.data_ptr() == new.data_ptr():
                    continue
                if old.shape == new.shape:
                    old.copy_(new)
                else:  # a list as long as it must be, where a GPU has a capacity
                    old.set_(new)


class RecordedGraphs(StepGraphs):
    """``StepGraphs`` on a CPU.

    Attributes:
        state: tensors that a step changes; a capture leaves them as they are.
        replays: number of steps that were repeated.
    """

    def __init__(self, state, most=64):
        self.said, self.replays, self.state = [], 0, state
        super().__init__(torch.device("cpu"), self.said.append, most)

    def _on_stream(self):
        return torch.enable_grad()

    def _record(self, run):
        tensors = self.state()
        saved, draws = [x.detach().clone() for x in tensors], torch.get_rng_state()
        with Recording() as recording:
            result = run()
        with torch.no_grad():
            for x, value in zip(tensors, saved):
                x.copy_(value)
        torch.set_rng_state(draws)
        plain = recording.replay

        def replay():
            self.replays += 1
            plain()

        recording.replay = replay
        return recording, result
