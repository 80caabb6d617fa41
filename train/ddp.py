"""Training on one or several processes; ``torchrun -m gamba_warp.train ...`` sets the environment.

If one process fails, all end, each with a one-line message: code that may fail on a single process
runs inside ``World.raise_on_all``, and gloo reports a lost process to those that wait for it.
"""

from __future__ import annotations

import inspect
import os
import re
import secrets
import socket
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from typing import Any, TypeVar

import torch
import torch.distributed as dist
from torch.distributed import PrefixStore, Store, TCPStore  # pyright: ignore[reportPrivateImportUsage]
from torch.nn import Module
from torch.nn.parallel import DistributedDataParallel

from gamba_warp.conventions import Precision
from gamba_warp.devices import pick_precision
from gamba_warp.errors import UserError, first_line

Result = TypeVar("Result")
_JOIN_TIMEOUT = timedelta(minutes=5)  # processes start at different times
_TIMEOUT = timedelta(minutes=30)  # of every later exchange
_MAX_SHOWN = 4  # names of a list that a message shows
# Messages of gloo and NCCL about a lost process, as opposed to a bug.
_LOST_PEER = re.compile(
    r"connection (was )?(closed|reset|refused)|broken pipe|remote process|socket closed"
    r"|timed? ?out|heartbeat|gloo/transport",
    re.IGNORECASE,
)


@dataclass(frozen=True)
class World:
    """Process group of a run, as seen from this process.

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
        """True if this process writes files."""
        return self.rank == 0

    def total(self, *values: float) -> list[float]:
        """Sum each value over all processes, on the CPU to avoid waiting for a GPU."""
        if self.size == 1:
            return list(values)
        tensor = torch.tensor(values, dtype=torch.float64)
        dist.all_reduce(tensor)
        return tensor.tolist()

    def precision(self, name: Precision, width: int) -> torch.dtype:
        """Return the dtype of ``pick_precision``, or float32 if the processes disagree."""
        chosen = pick_precision(name, self.device, width)
        (lower,) = self.total(float(chosen != torch.float32))
        return chosen if lower in (0, self.size) else torch.float32

    def mean(self, figures: dict[str, float]) -> dict[str, float]:
        """Average each figure over all processes, which must have the same names."""
        sums = self.total(*(figures[name] for name in sorted(figures)))
        return {name: value / self.size for name, value in zip(sorted(figures), sums)}

    def gather(self, value: Any) -> list[Any]:
        """Gather a picklable value from all processes, by rank."""
        gathered = [value] * self.size
        if self.size > 1:
            dist.all_gather_object(gathered, value)
        return gathered

    def broadcast_from_main(self, action: Callable[[], Result]) -> Result:
        """Run an action on the main process and broadcast its picklable result.

        Raises:
            UserError: as ``raise_on_all``.
        """
        result: list[Any] = [None]
        with self.raise_on_all():
            if self.main:
                result = [action()]
        if self.size > 1:
            dist.broadcast_object_list(result, 0)
        return result[0]

    @contextmanager
    def raise_on_all(self) -> Iterator[None]:
        """Raise on all processes if the body raises on one.

        The body must not communicate between processes.

        Raises:
            UserError: another process, named in the message, has failed; an error of this process
                is re-raised unchanged.
        """
        if self.size == 1:
            yield
            return
        failed = None
        try:
            yield
        except Exception as error:  # any kind: the others must not wait for this process
            failed = error
        reasons = self.gather([socket.gethostname(), "" if failed is None else first_line(failed)])
        if failed is not None:
            raise failed
        for rank, (host, reason) in enumerate(reasons):
            if reason:
                raise UserError(f"process {rank} on {host}: {reason}")

    def wrap(self, model: Module) -> Module:
        """Return the model itself, or with several processes a wrapper that averages gradients.

        The wrapper takes the weights of rank 0. Buffers are constants, so they are not synchronized
        at each step.
        """
        if self.size == 1:
            return model
        # The name of this option depends on the version of torch.
        known = inspect.signature(DistributedDataParallel).parameters
        name = "forward_sync_buffers" if "forward_sync_buffers" in known else "broadcast_buffers"
        group = dist.new_group(backend="nccl") if self.device.type == "cuda" else None
        options: dict[str, Any] = {name: False, "process_group": group}
        return DistributedDataParallel(model, **options)

    def check_consistent(self, facts: Callable[[], Mapping[str, dict[str, object]]]) -> None:
        """Check that all processes have the same setup.

        Args:
            facts: returns names and values by subject, which must be equal on all processes; not
                called with a single process.

        Raises:
            UserError: they differ; the same line on all processes, with the differences.
        """
        if self.size == 1:
            return
        mine: Mapping[str, dict[str, object]] = {}
        with self.raise_on_all():
            mine = facts()
        (host, here), *others = self.gather((socket.gethostname(), mine))
        for rank, (name, there) in enumerate(others, 1):
            parts = []
            for subject, ours in here.items():
                theirs = there[subject]
                both = {
                    k: (theirs.get(k, "missing"), ours.get(k, "missing")) for k in ours | theirs
                }
                shown = [
                    f"{k} is {str(b)[:60]}, not {str(a)[:60]}"
                    for k, (b, a) in both.items()
                    if a != b
                ]
                if shown:
                    parts.append(f"{subject}: {', '.join(sorted(shown)[:_MAX_SHOWN])}")
            if parts:
                raise UserError(
                    f"process {rank} on {name} is not set up like process 0 on {host}: "
                    f"{'; '.join(parts)}"
                )


@contextmanager
def world(device: str = "auto") -> Iterator[World]:
    """Join the processes started by torchrun, or make a world of this single process.

    Args:
        device: "auto", "cpu" or "cuda".

    Raises:
        UserError: "cuda" without a GPU for this process, or another process cannot be reached or
            has ended.
    """
    if device == "cuda" and not torch.cuda.is_available():
        raise UserError("--device cuda: no CUDA GPU is available")
    size, rank, local = (
        int(os.environ.get(name, default))
        for name, default in (("WORLD_SIZE", "1"), ("RANK", "0"), ("LOCAL_RANK", "0"))
    )
    chosen = torch.device("cpu")
    if device == "cuda" or (device == "auto" and torch.cuda.is_available()):
        if local >= torch.cuda.device_count():
            raise UserError(f"process {rank} has no GPU: {torch.cuda.device_count()} on this host")
        chosen = torch.device("cuda", local)
        torch.cuda.set_device(chosen)
    if size == 1:
        yield World(rank=0, size=1, device=chosen)
        return
    try:
        # Small messages (stop flags, errors) use gloo; ``wrap`` uses NCCL for gradients on GPUs,
        # once it is known that all processes have one.
        store = _fresh_store(rank, size)
        dist.init_process_group("gloo", store=store, rank=rank, world_size=size, timeout=_TIMEOUT)
        yield World(rank, size, chosen)
    except RuntimeError as error:
        text = re.sub(r"\[[^][]*\.(cc|cpp):\d+\] ", "", first_line(error))
        network = isinstance(error, (dist.DistNetworkError, dist.DistStoreError))
        if not network and not _LOST_PEER.search(str(error)):
            raise
        raise UserError(
            f"process {rank} on {socket.gethostname()} has lost the others: one of them has ended, "
            f"or cannot be reached ({text[:100]})"
        ) from error
    finally:
        if dist.is_initialized():
            dist.destroy_process_group()


def _fresh_store(rank: int, size: int) -> Store:
    """Store of these processes only, without entries of earlier ones.

    torchrun's own store outlives restarted processes and keeps the addresses of dead ones, for
    which torch waits in vain (tried with torch 2.15). torch 2.6 tells them apart by the number of
    restarts, which each machine counts separately. Here each process has a random name, and all
    continue once they have seen the same names.
    """
    host, port = os.environ.get("MASTER_ADDR", "127.0.0.1"), os.environ.get("MASTER_PORT", "29500")
    served = rank == 0 and os.environ.get("TORCHELASTIC_USE_AGENT_STORE") != "True"
    store = TCPStore(host, int(port), None, served, timeout=_JOIN_TIMEOUT, wait_for_workers=False)
    names, seen = ([f"gamba/{what}/{r}" for r in range(size)] for what in ("name", "seen"))
    store.set(names[rank], secrets.token_hex(8))
    limit = time.monotonic() + _JOIN_TIMEOUT.total_seconds()
    while time.monotonic() < limit:
        group = store.multi_get(names)  # waits for processes that have not joined
        together = b",".join(group)
        store.set(seen[rank], together.decode())
        if {*store.multi_get(seen)} == {together}:
            return PrefixStore(f"gamba/{group[0].decode()}", store)
        time.sleep(0.02)
    raise UserError(f"not all of {size} processes have joined at {host}:{port}")
