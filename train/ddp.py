"""One process or many: ``torchrun -m gamba_warp.train ...`` sets the environment read here."""

from __future__ import annotations

import inspect
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch
import torch.distributed as dist
from torch.nn import Module
from torch.nn.parallel import DistributedDataParallel

from gamba_warp.errors import UserError


@dataclass(frozen=True)
class World:
    """This process among all processes of the run.

    Attributes:
        rank: number of this process, 0 to ``size`` - 1; rank 0 logs, validates and saves.
        size: number of processes.
        device: device of this process.
    """

    rank: int
    size: int
    device: torch.device

    @property
    def main(self) -> bool:
        """Whether this is the process that writes files."""
        return self.rank == 0

    def total(self, *values: float) -> list[float]:
        """Sums each value over all processes, on the CPU, so that nobody waits for a GPU."""
        if self.size == 1:
            return list(values)
        tensor = torch.tensor(values, dtype=torch.float64)
        dist.all_reduce(tensor)
        return tensor.tolist()

    def mean(self, figures: dict[str, float]) -> dict[str, float]:
        """Averages each figure over all processes, which must have the same names of figures."""
        names = sorted(figures)
        sums = self.total(*(figures[name] for name in names))
        return {name: value / self.size for name, value in zip(names, sums)}

    def wrap(self, model: Module) -> Module:
        """The model itself, or with several processes one that averages their gradients.

        Buffers are constants here, so they are not sent around at each step.
        """
        if self.size == 1:
            return model
        known = inspect.signature(DistributedDataParallel).parameters
        name = "forward_sync_buffers" if "forward_sync_buffers" in known else "broadcast_buffers"
        options: dict[str, Any] = {name: False}
        return DistributedDataParallel(model, **options)

    def barrier(self) -> None:
        """Waits for all processes."""
        self.total(0.0)


@contextmanager
def world(device: str = "auto") -> Iterator[World]:
    """Joins the processes that torchrun started, or makes a world of this process alone.

    Args:
        device: "auto", "cpu" or "cuda".

    Raises:
        UserError: "cuda" was asked for, and there is no GPU for this process.
    """
    if device == "cuda" and not torch.cuda.is_available():
        raise UserError("--device cuda: no CUDA GPU is available")
    size = int(os.environ.get("WORLD_SIZE", "1"))
    rank = int(os.environ.get("RANK", "0"))
    kind = device if device != "auto" else "cuda" if torch.cuda.is_available() else "cpu"
    local = int(os.environ.get("LOCAL_RANK", "0"))
    chosen = torch.device(kind, local) if kind == "cuda" else torch.device("cpu")
    if kind == "cuda":
        if local >= torch.cuda.device_count():
            raise UserError(f"process {rank} has no GPU: {torch.cuda.device_count()} on this host")
        torch.cuda.set_device(chosen)
    if size == 1:
        yield World(rank=0, size=1, device=chosen)
        return
    # Small CPU tensors (stop flags) always go through gloo, gradients on a GPU through NCCL.
    dist.init_process_group("cpu:gloo,cuda:nccl" if kind == "cuda" else "gloo")
    try:
        yield World(rank, size, chosen)
    finally:
        dist.destroy_process_group()
