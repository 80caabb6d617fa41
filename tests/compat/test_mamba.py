"""mamba-ssm's names: the scan, the block and the layer, each against float64."""

import importlib
from itertools import product

import helpers
import pytest
import torch
import torch.nn.functional as F
from helpers import assert_all_rel_rms, assert_default_dtype_changes_nothing, assert_rel_rms, mamba
from helpers.mamba import CONSTANT, GROUPED, STATES, VARYING, run, scan_in_float64, scan_inputs
from helpers.scan import assert_gradients, leaves

from gamba_warp.compat import mamba_ssm
from gamba_warp.compat.mamba_ssm import InferenceParams, Mamba, selective_scan_fn

# Shapes of B and C.
MATRICES = [*product([CONSTANT, VARYING], repeat=2), (GROUPED, GROUPED)]
MATRICES += [(CONSTANT, GROUPED), (GROUPED, CONSTANT)]
# Half an ulp of the output is 2^-12 of float16 and 2^-9 of bfloat16; the interior is float32.
SCAN_LIMITS = {torch.float32: 1e-6, torch.float16: 5e-4, torch.bfloat16: 4e-3}


# Relative to the output's largest value. Float32: rounding of sums in another order. The halves:
# a few roundings of 2^-9 and 2^-12 at other places than in the forward pass.
LIMITS = {torch.float32: 1e-6, torch.bfloat16: 3e-2, torch.float16: 4e-3}
SHAPES = [
    {},
    {"d_state": 5, "d_conv": 3, "expand": 3, "bias": True, "conv_bias": False, "dt_rank": 2},
]


@pytest.mark.parametrize("dtype", SCAN_LIMITS, ids=str)
@pytest.mark.parametrize("matrices", MATRICES, ids=str)
def test_the_grid(matrices, dtype):
    for *kept, softplus in product([False, True], repeat=4):
        without = [k for k, keep in zip(("D", "z", "delta_bias"), kept) if not keep]
        tensors = scan_inputs(*matrices, dtype, without)
        given = f"no {without}, softplus {softplus}"
        got = run(selective_scan_fn, tensors, delta_softplus=softplus, return_last_state=True)
        alone = selective_scan_fn(**tensors, delta_softplus=softplus)
        assert isinstance(alone, torch.Tensor) and torch.equal(alone, got["out"]), given
        want = run(scan_in_float64, tensors, torch.float64, softplus=softplus)
        assert got["out"].dtype == dtype and got["last"].dtype == torch.float32
        for name, value in want.items():
            # A cotangent in the output's dtype, and a sum of rounded products, in each gradient.
            limit = SCAN_LIMITS[dtype] * (1 if name in ("out", "last") else 2)
            assert_rel_rms(got[name], value, limit, f"{name} ({given})")


@pytest.mark.parametrize("matrices", MATRICES, ids=str)
def test_the_reference_of_the_scan(matrices):
    tensors = scan_inputs(*matrices)
    got = run(mamba_ssm.selective_scan_ref, tensors, delta_softplus=True, return_last_state=True)
    want = run(scan_in_float64, tensors, torch.float64, softplus=True)
    assert_all_rel_rms(got, want, 2e-6)  # float32, sums of some hundred terms
    assert isinstance(mamba_ssm.selective_scan_ref(**tensors), torch.Tensor)


@pytest.mark.parametrize("scan", [selective_scan_fn, mamba_ssm.selective_scan_ref])
@pytest.mark.parametrize("name", ["A", "B", "C"])
def test_complex_states_are_refused(scan, name):
    tensors = scan_inputs(CONSTANT, CONSTANT)
    tensors[name] = tensors[name].to(torch.complex64)
    with pytest.raises(TypeError, match=f"^{name} has dtype torch.complex64; complex states are"):
        scan(**tensors)


@pytest.mark.parametrize("taps", [3, 4])
@pytest.mark.parametrize("constant_B", [False, True])
@pytest.mark.parametrize("constant_C", [False, True])
@pytest.mark.parametrize("norms", [False, True])
def test_the_block_is_that_of_float64(constant_B, constant_C, norms, taps):
    given = mamba.block_inputs(constant_B, constant_C, taps)
    if not norms:
        alike = (f(*given.values()) for f in (mamba_ssm.mamba_inner_ref, mamba_ssm.mamba_inner_fn))
        assert torch.equal(*alike), "by their places too"
    sizes = {"dt": mamba.CHANNELS, "b": STATES * (not constant_B), "c": STATES * (not constant_C)}
    given |= {f"{k}_rms_weight": torch.rand(n) for k, n in sizes.items() if norms and n}
    tensors = {name: x for name, x in given.items() if x is not None}
    want = run(mamba.block_in_float64, tensors, torch.float64)
    for level in (0, 1):  # at level 1 mamba-ssm normalises twice (its issue 885)
        got = run(mamba_ssm.mamba_inner_fn, tensors, checkpoint_lvl=level)
        # Float32 through four products: the largest gradients add some hundred terms.
        assert_all_rel_rms(got, want, 5e-6, out=2e-6)


def relative(got, want):
    """The largest difference over the largest value."""
    return ((got - want).double().abs().max() / want.double().abs().max()).item()


def decode(layer, tokens, prefill, params=None):
    """The outputs of a prefill at once and of the other tokens one by one."""
    params = params or InferenceParams(max_seqlen=99, max_batch_size=len(tokens))
    outs = [layer(tokens[:, :prefill], params)] if prefill else []
    for t in range(prefill, tokens.shape[1]):
        params.seqlen_offset = t
        if t == 0:  # a cache that is empty, as generation without a prompt begins
            states = layer._get_states_from_cache(params, len(tokens))
            outs.append(layer.step(tokens[:, :1], *states)[0])
        else:
            outs.append(layer(tokens[:, t : t + 1], inference_params=params))
    return torch.cat(outs, 1)


@pytest.mark.parametrize("dtype", LIMITS, ids=str)
@pytest.mark.parametrize("prefill", [0, 1, 2, 9])
@pytest.mark.parametrize("options", SHAPES, ids=["default", "other"])
@torch.no_grad()
def test_one_by_one_is_at_once(options, prefill, dtype):
    layer = Mamba(20, layer_idx=3, dtype=dtype, **options)
    tokens = torch.randn(2, 17, 20).to(dtype)
    got, want = decode(layer, tokens, prefill), layer(tokens)
    assert got.dtype == dtype and relative(got, want) < LIMITS[dtype]


@torch.no_grad()
def test_several_tokens_go_on_from_a_cache():
    layer, tokens = Mamba(20, layer_idx=0), torch.randn(2, 17, 20)
    params, outs = InferenceParams(99, 2), []
    for piece in tokens.split([5, 2, 1, 9], 1):
        outs.append(layer(piece, params))
        params.seqlen_offset += piece.shape[1]
    assert relative(torch.cat(outs, 1), layer(tokens)) < LIMITS[torch.float32]


@torch.no_grad()
def test_a_cache_begins_anew_at_offset_zero():
    layer, tokens = Mamba(20, layer_idx=0), torch.randn(2, 9, 20)
    params = InferenceParams(99, 2)
    first = decode(layer, tokens, 4, params)
    params.reset(50, 2)
    assert params.seqlen_offset == 0 and params.max_seqlen == 50
    assert torch.equal(decode(layer, tokens, 4, params), first)


@torch.no_grad()
def test_half_weights_keep_a_float32_state_that_decays():
    """Steps of 1e-3: in bfloat16 a state times 0.999 would be rounded to itself."""
    layer = Mamba(8, d_state=1, dtype=torch.bfloat16)
    layer.x_proj.weight.zero_()  # no input reaches the state
    layer.dt_proj.bias.fill_(-6.9)  # softplus gives 1e-3
    states = layer.allocate_inference_cache(1, 0)
    assert [s.dtype for s in states] == [torch.bfloat16, torch.float32]
    assert all(s.dtype == torch.half for s in layer.allocate_inference_cache(1, 0, torch.half))
    states[1].fill_(1)
    for _ in range(500):
        layer.step(torch.zeros(1, 1, 8, dtype=torch.bfloat16), *states)
    step = F.softplus(torch.tensor(-6.9).bfloat16().float())
    assert_rel_rms(states[1], torch.exp(-500 * step).expand(1, 16, 1), 1e-4, "state")


@pytest.mark.parametrize("cached", [False, True])
def test_gradients_are_those_of_plain_torch(cached):
    """Against the steps of a reference in float64."""
    layer = Mamba(6, d_state=3, layer_idx=0)
    with torch.no_grad():
        layer.A_log += 0.1 * torch.randn_like(layer.A_log)
    tokens = torch.randn(2, 9, 6, requires_grad=True)
    out = layer(tokens, InferenceParams(9, 2) if cached else None)
    doubles = leaves(dict(layer.named_parameters()), torch.float64)
    wide = tokens.detach().double().requires_grad_()
    want = mamba.layer_in_float64(doubles, wide)
    assert_rel_rms(out, want, 1e-6, "out")
    mine, theirs = {"tokens": tokens, **dict(layer.named_parameters())}, {"tokens": wide, **doubles}
    assert_gradients((mine, [out]), (theirs, [want]), 5e-6)  # float32, sums over 18 tokens


def test_the_state_dict_is_that_of_mamba_ssm():
    shapes = {name: tuple(x.shape) for name, x in Mamba(32, bias=True).state_dict().items()}
    assert shapes == {
        "A_log": (64, 16),
        "D": (64,),
        "in_proj.weight": (128, 32),
        "in_proj.bias": (128,),
        "conv1d.weight": (64, 1, 4),
        "conv1d.bias": (64,),
        "x_proj.weight": (34, 64),
        "dt_proj.weight": (64, 2),
        "dt_proj.bias": (64,),
        "out_proj.weight": (32, 64),
        "out_proj.bias": (32,),
    }
    layer = Mamba(32, dtype=torch.bfloat16)
    single = {name for name, p in layer.named_parameters() if p.dtype == torch.float32}
    assert single == {"A_log", "D"}
    assert layer.A_log._no_weight_decay and layer.D._no_weight_decay
    assert layer.dt_proj.bias._no_reinit


def test_the_weights_at_the_start():
    layer = Mamba(64, d_state=3, dt_min=0.01, dt_max=0.02, dt_init="constant", dt_scale=2.0)
    step = F.softplus(layer.dt_proj.bias)
    assert 0.01 - 1e-6 < step.min() < 0.0105 and 0.0195 < step.max() < 0.02 + 1e-6
    assert (layer.dt_proj.weight == 2 * 4**-0.5).all() and (layer.D == 1).all()
    assert torch.equal(layer.A_log, torch.tensor([1.0, 2.0, 3.0]).log().expand(128, 3))
    floor = Mamba(64, dt_min=1e-6, dt_max=1e-5, dt_init_floor=1e-4)
    assert torch.allclose(F.softplus(floor.dt_proj.bias), torch.tensor(1e-4), rtol=1e-4)


def test_no_gradient_flows_through_a_step():
    layer = Mamba(8)
    states = layer.allocate_inference_cache(1, 0)
    assert not layer.step(torch.randn(1, 1, 8), *states)[0].requires_grad
    assert not any(state.requires_grad for state in states)


def test_autocast():
    layer, tokens = Mamba(20, layer_idx=0), torch.randn(2, 9, 20)
    with torch.no_grad(), torch.autocast("cpu", dtype=torch.bfloat16):
        got, want = decode(layer, tokens, 4), layer(tokens)
        assert got.dtype == torch.bfloat16 and relative(got, want) < LIMITS[torch.bfloat16]


def test_refuses_tokens():
    layer, tokens = Mamba(8), torch.randn(2, 3, 8)
    with pytest.raises(TypeError, match="^hidden_states must have dtype.*got torch.float64"):
        layer(tokens.double())
    with pytest.raises(ValueError, match=r"^hidden_states must .* \[B, L, 8.*, got \[2, 3, 7\]"):
        layer(tokens[..., :7])
    with pytest.raises(ValueError, match="^hidden_states must have shape .B, 1, 8."):
        layer.step(tokens, *layer.allocate_inference_cache(2, 0))
    with pytest.raises(ValueError, match="^layer_idx is None"):
        layer(tokens, InferenceParams(9, 2))
    layer.layer_idx, params = 4, InferenceParams(9, 2)
    layer(tokens, params)
    with pytest.raises(ValueError, match="^hidden_states has batch size 1, the cache of layer"):
        layer(tokens[:1], params)


@pytest.mark.parametrize(
    "path, names",
    [
        ("mamba_ssm.ops.selective_scan_interface", "selective_scan_fn mamba_inner_fn"),
        ("mamba_ssm.ops.triton.selective_state_update", "selective_state_update"),
        ("mamba_ssm.modules.mamba_simple", "Mamba"),
        ("mamba_ssm.utils.generation", "InferenceParams"),
        ("causal_conv1d", "causal_conv1d_fn causal_conv1d_update"),
        ("causal_conv1d.causal_conv1d_interface", "causal_conv1d_fn"),
    ],
)
def test_paths_of_the_original(path, names):
    module = importlib.import_module(f"gamba_warp.compat.{path}")
    for name in names.split():
        assert getattr(module, name) is getattr(mamba_ssm, name)
    assert list(mamba_ssm.__all__) == sorted(mamba_ssm.__all__)


def test_layers_of_one_kind_have_one_result(capsys):
    """docs/examples/layer_speed.py, small: mambapy's layer and the formula against ours."""
    pytest.importorskip("mambapy")
    from examples import layer_speed

    layer_speed.compare(width=16, length=9, turns=1)
    for line in capsys.readouterr().out.splitlines()[1:]:
        errors = [float(word) for word in line.partition("to the loop ")[2].split(" and ")]
        assert len(errors) == 2 and max(errors) < 2e-6, line


def test_float32_layers_where_the_default_is_float64():
    """The same bits; float64 layers give an error that lists the allowed dtypes."""

    def run():
        torch.manual_seed(0)
        layer = Mamba(16, dtype=torch.float32, layer_idx=0)
        tokens = torch.randn(2, 7, 16, dtype=torch.float32)
        out = layer(tokens)
        cache = layer.allocate_inference_cache(2, 0)
        gradients = torch.autograd.grad(out.sum(), list(layer.parameters()))
        return [out, *layer.step(tokens[:, :1], *cache), *layer.parameters(), *gradients]

    assert_default_dtype_changes_nothing(run)
    with pytest.raises(TypeError, match="hidden_states must have dtype.*got torch.float64"):
        helpers.in_default_float64(lambda: Mamba(16)(torch.randn(2, 7, 16)))
