"""The decoder's ranges, starting values and positions against the formula."""

import torch

from gamba_warp.model.config import GambaConfig
from gamba_warp.model.parts.decoder import GaussianDecoder


def _config(**changes) -> GambaConfig:
    return GambaConfig(**({"width": 48, "encoder": "none"} | changes))


def test_ranges_and_shapes_for_wild_tokens():
    decoder = GaussianDecoder(_config(predict_rotation=True))
    gaussians = decoder(100 * torch.randn(2, 33, 48))
    assert gaussians.means.shape == (2, 33, 3) and gaussians.means.abs().max() <= 0.5
    assert gaussians.quats.shape == (2, 33, 4)
    assert (gaussians.scales > 0).all()
    torch.nn.init.constant_(decoder.scale.bias, -1000)
    assert (decoder(torch.randn(1, 5, 48)).scales == 1e-6).all(), "files store a logarithm"
    for values in (gaussians.opacities, gaussians.colors):
        assert (values >= 0).all() and (values <= 1).all()


def test_position_is_the_expectation_over_the_points():
    decoder = GaussianDecoder(_config())
    tokens = torch.randn(1, 5, 48)
    logits = decoder.position(decoder.mlp(tokens)).reshape(1, 5, 3, 21).double()
    weights = logits.exp() / logits.exp().sum(-1, keepdim=True)
    points = torch.tensor([-0.5 + 0.05 * k for k in range(21)], dtype=torch.float64)
    want = (weights * points).sum(-1)
    # Float32 softmax and sum of 21 terms.
    assert torch.allclose(decoder(tokens).means.double(), want, atol=1e-6)


def test_start_values_follow_the_config():
    decoder = GaussianDecoder(_config(scale_init=0.03, opacity_init=0.3, predict_rotation=True))
    gaussians = decoder(torch.randn(1, 4000, 48))
    # The heads' small random weights add a little spread around the biases.
    assert 0.025 < gaussians.scales.median() < 0.035
    large = GaussianDecoder(_config(scale_init=0.1, scale_factor=0.05))(torch.randn(1, 999, 48))
    assert 0.095 < large.scales.median() < 0.105
    assert 0.25 < gaussians.opacities.median() < 0.35
    assert 0.45 < gaussians.colors.median() < 0.55
    assert gaussians.quats[..., 0].min() > 0.5
    spread = gaussians.means.std(dim=1)
    assert (spread > 0.05).all() and (spread < 0.2).all()


def test_float32_under_autocast():
    decoder = GaussianDecoder(_config())
    with torch.autocast("cpu", torch.bfloat16):
        gaussians = decoder(torch.randn(1, 7, 48))
    assert gaussians.quats is None
    for value in (gaussians.means, gaussians.scales, gaussians.opacities, gaussians.colors):
        assert value.dtype == torch.float32
