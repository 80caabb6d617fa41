"""Room for the pairs of a call's lists on CUDA, remembered: so no call waits for their count.

The first call of a shape reads its number of pairs back. From then on a call takes the room that
the calls before it needed, and the device tells its own count later, into memory that the host
reads without waiting. A count that has no room is no error: see ``composite_unlisted``. Pictures
and gradients have the same bits whatever the room, so it does not matter when a count arrives.
"""

from __future__ import annotations

import threading
from collections.abc import Hashable
from dataclasses import dataclass
from typing import no_type_check

import torch
import warp as wp
from torch import Tensor

from ...runtime.launch import launch
from ...runtime.stand_in import is_dry

wp.set_module_options({"enable_backward": False})

_PLACES = 4096  # shapes that are remembered; then the oldest are forgotten
_MOST = 2**31 - 1  # pairs are numbered in int32


@dataclass
class Room:
    """Capacity remembered for a shape.

    Attributes:
        place: its place in the ledger.
        capacity: pairs that the next call has room for.
        captured: the least capacity that a CUDA graph holds; None: no graph was captured.
    """

    place: int
    capacity: int
    captured: int | None = None


class _Ledger:
    """The counts of a device by shape, there and as they were told.

    Attributes:
        highs: ``[places]`` int64 on the device, the largest count of late.
        told: a copy on the host, made by the device when it gets there.
        rooms: what is remembered, the oldest first.
    """

    def __init__(self, device: torch.device):
        pinned = device.type == "cuda" and not is_dry()
        self.highs = torch.zeros(_PLACES, dtype=torch.int64, device=device)
        self.told = torch.zeros(_PLACES, dtype=torch.int64, pin_memory=pinned)
        self.rooms: dict[Hashable, Room] = {}

    def read(self, place: int) -> int:
        """The count last told; numpy reads memory, where torch might wait for the device."""
        return int(self.told.numpy()[place])


_ledgers: dict[torch.device, _Ledger] = {}
_lock = threading.Lock()


@wp.kernel
@no_type_check
def _note(
    offset: wp.int32, place: wp.int32, count_in: wp.array[wp.int64], highs_out: wp.array[wp.int64]
):
    # a count that was large once is forgotten slowly: it has halved after 45 calls
    high = highs_out[place]
    highs_out[place] = wp.max(high - high / wp.int64(64), count_in[0])


def in_steps(number: int) -> int:
    """The next number, up to an eighth larger, of which there are few: eight of each length."""
    step = 1 << max(0, number.bit_length() - 4)
    return -(-number // step) * step


def wanted(count: int) -> int:
    """Room for half as many pairs again."""
    return min(_MOST, in_steps(count + count // 2))


def is_capturing(device: torch.device) -> bool:
    """True if torch's current stream is being captured into a CUDA graph."""
    return device.type == "cuda" and not is_dry() and torch.cuda.is_current_stream_capturing()


def find(key: Hashable, device: torch.device) -> Room | None:
    """The room of a shape, changed if the counts told since then ask for it; None if unknown."""
    ledger = _ledgers.get(device)
    room = ledger.rooms.get(key) if ledger is not None else None
    if ledger is None or room is None:
        return None
    count = ledger.read(room.place)
    if count > _MOST:  # no list can hold them, so those that there are do
        return room
    fitting = wanted(count)
    if room.capacity < fitting and 4 * room.capacity < 5 * count or room.capacity > 4 * fitting:
        room.capacity = fitting
    return room


def captured(room: Room, capacity: int) -> None:
    """Notes the room that a CUDA graph holds."""
    room.captured = capacity if room.captured is None else min(capacity, room.captured)


def remember(key: Hashable, device: torch.device, count: int) -> Room:
    """Makes room for a shape whose count was read back."""
    if is_dry():  # a dry run has no memory and leaves nothing behind
        return Room(0, wanted(count))
    with _lock:
        if device not in _ledgers:
            _ledgers[device] = _Ledger(device)
        ledger = _ledgers[device]
        if len(ledger.rooms) < _PLACES:
            place = len(ledger.rooms)
        else:
            place = ledger.rooms.pop(next(iter(ledger.rooms))).place
        ledger.highs[place].fill_(count)
        ledger.told.numpy()[place] = count
        if device.type == "cuda":  # the next call may be on another stream
            torch.cuda.current_stream(device).synchronize()
        room = ledger.rooms[key] = Room(place, wanted(count))
    return room


def tell(room: Room, count: Tensor) -> None:
    """Has the device note a count, ``[1]`` int64, and copy it to the host when it gets there."""
    dry = is_dry()
    ledger = _Ledger(count.device) if dry else _ledgers[count.device]
    launch(_note, 1, [room.place, count], [ledger.highs], count.device)
    if not dry:
        part = slice(room.place, room.place + 1)
        ledger.told[part].copy_(ledger.highs[part], non_blocking=True)


def lists_outgrown() -> bool:
    """True if a CUDA graph was captured with room for fewer pairs than it had recently.

    Its pictures and gradients are right all the same, but slow. A capture after this, of the same
    shapes, has room; it does not wait for the device, which may be some replays ahead or behind.
    """
    rooms = [(ledger, room) for ledger in _ledgers.values() for room in ledger.rooms.values()]
    return any(r.captured is not None and ledger.read(r.place) > r.captured for ledger, r in rooms)


def forget() -> None:
    """Forgets all shapes, as a test needs it; CUDA graphs go on writing where they did."""
    for ledger in _ledgers.values():
        ledger.rooms.clear()
