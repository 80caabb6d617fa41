"""Camera numbers, scan orders, 3DGS tokens and the decoder against hand-made answers."""

import math

import torch
from helpers.model import inputs, micro

from gamba_warp.cameras import Cameras, plucker_rays
from gamba_warp.model.config import GambaConfig
from gamba_warp.model.parts.decoder import GaussianDecoder
from gamba_warp.model.parts.tokens import (
    SplatTokens,
    camera_numbers,
    normalize_imagenet,
    scan_orders,
)


def test_scan_orders_known_answer():
    # The map  0 1 2
    #          3 4 5
    assert scan_orders(2, 3).tolist() == [
        [0, 1, 2, 3, 4, 5],
        [0, 3, 1, 4, 2, 5],
        [5, 4, 3, 2, 1, 0],
        [5, 2, 4, 1, 3, 0],
    ]


def test_scan_orders_are_permutations_with_inverses():
    orders = scan_orders(5, 7)
    values = torch.randn(35)
    for order in orders:
        assert torch.equal(order.sort().values, torch.arange(35))
        assert torch.equal(values[order][order.argsort()], values)
    assert len({tuple(order.tolist()) for order in orders}) == 4


def test_camera_numbers_known_answer_and_size_independent():
    viewmat = torch.arange(16.0).reshape(1, 4, 4)
    K = torch.tensor([[[20.0, 0, 4], [0, 30, 6], [0, 0, 1]]])
    cameras = Cameras(viewmat, K, width=10, height=12)
    want = torch.tensor([[*range(12), 2.0, 2.5, 0.4, 0.5]])
    assert torch.equal(camera_numbers(cameras), want)
    # Rescaling multiplies and divides in float32.
    assert torch.allclose(camera_numbers(cameras.resized(30, 6)), want, rtol=1e-6)


def test_splat_tokens_equal_patch_by_patch_sum():
    module = SplatTokens(micro())
    images, cameras = inputs(3)
    got = module(images, cameras)
    rays = plucker_rays(cameras.viewmats, cameras.Ks, 12, 12)
    pixels = torch.cat([normalize_imagenet(images), rays], -1)
    weight, bias = module.patchify.weight, module.patchify.bias
    order = scan_orders(3, 3).flatten()
    for position in (0, 4, 10, 20, 35):
        row, column = divmod(int(order[position]), 3)
        patch = pixels[:, 4 * row : 4 * row + 4, 4 * column : 4 * column + 4]
        want = torch.einsum("bhwc,ochw->bo", patch, weight) + bias + module.embedding[position]
        # Sums of 144 float32 products in another order.
        assert torch.allclose(got[:, position], want, atol=1e-5), position


def test_rays_stay_exact_under_autocast():
    module = SplatTokens(micro())
    torch.nn.init.zeros_(module.embedding)
    images, cameras = inputs(1)
    seen = []
    module.patchify.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0]))
    with torch.autocast("cpu", torch.bfloat16):
        module(images, cameras)
    module(images, cameras)
    assert seen[0].dtype == torch.float32
    assert torch.equal(seen[0], seen[1])


def test_without_image_tokens_only_the_embedding_is_left():
    module = SplatTokens(micro(additive_image_tokens=False))
    tokens = module(*inputs(2))
    assert torch.equal(tokens, module.embedding.expand(2, 36, 16))
    assert [name for name, _ in module.named_parameters()] == ["embedding"]


def test_tokens_differ_on_a_plain_background():
    # Otherwise the decoder would put the Gaussians of all background patches at one point.
    tokens = SplatTokens(micro(width=64))(torch.ones(1, 12, 12, 3), inputs(1)[1])[0]
    centred = tokens - tokens.mean(0)
    fraction = (centred.square().mean() / tokens.square().mean()).sqrt().item()
    assert 0.3 < fraction < 1 and math.isfinite(fraction)


def decoder_of(**changes) -> GaussianDecoder:
    return GaussianDecoder(GambaConfig(width=48, encoder="none", **changes))


def test_ranges_and_shapes_for_wild_tokens():
    decoder = decoder_of(predict_rotation=True)
    gaussians = decoder(100 * torch.randn(2, 33, 48))
    assert gaussians.means.shape == (2, 33, 3) and gaussians.means.abs().max() <= 0.5
    assert gaussians.quats.shape == (2, 33, 4)
    assert (gaussians.scales > 0).all()
    torch.nn.init.constant_(decoder.scale.bias, -1000)
    assert (decoder(torch.randn(1, 5, 48)).scales == 1e-6).all(), "files store a logarithm"
    for values in (gaussians.opacities, gaussians.colors):
        assert (values >= 0).all() and (values <= 1).all()


def test_position_is_the_expectation_over_the_points():
    decoder, tokens = decoder_of(), torch.randn(1, 5, 48)
    logits = decoder.position(decoder.mlp(tokens)).reshape(1, 5, 3, 21).double()
    weights = logits.exp() / logits.exp().sum(-1, keepdim=True)
    points = torch.tensor([-0.5 + 0.05 * k for k in range(21)], dtype=torch.float64)
    want = (weights * points).sum(-1)
    # Float32 softmax and sum of 21 terms.
    assert torch.allclose(decoder(tokens).means.double(), want, atol=1e-6)


def test_start_values_follow_the_config():
    decoder = decoder_of(scale_init=0.03, opacity_init=0.3, predict_rotation=True)
    gaussians = decoder(torch.randn(1, 4000, 48))
    # The heads' small random weights add a little spread around the biases.
    assert 0.025 < gaussians.scales.median() < 0.035
    large = decoder_of(scale_init=0.1, scale_factor=0.05)(torch.randn(1, 999, 48))
    assert 0.095 < large.scales.median() < 0.105
    assert 0.25 < gaussians.opacities.median() < 0.35
    assert 0.45 < gaussians.colors.median() < 0.55
    assert gaussians.quats[..., 0].min() > 0.5
    spread = gaussians.means.std(dim=1)
    assert (spread > 0.05).all() and (spread < 0.2).all()


def test_float32_under_autocast():
    with torch.autocast("cpu", torch.bfloat16):
        gaussians = decoder_of()(torch.randn(1, 7, 48))
    assert gaussians.quats is None
    for value in (gaussians.means, gaussians.scales, gaussians.opacities, gaussians.colors):
        assert value.dtype == torch.float32
