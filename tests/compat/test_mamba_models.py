"""The blocks and norms of mamba-ssm against float64, and their weights."""

import inspect
from functools import partial

import pytest
import torch
from helpers import assert_rel_rms
from helpers.mamba import layer_in_float64
from helpers.scan import assert_gradients, leaves
from torch import nn

from gamba_warp.compat.mamba_ssm.models.mixer_seq_simple import _init_weights, create_block
from gamba_warp.compat.mamba_ssm.modules import block as of_2
from gamba_warp.compat.mamba_ssm.modules.mamba_simple import Block, Mamba
from gamba_warp.compat.mamba_ssm.ops.triton import layer_norm as norms
from gamba_warp.compat.mamba_ssm.ops.triton import layernorm as norms_of_1
from gamba_warp.compat.mamba_ssm.ops.triton.layer_norm import RMSNorm

WIDTH = 12


class Stack(nn.Module):
    """Two blocks and a last norm, as mamba-ssm's ``MixerModel`` stacks them."""

    def __init__(self, rms, fused, residual_in_fp32):
        super().__init__()
        options = {"ssm_cfg": {"d_state": 5}, "rms_norm": rms, "fused_add_norm": fused}
        options |= {"residual_in_fp32": residual_in_fp32}
        self.layers = nn.ModuleList(create_block(WIDTH, layer_idx=i, **options) for i in range(2))
        self.norm_f = (RMSNorm if rms else nn.LayerNorm)(WIDTH, eps=1e-5)
        self.fused_add_norm, self.residual_in_fp32 = fused, residual_in_fp32

    def forward(self, x):
        residual = None
        for layer in self.layers:
            x, residual = layer(x, residual)
        return of_2.add_norm(self, self.norm_f, x, residual)[0]


def stack_in_float64(weights, x, rms):
    """Output of ``Stack`` by the names of its weights."""

    def norm(x, name):
        x = x if rms else x - x.mean(-1, keepdim=True)
        unit = x / (x.square().mean(-1, keepdim=True) + 1e-5).sqrt()
        return unit * weights[f"{name}.weight"] + (0 if rms else weights[f"{name}.bias"])

    total = x.double()
    for i in range(2):
        name = f"layers.{i}."
        layer = {k.removeprefix(f"{name}mixer."): v for k, v in weights.items() if name in k}
        total = total + layer_in_float64(layer, norm(total, f"{name}norm"))
    return norm(total, "norm_f")


@pytest.mark.parametrize("rms", [False, True])
@pytest.mark.parametrize("fused", [False, True])
def test_blocks_equal_float64(rms, fused):
    model = Stack(rms, fused, residual_in_fp32=not rms)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter += 0.05 * torch.randn_like(parameter)
    x, mine = torch.randn(2, 7, WIDTH), dict(model.named_parameters())
    wide = leaves(mine, torch.float64)
    out, want = model(x), stack_in_float64(wide, x, rms)
    assert_rel_rms(out, want, 2e-6, "out")  # two layers in float32
    assert_gradients((mine, [out]), (wide, [want]), 1e-5)


def test_the_weights_have_the_public_names():
    names = {*Stack(False, False, False).state_dict()}
    layers = {f"layers.{i}.mixer.{k}" for i in range(2) for k in Mamba(WIDTH).state_dict()}
    norms = ("layers.0.norm", "layers.1.norm", "norm_f")
    assert names == layers | {f"{n}.{p}" for n in norms for p in ("weight", "bias")}
    assert [layer.layer_idx for layer in Stack(True, True, True).layers] == [0, 1]


def test_the_weights_at_the_start():
    """Small embeddings, and residual branches over the root of their number."""
    embedding, layer = nn.Embedding(500, 64), create_block(64)
    for module in (embedding, layer):
        module.apply(partial(_init_weights, n_layer=4, initializer_range=1))
    assert abs(embedding.weight.std() - 1) < 0.02
    bound = layer.mixer.d_inner**-0.5 / 2  # kaiming's uniform bound over the root of 4
    assert 0.98 * bound < layer.mixer.out_proj.weight.abs().max() <= bound
    assert (layer.mixer.dt_proj.bias != 0).all(), "kept, as it is marked"
    plain = nn.Linear(3, 3)
    before = plain.weight.clone()
    _init_weights(plain, n_layer=2)
    assert (plain.bias == 0).all() and torch.equal(plain.weight, before)


@pytest.mark.parametrize("kind", [Block, of_2.Block])
def test_blocks_of_both_versions(kind):
    """The residual of one is the input of the next; only the second knows an MLP."""
    assert ("mlp_cls" in inspect.signature(kind).parameters) == (kind is of_2.Block)
    layer = kind(8, partial(Mamba, layer_idx=0), norm_cls=partial(RMSNorm, eps=1e-3))
    x, residual = torch.randn(2, 2, 5, 8)
    out, total = layer(x, residual)
    assert torch.equal(total, x + residual)
    assert torch.equal(out, layer.mixer(layer.norm(total))) and layer.norm.eps == 1e-3
    assert torch.equal(layer(x)[1], x)
    assert [s.shape[1] for s in layer.allocate_inference_cache(2, 9)] == [16, 16]
    assert {name.partition(".")[0] for name in layer.state_dict()} == {"norm", "mixer"}
    half = kind(8, Mamba, residual_in_fp32=True).bfloat16()
    out, total = half(x.bfloat16())
    assert out.dtype == torch.bfloat16 and total.dtype == torch.float32


def test_a_block_with_an_mlp():
    layer = of_2.Block(8, Mamba, partial(nn.Linear, 8), fused_add_norm=True)
    x, residual = torch.randn(2, 2, 5, 8)
    out, total = layer(x, residual)
    mixed = layer.mixer(layer.norm(x + residual))
    assert torch.allclose(total, x + residual + mixed)
    assert torch.allclose(out, layer.mlp(layer.norm2(total)), atol=1e-6)


SHAPE, CHANNELS = (2, 5, 11), 11
# Half a unit in the last place of the output: 2^-12 of float16, 2^-9 of bfloat16.
LIMITS = {torch.float32: 1e-6, torch.float16: 5e-4, torch.bfloat16: 4e-3}


def written_out(rms, eps, x, weight, bias=None, residual=0, x1=0, weight1=None, bias1=None, rows=1):
    """All outputs in float64, the sum last."""
    total = x * rows + x1 + residual
    centred = total if rms else total - total.mean(-1, keepdim=True)
    unit = centred / (centred.square().mean(-1, keepdim=True) + eps).sqrt()
    outs = [unit * weight + (0 if bias is None else bias)]
    if weight1 is not None:
        outs.append(unit * weight1 + (0 if bias1 is None else bias1))
    return [*outs, total]


GIVEN = [
    ("weight",),
    ("weight", "bias", "residual"),
    ("weight", "bias", "residual", "x1", "weight1", "bias1"),
    ("weight", "weight1", "x1"),
    ("weight", "residual", "rowscale"),
]


def inputs(names, dtype):
    shapes = {"x": SHAPE, "residual": SHAPE, "x1": SHAPE, "rowscale": SHAPE[:-1]}
    made = {name: torch.randn(shapes.get(name, (CHANNELS,))) for name in ("x", *names)}
    return {k: v.to(dtype if k in ("x", "x1") else torch.float32) for k, v in made.items()}


@pytest.mark.parametrize("dtype", LIMITS, ids=str)
@pytest.mark.parametrize("names", GIVEN, ids="-".join)
@pytest.mark.parametrize("function", ["layer_norm_fn", "rms_norm_fn", "rms_norm_ref"])
def test_the_norms_are_those_of_float64(function, names, dtype):
    tensors = inputs(names, dtype)
    mine, wide = leaves(tensors), leaves(tensors, torch.float64)
    found = getattr(norms, function)(**{"bias": None, **mine}, eps=1e-3, prenorm=True)
    named = {k: v for k, v in wide.items() if k != "rowscale"}
    if "rowscale" in wide:
        named["rows"] = wide["rowscale"][..., None]
    wanted = written_out(function != "layer_norm_fn", 1e-3, **named)
    assert len(found) == len(wanted)
    kept = dtype if "residual" not in names else torch.float32
    assert [y.dtype for y in found] == [dtype] * (len(found) - 1) + [kept]
    for place, (got, want) in enumerate(zip(found, wanted)):
        assert_rel_rms(got, want, LIMITS[dtype], f"output {place}")
    limit = 2 * LIMITS[dtype]  # sums of rounded products
    assert_gradients((mine, found), (wide, wanted), limit, limit)
    alone = getattr(norms, function)(**{"bias": None, **tensors}, eps=1e-3)
    firsts = alone if isinstance(alone, tuple) else (alone,)
    assert len(firsts) == len(found) - 1 and all(map(torch.equal, firsts, found))


@pytest.mark.parametrize("residual", [None, torch.float32, torch.bfloat16], ids=str)
@pytest.mark.parametrize("in_fp32", [False, True])
def test_the_dtype_of_the_sum(residual, in_fp32):
    x, weight = torch.randn(SHAPE).bfloat16(), torch.rand(CHANNELS)
    given = None if residual is None else torch.randn(SHAPE).to(residual)
    layer = norms.RMSNorm(CHANNELS)
    for out, total in (
        norms.rms_norm_fn(x, weight, None, given, prenorm=True, residual_in_fp32=in_fp32),
        layer(x, given, prenorm=True, residual_in_fp32=in_fp32),
    ):
        default = torch.float32 if in_fp32 else torch.bfloat16
        assert out.dtype == torch.bfloat16 and total.dtype == (residual or default)
    total = norms.rms_norm_ref(x, weight, None, given, prenorm=True, upcast=True)[1]
    assert total.dtype == (residual or torch.float32)


def test_dropout_is_that_of_its_masks():
    x, x1, residual = torch.randn(3, 64, 32, 17)
    weight, weight1 = torch.rand(2, 17)
    given = {"residual": residual, "x1": x1, "weight1": weight1, "dropout_p": 0.25}
    given |= {"prenorm": True, "return_dropout_mask": True}
    *outs, total, mask, mask1 = norms.layer_norm_fn(x, weight, None, **given)
    for kept in (mask, mask1):
        assert kept.dtype == torch.bool and abs(kept.float().mean() - 0.75) < 0.02
    assert not torch.equal(mask, mask1)
    want = written_out(False, 1e-6, x * mask / 0.75, weight, None, residual, x1 * mask1 / 0.75)
    assert_rel_rms(total, want[-1], 1e-6, "sum")
    assert_rel_rms(outs[0], want[0], 1e-6, "out")
    by_place = x, weight, None, residual, x1, weight1, None, 1e-6, 0.25, None, True
    again = norms.layer_norm_ref(*by_place, mask, mask1)
    for got, value in zip(again, (*outs, total), strict=True):
        assert_rel_rms(got, value, 1e-6, "reference")
    layer = norms.RMSNorm(17, dropout_p=0.5)
    assert not torch.equal(layer(x), layer(x)) and torch.equal(layer.eval()(x), layer(x))
    assert len(norms.rms_norm_fn(*by_place, False, True)) == 5
    none = norms.layer_norm_fn(x, weight, None, return_dropout_mask=True)
    assert len(none) == 3 and none[1] is none[2] is None


def test_the_layer_and_the_path_of_mamba_ssm_1():
    assert all(getattr(norms_of_1, name) is getattr(norms, name) for name in norms.__all__)
    layer = norms.RMSNorm(8, eps=1e-2, dtype=torch.float64)
    assert list(layer.state_dict()) == ["weight"] and layer.bias is None and layer.eps == 1e-2
    x = torch.randn(3, 8, dtype=torch.float64)
    assert torch.allclose(layer(x), written_out(True, 1e-2, x, 1)[0], rtol=1e-12)
