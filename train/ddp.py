"""One process or many: ``torchrun -m gamba_warp.train ...`` sets the environment read here.

Where one process ends with an error, all end, each with one line: what may fail on one process
alone is done inside ``World.together``, and who waits for one that is gone learns it from gloo.
"""

from __future__ import annotations

import hashlib
import inspect
import json
import os
import re
import secrets
import socket
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from typing import Any, BinaryIO

import torch
import torch.distributed as dist
from torch import Tensor
from torch.distributed import PrefixStore, Store, TCPStore  # pyright: ignore[reportPrivateImportUsage]
from torch.nn import Module
from torch.nn.parallel import DistributedDataParallel

from gamba_warp.conventions import Precision
from gamba_warp.devices import pick_precision
from gamba_warp.errors import UserError, first_line
from gamba_warp.files import sha256, why_not_written

_MEETING = timedelta(minutes=5)  # processes start at different times
_PIECE = 64 << 20  # bytes of a file that are sent at once
_SHOWN = 4  # names of a list that a message shows
# What gloo and NCCL say where another process has gone; of a defect they say other things.
_GONE = re.compile(
    r"connection (was )?(closed|reset|refused)|broken pipe|remote process|socket closed"
    r"|timed? ?out|heartbeat|gloo/transport",
    re.IGNORECASE,
)


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

    def precision(self, name: Precision, width: int) -> torch.dtype:
        """The dtype of ``pick_precision``, and float32 where the processes do not agree."""
        chosen = pick_precision(name, self.device, width)
        (lower,) = self.total(float(chosen != torch.float32))
        return chosen if lower in (0, self.size) else torch.float32

    def mean(self, figures: dict[str, float]) -> dict[str, float]:
        """Averages each figure over all processes, which must have the same names of figures."""
        names = sorted(figures)
        sums = self.total(*(figures[name] for name in names))
        return {name: value / self.size for name, value in zip(names, sums)}

    def gather(self, value: Any) -> list[Any]:
        """Gives every process what each of them has, by rank.

        Args:
            value: what JSON can hold.
        """
        if self.size == 1:
            return [value]
        text = torch.frombuffer(bytearray(json.dumps(value).encode()), dtype=torch.uint8)
        sizes = [torch.zeros(1, dtype=torch.int64) for _ in range(self.size)]
        dist.all_gather(sizes, torch.tensor([len(text)]))
        longest = max(int(size) for size in sizes)
        padded = torch.nn.functional.pad(text, (0, longest - len(text)))
        texts = [torch.empty_like(padded) for _ in range(self.size)]
        dist.all_gather(texts, padded)
        pairs = zip(texts, sizes)
        return [json.loads(bytes(got[: int(size)].numpy()).decode()) for got, size in pairs]

    @contextmanager
    def together(self) -> Iterator[None]:
        """What is done in it ends on all processes with an error if it does so on one of them.

        In it the processes must not exchange anything.

        Raises:
            UserError: of another process, which it names; an error of this one stays what it is.
        """
        if self.size == 1:
            yield
            return
        failed = None
        try:
            yield
        except Exception as error:  # any: the others must not wait for this process
            failed = error
        reasons = self.gather([socket.gethostname(), "" if failed is None else first_line(failed)])
        if failed is not None:
            raise failed
        for rank, (host, reason) in enumerate(reasons):
            if reason:
                raise UserError(f"process {rank} on {host}: {reason}")

    def wrap(self, model: Module) -> Module:
        """The model itself, or with several processes one that averages their gradients.

        Its weights are then those of rank 0. Buffers are constants here, so they are not sent
        around at each step.
        """
        if self.size == 1:
            return model
        known = inspect.signature(DistributedDataParallel).parameters
        name = "forward_sync_buffers" if "forward_sync_buffers" in known else "broadcast_buffers"
        options: dict[str, Any] = {name: False}
        if self.device.type == "cuda":
            options["process_group"] = dist.new_group(backend="nccl")
        return DistributedDataParallel(model, **options)

    def barrier(self) -> None:
        """Waits for all processes."""
        self.total(0.0)

    def agree(self, facts: Callable[[], Mapping[str, Mapping[str, object]]]) -> None:
        """Refuses processes that would not do the same work.

        Args:
            facts: gives names and values by subject, all of which must be the same on all
                processes; it is not called where there is one process alone.

        Raises:
            UserError: they are not; the same line on all processes, with what differs.
        """
        if self.size == 1:
            return
        mine: dict[str, dict[str, Any]] = {}
        with self.together():
            mine = json.loads(json.dumps(facts(), default=str))
        digests = {subject: _digest(known) for subject, known in mine.items()}
        hosts, seen = zip(*self.gather([socket.gethostname(), digests]))
        subjects = [s for s in mine if any(found[s] != seen[0][s] for found in seen)]
        others = [rank for rank in range(self.size) if seen[rank] != seen[0]]
        if not others:
            return
        whole = self.gather({subject: mine[subject] for subject in subjects})
        first = others[0]
        parts = [_difference(s, whole[0].get(s, {}), whole[first].get(s, {})) for s in subjects]
        who = f"process {first} on {hosts[first]}"
        if len(others) > 1:
            who += f", like {len(others) - 1} more,"
        raise UserError(
            f"{who} is not set up as process 0 on {hosts[0]}: {'; '.join(filter(None, parts))}"
        )

    @contextmanager
    def copied(self, folder: Path | None) -> Iterator[Path | None]:
        """Gives all processes the files of a folder that the main one sees.

        Who has the same files in a folder of that name, as on a shared disk, gets that name; the
        others get a copy, which goes in the end. So the processes need no disk in common.

        Args:
            folder: of the main process, with plain files alone; None: there is none. What the other
                processes pass does not count.

        Raises:
            UserError: the folder cannot be read, or a copy of it cannot be written.
        """
        if self.size == 1:
            yield folder
            return
        files: dict[str, list[Any]] = {}
        with self.together():
            if self.main and folder is not None:
                found = sorted(path for path in folder.iterdir() if path.is_file())
                files = {path.name: [path.stat().st_size, sha256(path)] for path in found}
        name, files = self.gather([None if folder is None else str(folder), files])[0]
        if name is None:
            yield None
            return
        there = self.main or _holds(Path(name), files)
        if all(self.gather(there)):
            yield Path(name)
            return
        with tempfile.TemporaryDirectory(prefix="gamba-") as place:
            self._send(Path(name), files, None if there else Path(place))
            yield Path(name) if there else Path(place)

    def _send(self, source: Path, files: dict[str, list[Any]], place: Path | None) -> None:
        """Sends files from the main process to all, which write them where they have a place."""
        failed: OSError | None = None
        for name, (size, _) in files.items():
            reader: BinaryIO | None = open(source / name, "rb") if self.main else None
            for start in range(0, size, _PIECE):
                piece = torch.empty(min(_PIECE, size - start), dtype=torch.uint8)
                if reader is not None:
                    piece = torch.frombuffer(bytearray(reader.read(len(piece))), dtype=torch.uint8)
                dist.broadcast(piece, 0)
                try:  # a full disk here must not stop what the others receive
                    if place is not None and failed is None:
                        _append(place / name, piece)
                except OSError as error:
                    failed = error
            if reader is not None:
                reader.close()
        with self.together():
            if failed is not None:
                reason = why_not_written(failed) or str(failed)
                raise UserError(f"cannot write a copy of {source}: {reason}")


def _append(path: Path, piece: Tensor) -> None:
    with open(path, "ab") as file:
        file.write(piece.numpy().tobytes())


def _holds(folder: Path, files: Mapping[str, list[Any]]) -> bool:
    """Whether a folder has just these files, by their sizes and SHA-256."""
    try:
        return all(
            (folder / name).stat().st_size == size and sha256(folder / name) == digest
            for name, (size, digest) in files.items()
        )
    except (OSError, UserError):
        return False


def _digest(values: object) -> str:
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()


def _difference(subject: str, main: dict[str, Any], other: dict[str, Any]) -> str:
    """What differs in one subject, in a few words; "" where nothing does."""
    names = sorted(name for name in {*main, *other} if main.get(name) != other.get(name))
    if not names:
        return ""
    shown = []
    for name in names[:_SHOWN]:
        here, there = main.get(name), other.get(name)
        if name not in other or name not in main:
            shown.append(f"{name} is {'missing' if name in main else 'added'}")
        elif re.fullmatch("[0-9a-f]{64}", str(here)):  # a hash says nothing to people
            shown.append(f"{name} is another")
        else:
            shown.append(f"{name} is {str(there)[:60]}, not {str(here)[:60]}")
    more = f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
    return f"{subject}: {', '.join(shown)}{more}"


@contextmanager
def world(device: str = "auto") -> Iterator[World]:
    """Joins the processes that torchrun started, or makes a world of this process alone.

    Args:
        device: "auto", "cpu" or "cuda".

    Raises:
        UserError: "cuda" was asked for, and there is no GPU for this process; or another process
            cannot be reached, or has gone.
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
    try:
        # What is small (stop flags, errors) goes through gloo; ``wrap`` takes NCCL for gradients
        # on GPUs, after it is known that all processes have one.
        store = _meet(rank, size)
        dist.init_process_group("gloo", store=store, rank=rank, world_size=size)
        yield World(rank, size, chosen)
    except RuntimeError as error:
        text = re.sub(r"\[[^][]*\.(cc|cpp):\d+\] ", "", first_line(error))
        network = isinstance(error, (dist.DistNetworkError, dist.DistStoreError))
        if not network and not _GONE.search(str(error)):
            raise
        raise UserError(
            f"process {rank} on {socket.gethostname()} has lost the others: one of them has ended, "
            f"or cannot be reached ({text[:100]})"
        ) from error
    finally:
        if dist.is_initialized():
            dist.destroy_process_group()


def _meet(rank: int, size: int) -> Store:
    """Joins the processes that were started with this one, and gives them a store of their own.

    torchrun's store outlives the processes that it starts anew, and holds addresses of dead ones.
    torch tells them apart by the number of restarts, which each machine counts for itself, so that
    machines wait for one another in vain. Here each process has a random name, to which rank 0
    answers with that of the group.
    """
    host, port = os.environ.get("MASTER_ADDR", "127.0.0.1"), os.environ.get("MASTER_PORT", "29500")
    held = os.environ.get("TORCHELASTIC_USE_AGENT_STORE") == "True"  # by torchrun itself
    store = TCPStore(
        host, int(port), None, rank == 0 and not held, timeout=_MEETING, wait_for_workers=False
    )
    mine = secrets.token_hex(8)
    store.set(f"gamba/name/{rank}", mine)
    if rank:
        group = store.get(f"gamba/group-of/{mine}").decode()
        store.set(f"gamba/{group}/knows/{rank}", "")
        return PrefixStore(f"gamba/{group}", store)
    told: dict[int, bytes] = {}
    limit, missing = time.monotonic() + _MEETING.total_seconds(), set(range(1, size))
    while missing:
        for other in [*missing]:
            if store.check([f"gamba/{mine}/knows/{other}"]):
                missing.remove(other)
            elif store.check([f"gamba/name/{other}"]):
                name = store.get(f"gamba/name/{other}")
                if told.get(other) != name:  # the first may be of a dead one
                    store.set(f"gamba/group-of/{name.decode()}", mine)
                    told[other] = name
        if time.monotonic() > limit:
            raise UserError(f"processes {sorted(missing)} of {size} have not come to {host}:{port}")
        time.sleep(0.02)
    return PrefixStore(f"gamba/{mine}", store)
