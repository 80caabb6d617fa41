"""The pool that large tensors on the CPU come from: who may have a block, and when it goes."""

import os
import sys
import threading

import pytest
import torch

from gamba_warp.kernels import causal_conv1d_fn, rasterization, selective_scan, selective_scan_fn
from gamba_warp.kernels.runtime import memory
from gamba_warp.kernels.runtime.memory import LARGE, Pool

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="there is a pool on Linux only")

MOST = 8 * LARGE


@pytest.fixture
def pool(monkeypatch):
    own = Pool(MOST)
    monkeypatch.setattr(memory, "pool", own)
    return own


def test_a_block_comes_back_with_the_last_tensor_over_it(pool):
    x = memory.empty((3, LARGE // 4 + 5), torch.float32)
    assert x.shape == (3, LARGE // 4 + 5) and x.dtype == torch.float32 and x.is_contiguous()
    place, view = x.data_ptr(), x[2, 7:].detach()
    view.fill_(3.0)
    del x
    assert pool.size() == 0  # the view holds it
    other = memory.empty((3, LARGE // 4 + 5), torch.float32)
    other.zero_()
    assert other.data_ptr() != place and view.eq(3.0).all()
    del view
    assert pool.size() > 3 * LARGE
    assert memory.empty((3, LARGE // 4), torch.float32).data_ptr() == place


def test_autograd_holds_its_block(pool):
    weight = torch.ones((), requires_grad=True)
    x = memory.empty((LARGE,), torch.float32).fill_(2.0)
    y = (x * weight).sum()
    del x
    memory.empty((LARGE,), torch.float32).fill_(-1.0)
    assert torch.autograd.grad(y, weight)[0] == 2.0 * LARGE


def test_blocks_of_another_size_are_left(pool):
    small, large = (memory.empty((n * LARGE,), torch.uint8) for n in (1, 4))
    places = small.data_ptr(), large.data_ptr()
    del small, large
    assert memory.empty((2 * LARGE,), torch.uint8).data_ptr() == places[1]  # not more than twice
    assert memory.empty((LARGE - 1,), torch.uint8).data_ptr() not in places  # not large at all
    assert memory.empty((LARGE,), torch.uint8).data_ptr() == places[0]


def test_the_pool_keeps_its_bound_and_the_newest(pool):
    held = [memory.empty((2 * LARGE,), torch.uint8) for _ in range(6)]
    last = held[-1].data_ptr()
    while held:
        held.pop(0)
        assert pool.size() <= MOST
    assert memory.empty((2 * LARGE,), torch.uint8).data_ptr() == last
    memory.release()
    assert pool.size() == 0


def test_threads_never_share_a_block(pool):
    wrong = []

    def work(number: int) -> None:
        for _ in range(200):
            x = memory.empty((LARGE // 4,), torch.float32)
            x[::4096] = number
            if not x[::4096].eq(number).all():
                wrong.append(number)

    threads = [threading.Thread(target=work, args=(i,)) for i in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert wrong == [] and 0 < pool.size() <= MOST


def test_an_operator_does_not_overwrite_its_last_result(pool):
    u, delta = torch.randn(1, 1100, 1024), torch.rand(1, 1100, 1024)
    A, B = -torch.rand(1024, 1), torch.randn(1, 1100, 1)
    first = selective_scan(u, delta, A, B, B)
    before = first.clone()
    second = selective_scan(-u, delta, A, B, B)
    assert torch.equal(first, before) and torch.equal(second, -before)
    place = first.data_ptr()
    del first
    assert selective_scan(u, delta, A, B, B).data_ptr() == place


def _convolution(x):
    return causal_conv1d_fn(x.transpose(1, 2), torch.linspace(-1, 1, 3).expand(x.shape[2], 3))


def _scan(x):
    A, B = -torch.ones(x.shape[2], 1), torch.ones(len(x), 1, x.shape[1])
    return selective_scan_fn(x.transpose(1, 2), x.detach().abs().transpose(1, 2), A, B, B)


def _image(x):
    means = torch.tensor([[0.0, 0, 0], [0.3, 0.2, 0.1]])
    colors = x[0, :2, :5]
    camera = torch.eye(4).index_put((torch.tensor(2), torch.tensor(3)), torch.tensor(3.0))[None]
    K = torch.tensor([[[500.0, 0, 256], [0, 500, 256], [0, 0, 1]]])
    scales, opacities = torch.full((2, 3), 0.1), torch.full((2,), 0.7)
    return rasterization(means, None, scales, opacities, colors, camera, K, 512, 512)[0]


@pytest.mark.parametrize("call", [_convolution, _scan, _image])
@pytest.mark.parametrize("compiled", [False, True])
def test_a_large_result_can_be_changed_in_place(call, compiled):
    """With torch's own results it can; autograd refuses it of a view that an operator made."""

    def changed(x):
        y = call(x)
        y += 1
        y *= y.detach().sign()
        return y

    x = torch.randn(2, 1024, 1024, requires_grad=True)
    run = torch.compile(changed, fullgraph=True, backend="aot_eager") if compiled else changed
    got, apart = run(x), call(x) + 1
    want = apart * apart.detach().sign()
    assert got.nbytes >= LARGE and torch.equal(got, want)
    (grad,), (expected,) = (torch.autograd.grad(y.square().sum(), x) for y in (got, want))
    assert torch.equal(grad, expected) and grad.abs().sum() > 0


@pytest.mark.parametrize("chosen, most", [("0", 0), ("7", 7 << 20)])
def test_the_environment_sets_the_bound(monkeypatch, chosen, most):
    monkeypatch.setenv("GAMBA_POOL", chosen)
    assert memory._most() == most
    monkeypatch.setattr(memory, "pool", Pool(most))
    x = memory.empty((2 * LARGE,), torch.uint8)
    del x
    assert memory.pool.size() <= most


def test_the_bound_is_a_part_of_the_memory(monkeypatch):
    monkeypatch.setenv("GAMBA_POOL", "many")
    total = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    assert 0 < memory._most() <= total // 8


@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_a_forked_child_begins_with_an_empty_pool():
    memory.empty((LARGE,), torch.uint8).zero_()
    assert memory.pool.size() > 0
    if (child := os.fork()) == 0:
        os._exit(0 if memory.pool.size() == 0 else 1)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
    memory.release()
