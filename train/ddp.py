"""One process or many: ``torchrun -m gamba_warp.train ...`` sets the environment read here."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import torch
import torch.distributed as dist

from gamba_warp.errors import UserError


@dataclass(frozen=True)
class World:
    """This process's place among all.

    Attributes:
        rank: 0 to ``size`` - 1; rank 0 logs, validates and saves.
        size: number of processes.
        device: where this process computes.
    """

    rank: int
    size: int
    device: torch.device

    @property
    def main(self) -> bool:
        """Whether this process writes files."""
        return self.rank == 0

    def total(self, *values: float) -> list[float]:
        """Sums each value over all processes, on the CPU: no wait for a GPU."""
        if self.size == 1:
            return list(values)
        tensor = torch.tensor(values, dtype=torch.float64)
        dist.all_reduce(tensor)
        return tensor.tolist()

    def barrier(self) -> None:
        """Waits for all processes."""
        self.total(0.0)


@contextmanager
def world(device: str = "auto") -> Iterator[World]:
    """Joins the processes that torchrun started, or stands alone.

    Args:
        device: "auto", "cpu" or "cuda".

    Raises:
        UserError: "cuda" without a GPU.
    """
    if device == "cuda" and not torch.cuda.is_available():
        raise UserError("--device cuda: no CUDA GPU is available")
    size = int(os.environ.get("WORLD_SIZE", "1"))
    rank = int(os.environ.get("RANK", "0"))
    kind = device if device != "auto" else "cuda" if torch.cuda.is_available() else "cpu"
    local = int(os.environ.get("LOCAL_RANK", "0"))
    place = torch.device(kind, local) if kind == "cuda" else torch.device("cpu")
    if kind == "cuda":
        if local >= torch.cuda.device_count():
            raise UserError(f"process {rank} has no GPU: {torch.cuda.device_count()} on this host")
        torch.cuda.set_device(place)
    if size == 1:
        yield World(0, 1, place)
        return
    # Small CPU tensors (stop flags) always go by gloo, gradients on a GPU by NCCL.
    dist.init_process_group("cpu:gloo,cuda:nccl" if kind == "cuda" else "gloo")
    try:
        yield World(rank, size, place)
    finally:
        dist.destroy_process_group()
