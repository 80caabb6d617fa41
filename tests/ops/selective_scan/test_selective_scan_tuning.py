"""The choice of kernels: a gradient has that of its forward, whatever is in force when it runs."""

import contextlib

import pytest
import torch
import warp as wp
from helpers import assert_rel_rms
from helpers.scan import leaves, make, oracle

from gamba_warp.kernels.selective_scan import ops, selective_scan, selective_scan_state
from gamba_warp.kernels.selective_scan.cpu.tuning import Tuning, use_tuning
from gamba_warp.kernels.selective_scan.cuda import launch as cuda
from gamba_warp.kernels.selective_scan.cuda import tuning as cuda_tuning

# More and fewer saved states than the default: a gradient that took one for the other would read
# past their end, or begin at others' tokens.
CHUNKS = [Tuning(chunk=128), Tuning(chunk=16, strip=8)]
STATE = ("u", "delta", "A", "B", "delta_bias", "initial_state")


def scan(forward, backward, state=False):
    """The result and all gradients of a scan, each direction inside its own context."""
    torch.manual_seed(0)
    inputs = make(2, 173, 24, 5)
    inputs = leaves({k: inputs[k] for k in STATE} if state else inputs)
    with forward:
        out = (selective_scan_state if state else selective_scan)(**inputs, delta_softplus=True)
    with backward:
        return [out.detach(), *torch.autograd.grad(out.square().sum(), list(inputs.values()))]


def same(got, want):
    return all(torch.equal(a, b) for a, b in zip(got, want))


@pytest.mark.parametrize("state", [False, True])
@pytest.mark.parametrize("tuning", CHUNKS)
def test_a_gradient_has_the_tuning_of_its_forward(tuning, state):
    inside, outside = (lambda: use_tuning(tuning)), contextlib.nullcontext
    tuned, default = scan(inside(), inside(), state), scan(outside(), outside(), state)
    assert not same(tuned[1:], default[1:])  # else nothing would be seen
    assert same(scan(inside(), outside(), state), tuned)
    assert same(scan(outside(), inside(), state), default)


@pytest.mark.parametrize("tuning", CHUNKS)
def test_a_compiled_scan_has_the_tuning_of_its_call(tuning):
    """It is an argument of the operator, so that a compiled function has it as well."""
    inputs = make(1, 150, 17, 3)

    def layer(u):
        return selective_scan(**{**inputs, "u": u}, delta_softplus=True)

    compiled = torch.compile(layer, fullgraph=True, backend="aot_eager")
    for context in (contextlib.nullcontext(), use_tuning(tuning), contextlib.nullcontext()):
        u, v = (inputs["u"].clone().requires_grad_() for _ in range(2))
        with context:
            got, want = compiled(u), layer(v)
        (grad,) = torch.autograd.grad(got.square().sum(), u)
        assert same((got, grad), (want, *torch.autograd.grad(want.square().sum(), v)))


@pytest.mark.parametrize("tuning", [Tuning(), *CHUNKS])
def test_a_fake_result_has_the_shape_of_the_tuning(tuning):
    inputs = make(2, 173, 24, 5)
    options = True, "mamba", True, tuning.numbers()
    real = ops.scan(*inputs.values(), *options)
    alone = ops.state(*(inputs[k] for k in STATE), *options)
    with torch._subclasses.fake_tensor.FakeTensorMode() as mode:
        fakes = {k: mode.from_tensor(x) for k, x in inputs.items()}
        fake = ops.scan(*fakes.values(), *options)
        fake_alone = ops.state(*(fakes[k] for k in STATE), *options)
    for a, b in zip((*fake, *fake_alone), (*real, *alone)):
        assert a.shape == b.shape and a.dtype == b.dtype
    assert real[2].shape[1] == -(-173 // tuning.chunk)


@pytest.mark.parametrize("walked, walked_back", [(1, 1), (2, 5)])
def test_states_walked_at_once_change_no_bit(walked, walked_back):
    """Five states are a walk of four and one left over, or five, or two, two and one."""
    tuning = Tuning(walked=walked, walked_back=walked_back)
    outside = contextlib.nullcontext
    assert same(scan(use_tuning(tuning), outside()), scan(outside(), outside()))


def test_the_polynomial_without_avx_512_is_as_exact_as_the_table():
    """1e-6 and 1e-5 are the limits of the accuracy tests, which see the default alone."""
    inputs = make(1, 300, 20, 4)
    theirs = leaves(inputs, torch.float64)
    wants = oracle(**theirs, delta_softplus=True)[0]
    wants = [wants, *torch.autograd.grad(wants.square().sum(), [*theirs.values()])]
    for table in (True, False):
        mine = leaves(inputs)
        with use_tuning(Tuning(table=table)):
            out = selective_scan(**mine, delta_softplus=True)
        got = [out, *torch.autograd.grad(out.square().sum(), [*mine.values()])]
        for name, a, b in zip(("out", *mine), got, wants):
            assert_rel_rms(a, b, 1e-6 if name == "out" else 1e-5, f"{name}, table {table}")


def test_the_forward_walks_fewer_states_where_there_are_few():
    """By the shape alone, so that nothing depends on what was timed."""
    assert Tuning().forward(16) == Tuning(walked=4)
    assert Tuning().forward(8) == Tuning(walked=2)
    chosen = Tuning(strip=64, walked=3)
    assert chosen.forward(4) == chosen == chosen.forward(64)
    for wrong in ({"strip": 0}, {"strip": 48}, {"walked": -1}, {"walked_back": 0}):
        with pytest.raises(ValueError):
            Tuning(**wrong)


def test_numbers_are_the_tuning():
    for tuning in (Tuning(32, 8, 4), cuda_tuning.Tuning(2, 1, 8, 3, 4, 4, 64)):
        assert type(tuning)(*tuning.numbers()) == tuning
        assert tuning.numbers() == list(vars(tuning).values())


def test_cuda_asks_the_shape_or_the_tuning():
    tensor, cuda_device = torch.zeros(1), torch.device("cuda")
    assert ops.tuning_now(tensor) == Tuning().numbers()
    with use_tuning(CHUNKS[0]):
        assert ops.tuning_now(tensor) == CHUNKS[0].numbers()
    asked = cuda_tuning.Tuning(segments=5)
    shape = (1, 999, 64), 16, 1
    assert cuda_tuning.scan_tuning(*shape, cuda_device, asked.numbers()) == asked
    assert cuda_tuning.scan_tuning(*shape, tensor.device) == cuda_tuning.Tuning()
    assert cuda_tuning.current() is None
    with cuda_tuning.use_tuning(asked):
        assert cuda_tuning.current() == asked


def test_block_kernels_run_on_the_tuning_they_are_given(monkeypatch):
    """On CPU blocks: the gradient's segments and block shape are those of its argument."""
    monkeypatch.setattr(wp.config, "enable_cpu_blocks", True)
    inputs = make(1, 200, 33, 4)
    tensors, state = list(inputs.values())[:8], inputs["initial_state"]
    tuning = cuda_tuning.Tuning(segments=2, back_segments=3, back_channels=1, block=64)
    v, needs, results = torch.randn_like(inputs["u"]), [True] * 9, []
    for force in (tuning, cuda_tuning.Tuning()):
        with cuda_tuning.use_tuning(force):
            options = True, "mamba"
            out, last, saved = cuda.forward(*tensors, state, *options, True, tuning.numbers())
            back = v, torch.zeros_like(last), *tensors, saved, *options
            results.append([out, *cuda.backward(*back, needs, tuning.numbers())])
    assert same(*results)
    other = cuda.backward(*back, needs, cuda_tuning.Tuning().numbers())
    assert not same(other, results[0][1:])
