"""Launches: of CUDA without a GPU, of C++ headers, and in Warp's debug mode."""

import ctypes
import os
import sys
import threading
from pathlib import Path

import pytest
import torch
import warp as wp
from helpers.children import ran
from ops.runtime.test_team import Factors

from gamba_warp.kernels.runtime import launch as launches
from gamba_warp.kernels.runtime.launch import parallel_launch
from gamba_warp.kernels.runtime.native import constants, native, native_kernel

wp.set_module_options({"enable_backward": False})
CUDA = torch.device("cuda")


@wp.kernel
def _kernel(a_in: wp.array[wp.float32], two: Factors, count: wp.int64, out: wp.array2d[wp.float32]):
    i, j = wp.tid()
    out[i, j] = a_in[i] + two.one + float(two.two) + float(count)


class Recorded:
    """A recorded launch that keeps what it would hand to the driver."""

    def __init__(self, command, handed):
        self.__dict__.update(vars(command), handed=handed)

    def launch(self, stream):
        params = self.params
        if self.params_addr is not None:
            params = [type(x).from_address(at) for x, at in zip(params, self.params_addr)]
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
    two = Factors()
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
        made.launch = Recorded(made, handed).launch
        delattr(made, lacks)
        return made

    monkeypatch.setattr(wp, "launch", other)
    for count in (1, 2):
        call(torch.randn(3), count, (3, 2))
    assert len(handed) == 2 and not launches._entries
    assert ctypes.sizeof(handed[-1][1][0]) > 0


def test_a_function_of_a_header_is_a_kernel_and_its_text_decides_the_module(tmp_path):
    path, part = tmp_path / "scale.h", tmp_path / "part.h"
    path.write_text(
        '#include "part.h"\n#include "part.h"\n'  # once, as it defines a function
        "template<class Config, class In, class Out>\n"
        "static void scale(int task, const In& in, const Out& out) {\n"
        "    out.y.data[task] = times<Config>(in.x.data[task]) + in.shift;\n"
        "}\n"
    )
    part.write_text(
        "template<class Config> static float times(float x) {\n"
        "    return Config::ODD ? x * Config::HALF : x * Config::TERM;\n"
        "}\n"
    )

    def kernel():
        header = native(path) + constants("Config", TERM=2, HALF=0.5, ODD=True)
        inputs = {"x_in": wp.array(dtype=float), "shift": float}
        call = "scale<Config>"
        outputs = {"y_out": wp.array(dtype=float)}
        return native_kernel("scale", call, inputs, outputs, header, grouped=True)

    first, x, y = kernel(), torch.tensor([1.0, 2.0, 4.0]), torch.zeros(3)
    parallel_launch(first, 3, [x, 0.25], [y], threads=2)
    assert y.tolist() == [0.75, 1.25, 2.25]
    assert kernel().module.get_module_hash() == first.module.get_module_hash()
    part.write_text(part.read_text().replace("HALF", "TERM"))
    assert kernel().module.get_module_hash() != first.module.get_module_hash()


PROGRAM = """
import ops.debug_mode, torch
import warp as wp
from gamba_warp.kernels.runtime.views import view
from helpers.kernels import plain_kernel
x, y = torch.zeros(2, 8)
for room in (7, 6):
    wp.launch(plain_kernel, 7, [view(x[:7]), view(y[:room])], device="cpu")
    print("room for", room, flush=True)
"""


def test_a_write_past_the_end_of_an_array_ends_the_process():
    tests = Path(__file__).parents[2]
    environment = {**os.environ, "PYTHONPATH": str(tests)}
    done = ran(sys.executable, "-c", PROGRAM, env=environment)
    assert done.stdout.endswith("room for 7\n"), done.stdout + done.stderr
    assert done.returncode < 0 and "i < arr.shape[0]" in done.stderr
