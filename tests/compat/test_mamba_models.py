"""mamba-ssm's blocks and language model against float64, its weights, and its generation."""

import inspect
import json
from functools import partial
from types import SimpleNamespace

import pytest
import torch
from helpers import assert_rel_rms
from helpers.mamba import block_in_float64
from torch import nn

from gamba_warp.compat.mamba_ssm import MambaLMHeadModel
from gamba_warp.compat.mamba_ssm.models.config_mamba import MambaConfig
from gamba_warp.compat.mamba_ssm.models.mixer_seq_simple import (
    MixerModel,
    _init_weights,
    create_block,
)
from gamba_warp.compat.mamba_ssm.modules import block as of_2
from gamba_warp.compat.mamba_ssm.modules.mamba_simple import Block, Mamba
from gamba_warp.compat.mamba_ssm.ops.triton.layer_norm import RMSNorm
from gamba_warp.compat.mamba_ssm.utils.generation import InferenceParams, sample

WIDTH, WORDS = 12, 29


def small(**options):
    sizes = {"d_model": WIDTH, "n_layer": 2, "vocab_size": WORDS, "ssm_cfg": {"d_state": 5}}
    return MambaLMHeadModel(MambaConfig(**sizes | options))


def layer_in_float64(weights, tokens):
    """A Mamba layer by the names of its weights."""
    w = {name.replace(".", "_"): value for name, value in weights.items()}
    given = {k: w[k] for k in ("conv1d_weight", "conv1d_bias", "x_proj_weight", "D")}
    given |= {"xz": (tokens @ w["in_proj_weight"].T).mT, "A": -w["A_log"].exp()}
    given |= {"delta_proj_weight": w["dt_proj_weight"], "delta_bias": w["dt_proj_bias"]}
    return block_in_float64(**given, out_proj_weight=w["out_proj_weight"], out_proj_bias=0)


def model_in_float64(weights, tokens, rms):
    """Logits of the language model by the names of its weights."""

    def norm(x, name):
        x = x if rms else x - x.mean(-1, keepdim=True)
        unit = x / (x.square().mean(-1, keepdim=True) + 1e-5).sqrt()
        return unit * weights[f"{name}.weight"] + (0 if rms else weights[f"{name}.bias"])

    total = weights["backbone.embedding.weight"][tokens]
    for i in range(2):
        name = f"backbone.layers.{i}."
        layer = {k.removeprefix(f"{name}mixer."): v for k, v in weights.items() if name in k}
        total = total + layer_in_float64(layer, norm(total, f"{name}norm"))
    return norm(total, "backbone.norm_f") @ weights["lm_head.weight"].T


@pytest.mark.parametrize("rms", [False, True])
@pytest.mark.parametrize("fused", [False, True])
def test_the_model_is_that_of_float64(rms, fused):
    model = small(rms_norm=rms, fused_add_norm=fused, residual_in_fp32=not rms)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter += 0.05 * torch.randn_like(parameter)
    tokens = torch.randint(WORDS, (2, 7))
    wide = {k: v.detach().double().requires_grad_() for k, v in model.named_parameters()}
    want = model_in_float64(
        wide | {"lm_head.weight": wide["backbone.embedding.weight"]}, tokens, rms
    )
    out = model(tokens).logits
    assert_rel_rms(out, want, 2e-6, "logits")  # two layers in float32
    cotangent = torch.randn_like(out)
    got = torch.autograd.grad(out, list(model.parameters()), cotangent)
    want = torch.autograd.grad(want, list(wide.values()), cotangent.double())
    for name, a, b in zip(wide, got, want, strict=True):
        assert_rel_rms(a, b, 1e-5, name)


def test_the_weights_have_the_public_names():
    shapes = {k: tuple(v.shape) for k, v in small(rms_norm=False, n_layer=1).state_dict().items()}
    layer = {f"backbone.layers.0.mixer.{k}" for k in Mamba(WIDTH, d_state=5).state_dict()}
    norms = {f"backbone.{n}.{p}" for n in ("layers.0.norm", "norm_f") for p in ("weight", "bias")}
    assert {*shapes} == layer | norms | {"backbone.embedding.weight", "lm_head.weight"}
    assert shapes["lm_head.weight"] == (32, WIDTH), "the words padded to a multiple of 8"
    tied, free = small(), small(tie_embeddings=False)
    assert tied.lm_head.weight is tied.backbone.embedding.weight
    assert free.lm_head.weight is not free.backbone.embedding.weight
    assert [layer.layer_idx for layer in tied.backbone.layers] == [0, 1]


def test_the_weights_at_the_start():
    """Small embeddings, and residual branches over the root of their number."""
    model = MixerModel(
        d_model=64, n_layer=4, vocab_size=500, initializer_cfg={"initializer_range": 1}
    )
    assert abs(model.embedding.weight.std() - 1) < 0.02
    for layer in model.layers:
        bound = layer.mixer.d_inner**-0.5 / 2  # kaiming's uniform bound over the root of 4
        weight = layer.mixer.out_proj.weight.abs().max()
        assert 0.98 * bound < weight <= bound
        assert (layer.mixer.dt_proj.bias != 0).all(), "kept, as it is marked"
    plain = nn.Linear(3, 3)
    before = plain.weight.clone()
    _init_weights(plain, n_layer=2)
    assert (plain.bias == 0).all() and torch.equal(plain.weight, before)


@torch.no_grad()
@pytest.mark.parametrize("length", [1, 6])
def test_greedy_tokens_of_the_cache_are_those_of_all_at_once(length):
    model = small(pad_vocab_size_multiple=1, tie_embeddings=False)
    for parameter in model.parameters():
        parameter += 0.1 * torch.randn_like(parameter)
    prompt = torch.randint(WORDS, (3, length))
    done = model.generate(prompt, 20, cg=True, return_dict_in_generate=True, output_scores=True)
    assert done.sequences.shape == (3, 20) and torch.equal(done.sequences[:, :length], prompt)
    logits = model(done.sequences).logits[:, length - 1 : -1]
    assert torch.equal(done.sequences[:, length:], logits.argmax(-1))
    assert_rel_rms(torch.stack(done.scores, 1), logits, 2e-6, "scores")
    assert len(done.sequences.unique()) > 4, "not one word again and again"
    params = InferenceParams(20, 3, key_value_memory_dict=model.allocate_inference_cache(3, 20))
    first = model(prompt, inference_params=params, num_last_tokens=1).logits
    params.seqlen_offset = length
    following = model(done.sequences[:, length : length + 1], inference_params=params).logits
    assert_rel_rms(torch.cat([first, following], 1), logits[:, :2], 2e-6, "with a given cache")


def words(sequence):
    """Decoding by a model whose next word is the one after, and after 3 again 0."""

    class Next:
        def __call__(self, tokens, position_ids, inference_params, num_last_tokens):
            at = inference_params.seqlen_offset
            assert (position_ids is None) == (at == 0) and num_last_tokens == 1
            assert position_ids is None or (position_ids == at).all()
            following = (tokens[:, -1:] + 1) % 4
            return SimpleNamespace(logits=1 + 10 * nn.functional.one_hot(following, 7).float())

    from gamba_warp.compat.mamba_ssm.utils.generation import decode

    return partial(decode, torch.tensor(sequence), Next())


def test_the_options_of_decoding():
    assert words([[0]])(6).sequences.tolist() == [[0, 1, 2, 3, 0, 1]]
    assert words([[0], [1]])(9, eos_token_id=3).sequences.shape == (2, 9), "ends where all do"
    assert words([[0], [0]])(9, eos_token_id=3).sequences.tolist() == 2 * [[0, 1, 2, 3]]
    taught = words([[0, 1]])(6, teacher_outputs=torch.tensor([[9, 9, 5, 6]]))
    assert taught.sequences.tolist() == [[0, 1, 5, 6, 3, 0]]
    assert words([[1]])(4, vocab_size=2).sequences.tolist() == [[1, 0, 1, 0]]
    fresh = words([[0]])(9, repetition_penalty=20.0).sequences.tolist()
    assert fresh == [[0, 1, 2, 3, 4, 5, 6, 3, 0]], "11 / 20 is below 1, until all are used"
    told = []
    streamer = SimpleNamespace(
        put=lambda x: told.extend(x[0].tolist()), end=lambda: told.append(-1)
    )
    words([[0, 1]])(5, streamer=streamer)
    assert told == [0, 1, 2, 3, 0, -1]


def test_sampling_draws_from_what_it_keeps():
    logits = torch.tensor([0.4, 0.1, 0.3, 0.2]).log().expand(20000, -1)
    for options, shares in (
        ({"top_k": 0}, (0.4, 0.1, 0.3, 0.2)),
        ({"top_k": 2}, (4 / 7, 0, 3 / 7, 0)),
        ({"top_k": 0, "top_p": 0.65}, (4 / 7, 0, 3 / 7, 0)),
        ({"top_k": 3, "top_p": 0.7}, (4 / 7, 0, 3 / 7, 0)),
        ({"top_k": 0, "min_p": 0.45}, (4 / 9, 0, 3 / 9, 2 / 9)),
        ({"top_k": 0, "temperature": 0.5}, (16 / 30, 1 / 30, 9 / 30, 4 / 30)),
        ({"top_k": 1}, (1, 0, 0, 0)),
    ):
        counts = sample(logits, **options).bincount(minlength=4) / 20000
        wanted = torch.tensor(shares)
        assert (counts[wanted == 0] == 0).all(), options
        assert (counts - wanted).abs().max() < 0.02, options  # five standard deviations


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


def test_files(tmp_path):
    model = small()
    model.save_pretrained(tmp_path / "lm")
    assert json.loads((tmp_path / "lm" / "config.json").read_text())["d_model"] == WIDTH
    again = MambaLMHeadModel.from_pretrained(str(tmp_path / "lm"), dtype=torch.bfloat16)
    assert again.config == model.config
    for (name, a), b in zip(model.named_parameters(), again.parameters(), strict=True):
        single = name.endswith((".A_log", ".D"))
        assert b.dtype == (torch.float32 if single else torch.bfloat16)
        assert torch.equal(a.bfloat16(), b.bfloat16())


@pytest.mark.parametrize(
    "call, error, text",
    [
        (lambda: create_block(8, 16), ValueError, "d_intermediate is 16, which is not supported"),
        (
            lambda: create_block(8, attn_layer_idx=[1]),
            ValueError,
            r"attn_layer_idx is \[1\], which",
        ),
        (lambda: small(ssm_cfg={"layer": "Mamba2"}), ValueError, "ssm_cfg.'layer'. is 'Mamba2', w"),
        (lambda: MixerModel(8, 2, 50), TypeError, "vocab_size is None, allowed is an integer"),
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
