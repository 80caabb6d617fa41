"""CPU launches: on torch's threads, on Python's, and in a forked child, the same result."""

import multiprocessing
import sys
import warnings

import pytest
import torch
import warp as wp
from helpers import on_threads

from gamba_warp.kernels.runtime import launch as launches
from gamba_warp.kernels.runtime.launch import has_team, parallel_launch

wp.set_module_options({"enable_backward": False})


@wp.struct
class Factors:
    one: wp.float32
    two: wp.int32


@wp.kernel
def _mix(
    offset: wp.int32,
    factors: Factors,
    a_in: wp.array[wp.float32],
    b_in: wp.array[wp.float32],
    c_out: wp.array2d[wp.float32],
):
    i, j = wp.tid()
    i += offset
    value = factors.one * a_in[i] + float(factors.two * j)
    if b_in:
        value += b_in[i]
    c_out[i, j] = value


def mix(a, b, pieces=None):
    factors = Factors()
    factors.one, factors.two = 0.5, 3
    out = torch.full((a.numel(), 3), torch.nan)
    parallel_launch(_mix, out.shape, [factors, a, b], [out], pieces=pieces)
    want = 0.5 * a[:, None] + 3.0 * torch.arange(3) + (0 if b is None else b[:, None])
    return out, want


NO_TEAM = "torch has no OpenMP runtime with GNU's interface here"
NEEDS_TEAM = pytest.mark.skipif(not has_team(), reason=NO_TEAM)


@pytest.mark.parametrize("with_team", [pytest.param(True, marks=NEEDS_TEAM), False])
@pytest.mark.parametrize("threads", [1, 2, 3])
def test_every_place_once(monkeypatch, with_team, threads):
    if not with_team:
        monkeypatch.setattr(launches, "_parallel", 0)
    with on_threads(threads):
        for size, pieces in ((1, None), (2, 7), (1001, 13)):
            a, b = torch.randn(2, size)
            for second in (b, None):  # an array that is missing after one that was there
                assert torch.equal(*mix(a, second, pieces))


def test_team_is_found_on_linux():
    # torch's Linux wheels bring GNU's runtime; losing it unnoticed would cost speed, not results
    if "GNU" not in torch.__config__.parallel_info() and "OpenMP" not in torch.__config__.show():
        pytest.skip("torch without OpenMP")
    assert has_team() or sys.platform != "linux"


class _Other:
    """A recorded launch of another Warp: it lacks an attribute."""

    def __init__(self, command, lacks):
        self.__dict__ = {k: v for k, v in vars(command).items() if k != lacks}


@NEEDS_TEAM
@pytest.mark.parametrize("lacks", ["hooks", "params", "bounds", "module_exec"])
def test_another_warp_has_no_team_and_says_so_once(monkeypatch, lacks):
    """The launches go to Python's threads, with the same results."""
    launch = wp.launch

    def other(*args, record_cmd=False, **kwargs):
        made = launch(*args, record_cmd=record_cmd, **kwargs)
        return _Other(made, lacks) if record_cmd else made

    monkeypatch.setattr(wp, "launch", other)
    monkeypatch.setattr(launches, "_entries", {})
    monkeypatch.setattr(launches, "_parallel", launches._parallel)  # comes back after the test
    monkeypatch.setattr(torch, "get_num_threads", lambda: 2)
    with pytest.warns(RuntimeWarning, match="stores launches in another form") as said:
        got, want = mix(torch.randn(100), None)
    assert torch.equal(got, want) and len(said) == 1 and not has_team()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert torch.equal(*mix(*torch.randn(2, 33)))


def _child(queue):
    queue.put(has_team())
    got, want = mix(torch.ones(50), None)
    queue.put(torch.equal(got, want))


def test_forked_child():
    if "fork" not in multiprocessing.get_all_start_methods():
        pytest.skip("no fork here")
    assert torch.equal(*mix(torch.ones(50), None))  # the parent's threads exist
    context = multiprocessing.get_context("fork")
    queue = context.Queue()
    child = context.Process(target=_child, args=(queue,))
    child.start()
    assert queue.get(timeout=60) is False
    assert queue.get(timeout=60)
    child.join(60)
    assert child.exitcode == 0
