"""The scan against its float64 oracle: outputs, every gradient by name, states, bad input."""

import pytest
import torch
from helpers import assert_same_on_threads, on_threads, rel_rms
from helpers.scan import (
    STATE,
    assert_gradient_alone,
    compare,
    compare_state,
    device_errors,
    every_discretization,
    leaves,
    make,
    of_squares,
    oracle,
)

from gamba_warp.kernels.selective_scan import selective_scan, selective_scan_state
from gamba_warp.kernels.selective_scan.cpu import launch as cpu
from gamba_warp.kernels.selective_scan.cpu.launch import Extent, Layout
from gamba_warp.kernels.selective_scan.cuda import launch as cuda
from gamba_warp.kernels.selective_scan.problem import Inputs, Options, Scan
from gamba_warp.kernels.selective_scan.reference import selective_scan_reference


@pytest.fixture(autouse=True)
def _two_threads():
    """Enough for the kernels' splitting; more only make the oracle's small loops wait."""
    with on_threads(2):
        yield


@pytest.mark.parametrize(
    "batch, length, channels, states, groups",
    [
        (1, 1, 1, 1, 1),
        (2, 2, 17, 3, 1),
        (3, 17, 33, 16, 1),
        (2, 63, 80, 3, 2),
        (1, 65, 37, 64, 1),
        (1, 577, 35, 16, 1),
        (1, 40, 12, 2, 12),
    ],
)
def test_matches_oracle(batch, length, channels, states, groups):
    compare(make(batch, length, channels, states, groups))


@pytest.mark.parametrize("discretization", ["bilinear", "zoh"])
def test_other_discretizations(discretization):
    inputs = make(2, 130, 21, 5)
    inputs["A"][:, 0] = -1e-3  # x near 0, where (e^x - 1) / x needs its series
    compare(inputs, discretization=discretization)


def test_without_options():
    """No D, z, bias, softplus or initial state; B and C without a group dimension."""
    inputs = make(2, 33, 19, 4)
    inputs = {k: inputs[k] for k in ("u", "delta", "A", "B", "C")}
    inputs["delta"] = inputs["delta"].exp()
    inputs["B"], inputs["C"] = inputs["B"][:, :, 0], inputs["C"][:, :, 0]
    compare(inputs, delta_softplus=False)


@pytest.mark.usefixtures("each_device")
@pytest.mark.parametrize(
    "length, delta, bias", [*((n, 0, 3.0) for n in (15, 17, 63, 65, 130)), (200, 40, 0.0)]
)
def test_public_reports(length, delta, bias):
    """Issues 368 and 880 of mamba-ssm do not happen here.

    Behind the last token a step is not 0 once bias and softplus have been applied. With steps of
    40 and A down to -16, sums of δA over a chunk pass the exponent's range, in both signs.
    """
    inputs = make(1, length, 5, 3)
    inputs["delta"] += delta
    inputs["delta_bias"] = torch.full((5,), bias) if bias else inputs["delta_bias"]
    compare(inputs)


@pytest.mark.usefixtures("each_device")
@pytest.mark.parametrize(
    "dtype, of_delta, limit",
    [
        (torch.bfloat16, torch.bfloat16, 4e-3),
        (torch.float16, torch.float16, 5e-4),
        (torch.bfloat16, torch.float32, 4e-3),
    ],
)
def test_half_precision(dtype, of_delta, limit):
    """Limits: the rounding of the dtype itself, 2^-9 and 2^-12 at most, on output only."""
    inputs = make(2, 65, 37, 3, dtype=dtype)
    compare(inputs | {"delta": inputs["delta"].to(of_delta)}, limit, 2e-6)


@pytest.mark.usefixtures("each_device")
@pytest.mark.parametrize("name", ["B", "C"])
def test_b_or_c_alone_in_half_precision(name):
    """The other keeps its float32: results have the bits of both in float32."""
    inputs = make(1, 20, 34, 3)
    inputs[name] = inputs[name].bfloat16()
    half, whole = (of_squares(x) for x in (inputs, inputs | {name: inputs[name].float()}))
    for key, got, want in zip(("out", *inputs), half, whole):
        assert torch.equal(got, want.to(got.dtype)), key
        assert got.dtype == (torch.bfloat16 if key == name else torch.float32)


@pytest.mark.usefixtures("each_device")
@pytest.mark.parametrize("name", Inputs._fields[:9])
def test_one_gradient_alone(name):
    assert_gradient_alone(selective_scan, make(2, 70, 20, 3), name, delta_softplus=True)


@pytest.mark.parametrize("kernels", [cpu, cuda])
@pytest.mark.parametrize("name, absent", [("C", ()), ("A", ("C", "D", "z"))])
def test_unneeded_gradients_are_not_computed(name, absent, kernels, from_ptx):
    """Gradients of the whole scan, and of the last state alone."""
    inputs = Inputs(**make(1, 10, 5, 2))._replace(**dict.fromkeys(absent))
    if kernels is cuda:
        from_ptx()
    x = Scan(inputs, Options(None, True, "mamba", save=True))
    out, last, saved = kernels.forward(x)
    v_out = None if absent else torch.ones_like(out)
    needs = Inputs(*(k == name for k in Inputs._fields))
    grads = kernels.backward(v_out, torch.ones_like(last), x, saved, needs)
    assert Inputs(*(g is not None for g in grads)) == needs


@every_discretization
def test_oracle_gradients_by_finite_differences(discretization):
    inputs = leaves(make(1, 4, 3, 2), torch.float64)

    def run(*values):
        options = {"delta_softplus": True, "discretization": discretization}
        return selective_scan_reference(**dict(zip(inputs, values)), **options)

    assert torch.autograd.gradcheck(run, tuple(inputs.values()), fast_mode=True)


def test_one_step_by_hand():
    """δ = 0.5, A = -2, B = 3, u = 4, h = 1: h' = e^-1 + 6; with C = 2, D = 1: y = 2h' + 4."""
    one = torch.ones(1, 1, 1)
    out, last = selective_scan(
        4 * one, 0.5 * one, torch.tensor([[-2.0]]), 3 * one, 2 * one, torch.ones(1),
        initial_state=one, return_last_state=True,
    )  # fmt: skip
    state = torch.tensor(-1.0).exp() + 6
    torch.testing.assert_close(last.flatten()[0], state)
    torch.testing.assert_close(out.flatten()[0], 2 * state + 4)


@pytest.mark.parametrize("cut", [1, 64, 100])
def test_split_consistency(cut):
    """scan(x, y) = scan(x), then scan(y) from its last state."""
    inputs = make(2, 150, 20, 3)
    tokens = ("u", "delta", "B", "C", "z")
    whole, last = selective_scan(**inputs, delta_softplus=True, return_last_state=True)
    parts, state = [], inputs["initial_state"]
    for piece in (slice(0, cut), slice(cut, None)):
        part = {k: v[:, piece] if k in tokens else v for k, v in inputs.items()}
        part["initial_state"] = state
        out, state = selective_scan(**part, delta_softplus=True, return_last_state=True)
        parts.append(out)
    # equal to rounding only: cuts move tokens to other chunks, not to other operations; on CUDA to
    # other segments, over which a product of decays is one exponential
    more = device_errors(oracle, inputs, decays=2.0**-24, delta_softplus=True)
    assert rel_rms(torch.cat(parts, 1), whole) < 1e-7 + more["out"]
    assert rel_rms(state, last) < 1e-7 + more["last"]


def test_repeatable_and_independent_of_threads():
    inputs = make(2, 200, 150, 5)
    assert_same_on_threads(lambda: of_squares(inputs), 1, 1, 2)


def test_strided_inputs_are_not_copied():
    """Halves of one projection are views with a longer row; results equal those of dense copies."""
    inputs = make(2, 40, 20, 3)
    both = torch.cat([inputs["u"], inputs["z"]], -1)
    dense = selective_scan(**inputs, delta_softplus=True)
    inputs["u"], inputs["z"] = both.chunk(2, -1)
    assert not inputs["u"].is_contiguous()
    assert torch.equal(selective_scan(**inputs, delta_softplus=True), dense)
    inputs["u"] = inputs["u"].transpose(1, 2).contiguous().transpose(1, 2)
    assert torch.equal(selective_scan(**inputs, delta_softplus=True), dense)


def test_extreme_steps():
    """Softplus at -100, 20 and 100, decays of 0 and e^-10000: finite, and equal to the oracle."""
    inputs = make(1, 60, 18, 4)
    inputs["delta"][:, ::3] = torch.tensor([-100.0, 19.999, 20.001, 100.0, 0, -20]).repeat(3)
    inputs["A"][:, 0], inputs["A"][:, 1] = 0.0, -1e4
    del inputs["delta_bias"]
    compare(inputs)


def test_small_steps_keep_relative_accuracy():
    """A step of 1e-8 over long memory: only log1p, not log(1 + x), gives it."""
    inputs = make(1, 20, 16, 2)
    inputs["delta"] = torch.full((1, 20, 16), -18.0)
    inputs = {k: inputs[k] for k in ("u", "delta", "A", "B", "C")}
    compare(inputs)


def test_growing_states_and_nan_are_passed_on():
    inputs = make(1, 20, 17, 2)
    inputs["A"] = inputs["A"].abs() * 0.01
    compare(inputs)
    inputs["u"][0, 5, 3] = torch.nan
    out = selective_scan(**inputs, delta_softplus=True)
    bad = torch.isnan(out[0])
    assert bad[5:, 3].all()
    assert not bad[:5].any() and not bad[:, :3].any() and not bad[:, 4:].any()


@pytest.mark.usefixtures("each_device")
@pytest.mark.parametrize("batch, length", [(0, 5), (2, 0), (0, 0)])
def test_empty(batch, length):
    inputs = leaves(make(batch, length, 6, 3))
    out, last = selective_scan(**inputs, delta_softplus=True, return_last_state=True)
    assert out.shape == (batch, length, 6) and last.shape == (batch, 6, 3)
    assert torch.equal(last, inputs["initial_state"])
    grads = torch.autograd.grad(out.sum() + (2 * last).sum(), [*inputs.values()])
    for (name, x), grad in zip(inputs.items(), grads):
        assert grad.shape == x.shape, name
        assert (grad == (2 if name == "initial_state" else 0)).all(), name
    alone = {name: inputs[name] for name in STATE}
    assert torch.equal(selective_scan_state(**alone, delta_softplus=True), last)


@pytest.mark.parametrize(
    "name, change, error",
    [
        ("u", lambda x: x[0], ValueError),
        ("u", lambda x: x.double(), TypeError),
        ("u", lambda x: x.numpy(), TypeError),
        ("delta", lambda x: x[:, :-1], ValueError),
        ("A", lambda x: x.bfloat16(), TypeError),
        ("A", lambda x: x[:, :0], ValueError),
        ("A", lambda x: x[0], ValueError),
        ("B", lambda x: x[..., :-1], ValueError),
        ("B", lambda x: x.expand(-1, -1, 4, -1), ValueError),
        ("C", lambda x: x.expand(-1, -1, 3, -1), ValueError),
        ("D", lambda x: x[:-1], ValueError),
        ("z", lambda x: x.half(), TypeError),
        ("delta_bias", lambda x: x[None], ValueError),
        ("initial_state", lambda x: x.transpose(1, 2), ValueError),
        ("initial_state", lambda x: x.double(), TypeError),
        ("B", lambda x: x.to("meta"), ValueError),
    ],
)
def test_bad_input_names_the_argument(name, change, error):
    inputs = make(2, 5, 6, 3)
    inputs[name] = change(inputs[name])
    with pytest.raises(error, match=rf"^{name} "):
        selective_scan(**inputs)


def test_bad_options():
    inputs = make(2, 5, 6, 3)
    with pytest.raises(ValueError, match="discretization must be one of .*got 'euler'"):
        selective_scan(**inputs, discretization="euler")
    inputs = {k: v for k, v in make(1, 2, 3, 257).items() if k in ("u", "delta", "A", "B", "C")}
    with pytest.raises(ValueError, match="N from 1 to 256"):
        selective_scan(**inputs)


def test_no_second_derivative():
    inputs = leaves(make(1, 5, 4, 2))
    out = selective_scan(**inputs, delta_softplus=True)
    (grad,) = torch.autograd.grad(out.sum(), inputs["u"], create_graph=True)
    with pytest.raises(RuntimeError, match="second derivatives"):
        grad.sum().backward()


@pytest.mark.parametrize("read", [True, False])
def test_operator_contract(read):
    """Schema, fake tensors, autograd registration and AOT tracing, by torch's own checker."""
    x = Inputs(**leaves(make(2, 7, 5, 2)))
    x = x if read else x._replace(C=None, D=None, z=None)
    arguments = *x, *Options(None, True, "mamba", save=True)
    torch.library.opcheck(torch.ops.gamba_warp.selective_scan.default, arguments)


def test_a_compiled_scan_is_the_scan():
    inputs = make(1, 150, 17, 3)

    def layer(u):
        return selective_scan(**{**inputs, "u": u}, delta_softplus=True)

    compiled = torch.compile(layer, fullgraph=True, backend="aot_eager")
    u, v = (inputs["u"].clone().requires_grad_() for _ in range(2))
    got, want = compiled(u), layer(v)
    (grad,) = torch.autograd.grad(got.square().sum(), u)
    assert torch.equal(got, want)
    assert torch.equal(grad, *torch.autograd.grad(want.square().sum(), v))


@pytest.mark.parametrize("at_once, back_at_once", [(1, 1), (2, 5)])
def test_states_computed_together_change_no_bit(at_once, back_at_once, monkeypatch):
    """Five states are four together and one left over, or five, or two, two and one."""
    inputs, results = make(2, 173, 24, 5), []
    for tuning in (cpu.TUNING, cpu.Tuning(at_once=at_once, back_at_once=back_at_once)):
        monkeypatch.setattr(cpu, "TUNING", tuning)
        results.append(of_squares(inputs))
    assert all(map(torch.equal, *results))


@pytest.mark.parametrize("table", [True, False])
def test_the_polynomial_without_avx_512_is_as_exact_as_the_table(table, monkeypatch):
    monkeypatch.setattr(cpu, "TUNING", cpu.Tuning(table=table))
    compare(make(1, 300, 20, 4))


@pytest.fixture(params=[2, 5])
def threads(request):
    with on_threads(request.param):
        yield request.param


@every_discretization
@pytest.mark.parametrize("shape", [(2, 70, 35, 5, 1), (1, 1, 12, 3, 3), (1, 131, 80, 16, 2)])
def test_state_matches_oracle(shape, discretization):
    compare_state(make(*shape), discretization=discretization)


def test_state_is_that_of_the_scan():
    inputs = make(2, 67, 19, 4)
    _, last = selective_scan(**inputs, delta_softplus=True, return_last_state=True)
    alone = {name: inputs[name] for name in STATE}
    assert torch.equal(selective_scan_state(**alone, delta_softplus=True), last)


def test_state_refuses_bad_input():
    inputs = {name: x for name, x in make(1, 4, 5, 3).items() if name in STATE}
    with pytest.raises(ValueError, match="initial_state must have shape"):
        selective_scan_state(**inputs | {"initial_state": torch.zeros(1, 5, 2)})
    with pytest.raises(TypeError, match="B must be a tensor, got NoneType"):
        selective_scan_state(**inputs | {"B": None})


@every_discretization
def test_segments_match_oracle(threads, discretization):
    """Too few channels for the threads: the tokens are cut, and states carried over the cuts."""
    inputs = make(1, 1111, 21, 3)
    layout = Layout(Extent.of(Inputs(**inputs)), None, 64)
    assert layout.segments == {2: 2, 5: 4}[threads]
    compare(inputs, alone=True, discretization=discretization)


def test_segments_are_repeatable(threads):
    inputs = make(1, 700, 9, 2)
    first, again = (selective_scan(**inputs, delta_softplus=True) for _ in range(2))
    assert torch.equal(first, again)


@pytest.mark.parametrize("wild", [3.0, 30.0, 3000.0])
def test_decays_beyond_the_quick_exponential(wild):
    """Some lane groups reach x = δA < -125 log 2, where exp2 must clamp; the rest does not."""
    inputs = make(1, 70, 70, 3)
    inputs["delta"][:, 40:50, 20:30] = wild
    inputs["A"][25] = -40.0
    compare(inputs)
