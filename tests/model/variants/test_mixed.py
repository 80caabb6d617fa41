"""Image tokens among the 3DGS tokens, and mixed tokens (paper, answer A4), against plain forms."""

import pytest
import torch
from helpers import assert_rel_rms
from helpers.model import (
    BOXES,
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

from gamba_warp.cameras import plucker_rays
from gamba_warp.model.config import GambaConfig
from gamba_warp.model.gamba import Gamba
from gamba_warp.model.parts.block import run_blocks
from gamba_warp.model.parts.mixed import mixed_positions
from gamba_warp.model.parts.prefix import prefix_states
from gamba_warp.model.parts.tokens import SplatTokens, normalize_imagenet, scan_orders


def blocks_of(camera: int, image: int, **changes) -> torch.nn.ModuleList:
    return moved_blocks(micro(image_tokens="mixed", depth=3, **changes), camera, image)


def plain(blocks, tokens, camera, image):
    """Plain form: image by image, with each token inserted into a list."""
    for block in blocks:
        pairs = ((block.project_camera, camera), (block.project_image, image))
        extra = torch.cat([project(x) for project, x in pairs if x is not None], 1)
        outputs = []
        for own, others in zip(tokens, extra):
            length, count = len(own), len(others)
            sequence, kept, k = [], [], 0
            for i in range(length):
                while k < count and (k + 1) * length // (count + 1) == i:
                    sequence.append(others[k])
                    k += 1
                kept.append(len(sequence))
                sequence.append(own[i])
            assert k == count  # none stands behind the last 3DGS token
            hidden, _ = block.mamba(block.norm(torch.stack(sequence))[None])
            outputs.append(own + hidden[0, kept])
        tokens = torch.stack(outputs)
    return tokens


@pytest.mark.parametrize(
    "camera, count, length", [(0, 1, 10), (7, 4, 37), (7, 0, 3), (0, 23, 9), (7, 64, 65)]
)
def test_equals_the_plain_form(camera, count, length):
    blocks = blocks_of(camera, 11 if count else 0, norm="rms" if camera else "layer")
    # Float32 sums in another order, through three blocks.
    assert_plain_form(plain, blocks, length, camera, (count, 11 if count else 0), 1e-6)


def test_places_known_answer():
    # Of 10 own tokens and 2 others, these stand before tokens 3 and 6; then 12 tokens, then none.
    got = mixed_positions(2, torch.tensor([0, 10, 22, 22])).tolist()
    assert got[:6] == [3, 7, 12 + 4, 12 + 9, 26, 27]
    assert got[6:16] == [0, 1, 2, 4, 5, 6, 8, 9, 10, 11] and sorted(got) == [*range(28)]
    assert got[16:] == [12 + t for t in (0, 1, 2, 3, 5, 6, 7, 8, 10, 11, 12, 13)]
    assert sorted(mixed_positions(5, torch.tensor([0, 3, 4])).tolist()) == [*range(14)]


def test_a_token_is_seen_by_those_behind_it_alone(monkeypatch):
    monkeypatch.setattr("gamba_warp.model.parts.block.SEGMENT", 2)  # must not cut the sequence
    blocks, tokens, image = blocks_of(0, 11), torch.randn(1, 9, 16), torch.randn(1, 2, 11)
    with torch.no_grad():
        base = run_blocks(blocks, tokens, prefix_states(blocks, None, image))
        image[0, 1] += 1
        moved = run_blocks(blocks, tokens, prefix_states(blocks, None, image)) - base
    assert (moved[0, :6] == 0).all() and (moved[0, 6:].abs().amax(-1) > 1e-5).all()


def test_a_batch_on_rays_is_each_image_alone():
    changes = {"decoder": "rays", "ray_cells": 2, "ray_layers": 3, "ray_features": 5}
    model = Gamba(micro(image_tokens="mixed", **changes), "random")
    torch.nn.init.normal_(model.decoder.head.weight, std=0.5)
    assert_each_alone(model, *cut_outs([*BOXES, NOTHING]), (9, 1, 24, 0))


def test_condition_recomputation_and_autocast():
    model = Gamba(micro(image_tokens="mixed"), "random")
    images, cameras = inputs(2)
    assert_recomputed_alike(model, images, cameras)
    with torch.no_grad():
        want = model(images, cameras).means
        condition = model.condition(images, cameras)
        assert torch.equal(model(images, cameras, condition).means, want)
        with torch.autocast("cpu", torch.bfloat16):
            rounded = model(images, cameras, condition).means
    assert_rel_rms(rounded, want, 0.1, "bfloat16")  # 8 bits, through two blocks


def test_refused():
    refused("image_tokens mixed needs prepend", micro, image_tokens="mixed", prepend=False)


CONFIG = {"image_size": 24, "encoder": "none", "mixed_tokens": True}  # a grid of 6, coarser: 3


@pytest.mark.parametrize("orders", ["backward", "mirrored"])
def test_the_first_quarter_are_patches_of_twice_the_side(orders):
    module = SplatTokens(micro(scan_orders=orders, **CONFIG))
    images, cameras = inputs(2, 24)
    got = module(images, cameras)
    assert got.shape == (2, 144, 16) and module.patchify.weight.shape == (16, 9, 8, 8)
    rays = plucker_rays(cameras.viewmats, cameras.Ks, 24, 24)
    pixels = torch.cat([normalize_imagenet(images), rays], -1)
    weight, bias = module.patchify.weight, module.patchify.bias
    for token, place in enumerate(scan_orders(3, 3, orders).flatten().tolist()):
        row, column = 8 * (place // 3), 8 * (place % 3)
        patch = pixels[:, row : row + 8, column : column + 8]
        want = torch.einsum("bhwc,ochw->bo", patch, weight) + bias + module.embedding[token]
        # Sums of 576 float32 products in another order.
        assert torch.allclose(got[:, token], want, atol=2e-5), token
    assert torch.equal(got[:, 36:], module.embedding[36:].expand(2, -1, -1))


def test_dropping_background_keeps_what_has_no_patch():
    model = Gamba(micro(**CONFIG))
    images, cameras = torch.ones(1, 24, 24, 3), inputs(1, 24)[1]
    images[0, 9, 20] = 0  # in the coarse patch of row 1, column 2
    kept = model.tokens.foreground(images, 1.0, 0)
    want = [i for i, place in enumerate(model.tokens.orders.tolist()) if place == 5]
    assert kept.tolist() == want + [*range(36, 144)]
    assert model(images, cameras, background_margin=0).num == 4 + 108


def test_paper_sizes():
    config = GambaConfig(encoder="none", dt_rank=32, mixed_tokens=True)
    with torch.device("meta"):
        tokens = SplatTokens(config)
    assert (config.num_gaussians, len(tokens.orders), tokens.patch_size) == (16384, 4096, 16)


@pytest.mark.parametrize(
    "changes, words",
    [
        ({"image_size": 12}, "mixed_tokens needs an even grid, not 3²"),
        ({"decoder": "rays"}, "mixed_tokens needs additive_image_tokens, and no decoder rays"),
        ({"additive_image_tokens": False}, "mixed_tokens needs additive_image_tokens"),
    ],
)
def test_mixed_tokens_are_refused(changes, words):
    refused(words, micro, **CONFIG | changes)
