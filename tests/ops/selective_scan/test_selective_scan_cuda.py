"""The scan's CUDA kernels, executed from PTX: what calls ask for, and every shape of a thread."""

import pytest
import torch
from gpu import checks
from helpers import assert_rel_rms
from helpers.scan import STATE, compare, leaves, make, oracle

from gamba_warp.kernels.selective_scan import selective_scan
from gamba_warp.kernels.selective_scan.cuda import launch as cuda
from gamba_warp.kernels.selective_scan.cuda.launch import Tuning
from gamba_warp.kernels.selective_scan.problem import Inputs, Options, Scan

NAMES = Inputs._fields
LIMIT = 2e-6  # float32 sums of a few hundred terms; measured below 6e-7


@pytest.fixture(autouse=True)
def on_cuda(request):
    """But for tests on a GPU, launches are executed from PTX (tests/ptx)."""
    if "gpu" not in request.keywords:
        request.getfixturevalue("from_ptx")()


@pytest.fixture
def tuned(monkeypatch):
    def switch(tuning):
        monkeypatch.setattr(cuda, "choose", lambda *_: tuning)

    return switch


def run(inputs, discretization, v_out, v_last, softplus=True, needs=None):
    """Outputs, last state and the gradients that are needed (of all inputs), by name."""
    options = Options(None, softplus, discretization, save=True)
    x = Scan(Inputs(*(inputs.get(k) for k in NAMES)), options)
    out, last, saved = cuda.forward(x)
    needed = Inputs(*(k in (needs or inputs) for k in NAMES))
    grads = cuda.backward(v_out, v_last, x, saved, needed)._asdict()
    got = {"out": out} if v_out is not None else {}
    return got | {"last": last} | {k: g for k, g in grads.items() if g is not None}


def exact(inputs, discretization, v_out, v_last, softplus=True):
    """The same from the float64 oracle; ``v_out`` None for the gradients of the last state."""
    inputs = leaves(inputs, torch.float64)
    options = {"delta_softplus": softplus, "discretization": discretization}
    out, last = oracle(**{"C": torch.zeros_like(inputs["B"])} | inputs, **options)
    total = (last * v_last.double()).sum()
    if v_out is not None:
        total = total + (out * v_out.double()).sum()
    grads = torch.autograd.grad(total, [*inputs.values()], allow_unused=True)
    return {"out": out, "last": last, **dict(zip(inputs, grads))}


def cotangents(inputs):
    return torch.randn_like(inputs["u"]), torch.randn(inputs["u"].shape[0], *inputs["A"].shape)


def assert_all(got, want, limit=LIMIT):
    for name in got:
        assert_rel_rms(got[name], want[name], limit, name)


SEGMENTS = Tuning(segments=3, back_segments=2)


def test_equal_terms_of_a_sum_do_not_round_to_one_side():
    """A constant input of quick decays; added in a row, these sums are 1e-6 to 2e-5 off."""
    inputs = make(1, 2500, 5, 3)
    inputs = {k: x[:, :1].expand_as(x) if x.dim() > 2 else x for k, x in inputs.items()}
    inputs["A"] = inputs["A"].abs() * -1 - 1
    inputs["delta"] = inputs["delta"].abs() + 1
    v_out = torch.randn_like(inputs["u"][:, :1]).expand_as(inputs["u"])
    v_last = torch.zeros(1, *inputs["A"].shape)
    got = run(inputs, "mamba", v_out, v_last, needs=("A", "D", "delta_bias"))
    want = exact(inputs, "mamba", v_out, v_last)
    for name in ("A", "D", "delta_bias"):
        assert_rel_rms(got[name], want[name], 6e-7, name)


@pytest.mark.parametrize(
    "states, length",
    [*((3, n) for n in (1, 4, 5, 63, 64, 65, 128)), (1, 66), (17, 66), (40, 66), (256, 9)],
)
def test_lengths_around_a_chunk_and_numbers_of_states(states, length):
    compare(make(1, length, 3, states), LIMIT, LIMIT)


@pytest.mark.parametrize("dtype, limit", [(torch.bfloat16, 4e-3), (torch.float16, 5e-4)])
def test_half_precision(dtype, limit):
    """Limits: one rounding of the dtype, 2^-9 and 2^-12."""
    compare(make(1, 20, 34, 3, dtype=dtype), limit, LIMIT)


def test_without_options_and_with_strides():
    """B and C are slices of one matrix, u and dout rows of wider ones, as projections give them."""
    inputs = {k: v for k, v in make(2, 70, 21, 3).items() if k in NAMES[:5]}
    inputs["delta"] = inputs["delta"].exp()
    both = torch.cat([inputs["B"], inputs["C"]], -1)
    inputs["B"], inputs["C"] = both[..., :3], both[..., 3:]
    inputs["u"] = torch.randn(2, 70, 50)[..., 7:28]
    v_last = torch.randn(2, 21, 3)
    v_out = torch.randn(2, 70, 22)[..., :21]
    assert_all(
        run(inputs, "mamba", v_out, v_last, softplus=False),
        exact(inputs, "mamba", v_out, v_last, softplus=False),
    )


TUNINGS = [Tuning(), *checks.TUNINGS]


def test_tunings_differ_by_rounding_only(tuned):
    inputs = make(1, 200, 70, 16)
    v_out, v_last = cotangents(inputs)
    results = []
    for tuning in TUNINGS:
        tuned(tuning)
        results.append(run(inputs, "mamba", v_out, v_last))
    for result in results[1:]:
        assert_all(result, results[0], 1e-6)  # rounding of sums in another order
        assert any(not torch.equal(result[k], results[0][k]) for k in result)  # it was another


@pytest.mark.parametrize("name", ["C", "z", "A", "D", "initial_state"])
def test_one_gradient_alone(name):
    """Gradients that are not asked for are left out of the kernel, and change nothing."""
    inputs = make(1, 70, 20, 3)
    v_out, v_last = cotangents(inputs)
    alone = run(inputs, "mamba", v_out, v_last, needs=[name])
    assert set(alone) == {"out", "last", name}
    every = run(inputs, "mamba", v_out, v_last)
    assert torch.equal(alone[name], every[name])


@pytest.mark.parametrize("tuning", [Tuning(), SEGMENTS])
@pytest.mark.parametrize("states", [3, 16])
def test_final_state(tuned, tuning, states):
    tuned(tuning)
    inputs = make(2, 139, 21, states)
    _, v_last = cotangents(inputs)
    inputs = {k: inputs[k] for k in STATE}
    got = run(inputs, "mamba", None, v_last)
    assert set(got) == {"last", *STATE}
    assert_all(got, exact(inputs, "mamba", None, v_last))
    needs = ("delta", "A", "delta_bias", "initial_state")
    assert set(run(inputs, "mamba", None, v_last, needs=needs)) == {"last", *needs}


@pytest.mark.parametrize("batch, length", [(0, 5), (2, 0)])
def test_empty(batch, length):
    inputs = make(batch, length, 6, 3)
    v_out, v_last = cotangents(inputs)
    got = run(inputs, "mamba", v_out, v_last)
    assert torch.equal(got["last"], inputs["initial_state"])
    assert torch.equal(got["initial_state"], v_last)
    for name in NAMES[:8]:
        assert got[name].shape == inputs[name].shape
        assert not got[name].any(), name
    alone = run({k: inputs[k] for k in STATE}, "mamba", None, v_last)
    assert torch.equal(alone["last"], inputs["initial_state"])


def gpu_gradients(inputs, v_out, v_last):
    mine = {k: v.cuda().requires_grad_() for k, v in inputs.items()}
    out, last = selective_scan(**mine, delta_softplus=True, return_last_state=True)
    total = (out * v_out.cuda()).sum() + (last * v_last.cuda()).sum()
    grads = torch.autograd.grad(total, [*mine.values()])
    return {"out": out.cpu(), "last": last.cpu()} | {k: g.cpu() for k, g in zip(mine, grads)}


@pytest.mark.gpu
@pytest.mark.parametrize("dtype, limit", [(torch.float32, 1e-5), (torch.bfloat16, 4e-3)])
@pytest.mark.parametrize("tuning", [None, *TUNINGS])
@pytest.mark.parametrize("shape", [(2, 577, 70, 16, 1), (1, 65, 40, 3, 2), (1, 100, 20, 40, 1)])
def test_on_a_gpu(tuned, shape, tuning, dtype, limit):
    if tuning is not None:
        tuned(tuning)
    inputs = make(*shape, dtype=dtype)
    v_out, v_last = cotangents(inputs)
    want = exact(inputs, "mamba", v_out, v_last)
    first, second = (gpu_gradients(inputs, v_out, v_last) for _ in range(2))
    for name, value in first.items():
        assert torch.equal(value, second[name]), name
        # the exponential of the GPU errs by up to 2^-22 a step
        assert_rel_rms(value, want[name], 1e-5 if value.dtype == torch.float32 else limit, name)
