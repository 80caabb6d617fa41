"""The scan's CUDA kernels, executed from PTX: sums, strides, tunings, and on a GPU."""

import pytest
import torch
from gpu import checks
from helpers import assert_rel_rms
from helpers.scan import compare, compare_state, make, oracle, run

from gamba_warp.kernels.selective_scan import selective_scan
from gamba_warp.kernels.selective_scan.cuda import launch as cuda
from gamba_warp.kernels.selective_scan.cuda.launch import Tuning

LIMIT = 2e-6  # float32 sums of a few hundred terms; measured below 6e-7
TUNINGS = [Tuning(), *checks.TUNINGS]


@pytest.fixture(autouse=True)
def on_cuda(request):
    """But for tests on a GPU, launches are executed from PTX (tests/ptx)."""
    if "gpu" not in request.keywords:
        request.getfixturevalue("from_ptx")()


@pytest.fixture
def tuned(monkeypatch):
    return lambda tuning: monkeypatch.setattr(cuda, "choose", lambda *_: tuning)


def ours(inputs, heads):
    return run(selective_scan, inputs, heads, return_last_state=True)


def cotangents(inputs):
    return torch.randn_like(inputs["u"]), torch.randn(inputs["u"].shape[0], *inputs["A"].shape)


def test_equal_terms_of_a_sum_do_not_round_to_one_side():
    """A constant input of quick decays; added in a row, these sums are 1e-6 to 2e-5 off."""
    inputs = make(1, 2500, 5, 3)
    inputs = {k: x[:, :1].expand_as(x) if x.dim() > 2 else x for k, x in inputs.items()}
    inputs["A"] = inputs["A"].abs() * -1 - 1
    inputs["delta"] = inputs["delta"].abs() + 1
    v_out = torch.randn_like(inputs["u"][:, :1]).expand_as(inputs["u"])
    heads = v_out, torch.zeros(1, *inputs["A"].shape)
    got, want = ours(inputs, heads), run(oracle, inputs, heads, torch.float64)
    for name in ("A", "D", "delta_bias"):
        assert_rel_rms(got[name], want[name], 6e-7, name)


@pytest.mark.parametrize(
    "states, length",
    [*((3, n) for n in (1, 4, 5, 63, 64, 65, 128)), (1, 66), (17, 66), (40, 66), (256, 9)],
)
def test_lengths_around_a_chunk_and_numbers_of_states(states, length):
    compare(make(1, length, 3, states), LIMIT, LIMIT)


def test_without_options_and_with_strides():
    """B and C are slices of one matrix, u and dout rows of wider ones, as projections give them."""
    inputs = {k: v for k, v in make(2, 70, 21, 3).items() if k in ("u", "delta", "A", "B", "C")}
    inputs["delta"] = inputs["delta"].exp()
    both = torch.cat([inputs["B"], inputs["C"]], -1)
    inputs["B"], inputs["C"] = both[..., :3], both[..., 3:]
    inputs["u"] = torch.randn(2, 70, 50)[..., 7:28]
    heads = (lambda out: torch.randn(2, 70, 22)[..., :21], torch.randn_like)
    compare(inputs, LIMIT, LIMIT, LIMIT, cotangents=heads, delta_softplus=False)


def test_tunings_differ_by_rounding_only(tuned):
    inputs = make(1, 200, 70, 16)
    heads, results = cotangents(inputs), []
    for tuning in TUNINGS:
        tuned(tuning)
        results.append(ours(inputs, heads))
    for result in results[1:]:
        for name, want in results[0].items():
            assert_rel_rms(result[name], want, 1e-6, name)  # rounding of sums in another order
        assert any(not torch.equal(result[k], results[0][k]) for k in result)  # it was another


@pytest.mark.parametrize("tuning", [Tuning(), Tuning(segments=3, back_segments=2)])
@pytest.mark.parametrize("states", [3, 16])
def test_final_state(tuned, tuning, states):
    tuned(tuning)
    compare_state(make(2, 139, 21, states), LIMIT, LIMIT)


@pytest.mark.gpu
@pytest.mark.parametrize("dtype, limit", [(torch.float32, 1e-5), (torch.bfloat16, 4e-3)])
@pytest.mark.parametrize("tuning", [None, *TUNINGS])
@pytest.mark.parametrize("shape", [(2, 577, 70, 16, 1), (1, 65, 40, 3, 2), (1, 100, 20, 40, 1)])
def test_on_a_gpu(tuned, shape, tuning, dtype, limit):
    if tuning is not None:
        tuned(tuning)
    inputs = make(*shape, dtype=dtype)
    heads = cotangents(inputs)
    want = run(oracle, inputs, heads, torch.float64)
    there = {k: x.cuda() for k, x in inputs.items()}
    first, second = (ours(there, [v.cuda() for v in heads]) for _ in range(2))
    for name, value in first.items():
        assert torch.equal(value, second[name]), name
        # the exponential of the GPU errs by up to 2^-22 a step
        kind_limit = 1e-5 if value.dtype == torch.float32 else limit
        assert_rel_rms(value.cpu(), want[name], kind_limit, name)
