"""Attention in place of Mamba, against a plain float64 form that prepends and drops."""

import pytest
import torch
from helpers import assert_rel_rms
from helpers.model import (
    BOXES,
    FIELDS,
    NOTHING,
    assert_each_alone,
    assert_plain_form,
    assert_recomputed_alike,
    cut_outs,
    inputs,
    micro,
    moved_blocks,
)
from helpers.refusals import refused

from gamba_warp.kernels.runtime.packed import Packed
from gamba_warp.model.config import GambaConfig
from gamba_warp.model.gamba import Gamba
from gamba_warp.model.parts.block import run_blocks
from gamba_warp.model.parts.prefix import prefix_states


def make_blocks(depth: int, camera: int, image: int, **changes) -> torch.nn.ModuleList:
    small = {"width": 24, "mixer": "attention", "attention_heads": 3, "encoder": "none"}
    return moved_blocks(GambaConfig(**(small | {"depth": depth} | changes)), camera, image)


def _norm(module: torch.nn.Module, x: torch.Tensor) -> torch.Tensor:
    if isinstance(module, torch.nn.LayerNorm):
        x = x - x.mean(-1, keepdim=True)
    x = x / (x.square().mean(-1, keepdim=True) + 1e-5).sqrt() * module.weight.double()
    return x + module.bias.double() if isinstance(module, torch.nn.LayerNorm) else x


def _linear(layer: torch.nn.Linear, x: torch.Tensor) -> torch.Tensor:
    return x @ layer.weight.double().T + layer.bias.double()


def _plain_block(block, tokens, prefix):
    """Plain form of a transformer block, head by head and image by image."""
    found = []
    for sequence, before in zip(tokens, prefix):
        whole = _norm(block.norm, torch.cat([before, sequence]))
        keys, values, queries = _linear(block.kvq_proj, whole).chunk(3, -1)
        size = whole.shape[-1] // block.heads
        heads = []
        for h in range(block.heads):
            k, v, q = (part[:, h * size : (h + 1) * size] for part in (keys, values, queries))
            weights = (q @ k.T / size**0.5).exp()
            heads.append(weights / weights.sum(-1, keepdim=True) @ v)
        mixed = _linear(block.out_proj, torch.cat(heads, -1))[len(before) :]
        sequence = sequence + mixed
        inner = _linear(block.mlp[0], _norm(block.mlp_norm, sequence))
        inner = inner * 0.5 * (1 + torch.erf(inner / 2**0.5))
        found.append(sequence + _linear(block.mlp[2], inner))
    return torch.stack(found)


def prepend_and_drop(blocks, tokens, camera, image):
    tokens = tokens.double()
    for block in blocks:
        prefix = tokens[:, :0]
        for project, condition in ((block.project_camera, camera), (block.project_image, image)):
            if condition is not None:
                prefix = torch.cat([prefix, _linear(project, condition.double())], 1)
        tokens = _plain_block(block, tokens, prefix)
    return tokens


@pytest.mark.parametrize(
    "camera, image, changes",
    [
        (7, 11, {}),
        (0, 11, {"norm": "rms", "attention_mlp": 1}),
        (7, 0, {"attention_heads": 0}),
        (0, 0, {"attention_heads": 24}),
    ],
)
def test_equals_the_plain_form(camera, image, changes):
    blocks = make_blocks(3, camera, image, **changes)
    # Float32 against float64, through three blocks.
    assert_plain_form(prepend_and_drop, blocks, 37, camera, (5, image), 2e-6)


def test_every_token_sees_every_other_and_is_not_cut_into_segments(monkeypatch):
    blocks, tokens = make_blocks(1, 0, 0), torch.randn(1, 9, 24)
    monkeypatch.setattr("gamba_warp.model.parts.block.SEGMENT", 2)
    with torch.no_grad():
        base = run_blocks(blocks, tokens, [None])
        tokens[:, 8, :5] += 1  # the norm would remove it from all channels
        moved = (run_blocks(blocks, tokens, [None]) - base).abs().amax(-1)
    assert (moved > 1e-5).all()


def test_images_of_a_row_do_not_see_each_other():
    blocks, tokens = make_blocks(2, 7, 0), torch.randn(1, 14, 24)
    cuts = torch.tensor([0, 5, 14, 14])
    states = prefix_states(blocks, torch.randn(3, 1, 7), None)
    got = run_blocks(blocks, tokens, states, packed=Packed.of(cuts))
    for image, (i, j) in enumerate(zip(cuts, cuts[1:])):
        own = slice(image, image + 1)
        given = [state._make(x[own] for x in state) for state in states]
        torch.testing.assert_close(got[:, i:j], run_blocks(blocks, tokens[:, i:j], given))
    nothing = run_blocks(make_blocks(2, 0, 0), tokens, [None, None], packed=Packed.of(cuts))
    assert nothing.isfinite().all()


@pytest.mark.parametrize("gradients", [True, False])
def test_a_batch_on_rays_is_each_image_alone(gradients):
    changes = {"decoder": "rays", "ray_cells": 2, "ray_layers": 3, "ray_features": 5}
    model = Gamba(micro(mixer="attention", attention_heads=2, encoder="none", **changes))
    torch.nn.init.normal_(model.decoder.head.weight, std=0.5)
    rgba, cameras = cut_outs([*BOXES, NOTHING])
    with torch.set_grad_enabled(gradients):
        together = assert_each_alone(model, rgba, cameras, (9, 1, 24, 0))
        if gradients:
            sum(getattr(together, name).sum() for name in FIELDS).backward()
            assert all(p.grad.isfinite().all() for p in model.parameters())


def test_recomputation_and_segments_change_nothing():
    model = Gamba(micro(mixer="attention", attention_heads=4), "random")
    images, cameras = inputs(2)
    assert_recomputed_alike(model, images, cameras)
    kept = model(images, cameras, background_margin=0)  # noise: every patch is the object's
    with torch.no_grad():
        condition = model.condition(images, cameras)
        assert torch.equal(model(images, cameras, condition).means, kept.means)


def test_bfloat16_autocast_stays_near_float32():
    blocks = make_blocks(1, 7, 11)
    tokens, condition = torch.randn(2, 19, 24), (torch.randn(2, 1, 7), torch.randn(2, 4, 11))
    states = prefix_states(blocks, *condition)
    want = run_blocks(blocks, tokens, states)
    with torch.autocast("cpu", torch.bfloat16):
        for given in (states, prefix_states(blocks, *condition)):
            got = run_blocks(blocks, tokens, given)
            assert got.dtype == torch.float32  # the residual stream is not rounded
            # bfloat16 keeps 8 bits; each branch passes through five roundings of 0.2 to 0.4 %.
            assert_rel_rms(got - tokens, want - tokens, 2e-2, "branch")


def test_sizes():
    with torch.device("meta"):
        plain = Gamba(GambaConfig(encoder="none", dt_rank=32))
        wide = Gamba(GambaConfig(encoder="none", mixer="attention", attention_mlp=1))
    counts = [sum(p.numel() for p in m.blocks.parameters()) for m in (plain, wide)]
    assert 0.93 < counts[1] / counts[0] < 1.0
    assert wide.blocks[0].heads == 8 and GambaConfig(width=48).num_heads == 1


def test_refused():
    said = "width 16 is not a multiple of num_heads 3"
    refused(said, micro, mixer="attention", attention_heads=3)
    assert micro(attention_heads=3).mixer == "mamba"
    wide = {"mixer": "attention", "width": 4096, "attention_mlp": 16, "depth": 1}
    refused("mlp_width is 65,536, over 32,768", GambaConfig, **wide)
