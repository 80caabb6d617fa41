"""mamba-ssm's blocks against float64, and their weights."""

import inspect
from functools import partial

import pytest
import torch
from helpers import assert_rel_rms
from helpers.mamba import layer_in_float64
from torch import nn

from gamba_warp.compat.mamba_ssm.models.mixer_seq_simple import _init_weights, create_block
from gamba_warp.compat.mamba_ssm.modules import block as of_2
from gamba_warp.compat.mamba_ssm.modules.mamba_simple import Block, Mamba
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
    x = torch.randn(2, 7, WIDTH)
    wide = {k: v.detach().double().requires_grad_() for k, v in model.named_parameters()}
    want = stack_in_float64(wide, x, rms)
    out = model(x)
    assert_rel_rms(out, want, 2e-6, "out")  # two layers in float32
    cotangent = torch.randn_like(out)
    got = torch.autograd.grad(out, list(model.parameters()), cotangent)
    want = torch.autograd.grad(want, list(wide.values()), cotangent.double())
    for name, a, b in zip(wide, got, want, strict=True):
        assert_rel_rms(a, b, 1e-5, name)


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


@pytest.mark.parametrize(
    "call, error, text",
    [
        (lambda: create_block(8, 16), ValueError, "d_intermediate is supported only as 0, got 16"),
        (
            lambda: create_block(8, attn_layer_idx=[1]),
            ValueError,
            r"attn_layer_idx is supported only as .*got \[1\]",
        ),
        (
            lambda: create_block(8, ssm_cfg={"layer": "Mamba2"}),
            ValueError,
            "ssm_cfg.'layer'. is supported only as 'Mamba1'",
        ),
        (
            lambda: Mamba(8, bimamba_type="v2"),
            ValueError,
            "bimamba_type is 'v2', which is not supp",
        ),
    ],
)
def test_refuses(call, error, text):
    with pytest.raises(error, match=f"^{text}"):
        call()
    assert create_block(8, ssm_cfg={"layer": "Mamba1"}).mixer.d_model == 8
    assert Mamba(8, bimamba_type="none").d_model == 8
