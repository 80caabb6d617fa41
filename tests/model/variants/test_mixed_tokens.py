"""Mixed tokens (paper, answer A4): the tokens that see a patch, and their patches."""

import pytest
import torch
from helpers.model import inputs, micro
from helpers.refusals import refused

from gamba_warp.cameras import plucker_rays
from gamba_warp.model.config import GambaConfig
from gamba_warp.model.gamba import Gamba
from gamba_warp.model.parts.tokens import SplatTokens, normalize_imagenet, scan_orders

CONFIG = {"image_size": 24, "encoder": "none", "mixed_tokens": True}  # a grid of 6, coarser: 3


@pytest.mark.parametrize("orders", ["backward", "mirrored"])
def test_the_first_quarter_are_patches_of_twice_the_side(orders):
    module = SplatTokens(micro(scan_orders=orders, **CONFIG))
    images, cameras = inputs(2, 24)
    got = module(images, cameras)
    assert got.shape == (2, 144, 16) and module.patchify.weight.shape == (16, 9, 8, 8)
    pixels = torch.cat([normalize_imagenet(images), plucker_rays(*_seen(cameras))], -1)
    weight, bias = module.patchify.weight, module.patchify.bias
    for token, place in enumerate(scan_orders(3, 3, orders).flatten().tolist()):
        row, column = 8 * (place // 3), 8 * (place % 3)
        patch = pixels[:, row : row + 8, column : column + 8]
        want = torch.einsum("bhwc,ochw->bo", patch, weight) + bias + module.embedding[token]
        # Sums of 576 float32 products in another order.
        assert torch.allclose(got[:, token], want, atol=2e-5), token
    assert torch.equal(got[:, 36:], module.embedding[36:].expand(2, -1, -1))


def _seen(cameras):
    return cameras.viewmats, cameras.Ks, 24, 24


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
def test_refused(changes, words):
    refused(words, micro, **CONFIG | changes)
