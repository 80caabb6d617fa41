"""Launches on CUDA after a kernel's first, without a GPU: what they hand to Warp."""

import ctypes
import threading

import pytest
import torch
import warp as wp

from gamba_warp.kernels.runtime import launch as launches

wp.set_module_options({"enable_backward": False})
CUDA = torch.device("cuda")


@wp.struct
class Two:
    one: wp.float32
    two: wp.int32


@wp.kernel
def _kernel(a_in: wp.array[wp.float32], two: Two, count: wp.int64, out: wp.array2d[wp.float32]):
    i, j = wp.tid()
    out[i, j] = a_in[i] + two.one + float(two.two) + float(count)


class Recorded:
    """A recorded launch that keeps what it would hand to the driver."""

    def __init__(self, command, handed):
        self.__dict__.update(vars(command), handed=handed)

    def launch(self, stream):
        params = self.params
        if self.params_addr is not None:
            kinds = [type(x) for x in params]
            params = [kind.from_address(at) for kind, at in zip(kinds, self.params_addr)]
        copies = [type(x).from_buffer_copy(x) for x in params]
        self.handed.append((self.bounds, copies, stream))


@pytest.fixture
def handed(monkeypatch):
    found, launch = [], wp.launch

    def record(kernel, dim, arguments, *, block_dim, stream, record_cmd):
        assert record_cmd
        return Recorded(launch(kernel, dim, arguments, device="cpu", record_cmd=True), found)

    monkeypatch.setattr(wp, "launch", record)
    monkeypatch.setattr(launches, "_entries", {})
    monkeypatch.setattr(launches, "_stream", lambda device: "stream")
    return found


def call(a, count, dim):
    out = torch.empty(dim)
    two = Two()
    two.one, two.two = 0.5, count
    launches.cuda_launch(_kernel, dim, [a, two, count], [out], device=CUDA, block_dim=64)
    return out


def test_later_launches_hand_over_their_own_arguments(handed):
    tensors = torch.randn(3), torch.randn(70), None
    for count, a in enumerate(tensors, 1):
        out = call(a, count, (9 * count, 2))
        bounds, (first, array, two, number, result), stream = handed[-1]
        assert [*first.shape][:2] == [9 * count, 2] and first.size == bounds.size == 18 * count
        assert array.data == (0 if a is None else a.data_ptr())
        assert array.shape[0] == (0 if a is None else len(a))
        assert (two.one, two.two, number.value) == (0.5, count, count)
        assert result.data == out.data_ptr() and stream == "stream"
    assert len(handed) == 3 and len(launches._entries) == 1


def test_each_thread_has_a_command_of_its_own(handed):
    call(torch.randn(3), 1, (3, 2))
    (entry,) = launches._entries.values()
    before = entry.command().bounds, entry.command().params_addr
    thread = threading.Thread(target=call, args=(torch.randn(3), 2, (5, 2)))
    thread.start()
    thread.join()
    assert (entry.command().bounds, entry.command().params_addr) == before and len(handed) == 2


@pytest.mark.parametrize("lacks", ["hooks", "params", "module_exec"])
def test_another_warp_launches_as_it_does(handed, monkeypatch, lacks):
    """Its recorded launch has other attributes, so each call makes one of its own."""
    launch = wp.launch

    def other(*args, **kwargs):
        made = launch(*args, **kwargs)
        whole = Recorded(made, handed)
        delattr(made, lacks)
        made.launch = whole.launch
        return made

    monkeypatch.setattr(wp, "launch", other)
    for count in (1, 2):
        call(torch.randn(3), count, (3, 2))
    assert len(handed) == 2 and not launches._entries
    assert ctypes.sizeof(handed[-1][1][0]) > 0
