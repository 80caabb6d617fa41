"""States instead of a prefix, compared with the plain form of prepending and dropping."""

import pytest
import torch
from helpers import assert_rel_rms
from helpers.model import assert_plain_form, inputs, micro, moved_blocks

from gamba_warp.model.config import GambaConfig
from gamba_warp.model.gamba import Gamba
from gamba_warp.model.parts.prefix import prefix_states


def prepend_and_drop(blocks, tokens, camera, image):
    """Plain form of paper eq. 2."""
    for block in blocks:
        pairs = ((block.project_camera, camera), (block.project_image, image))
        prefix = [project(condition) for project, condition in pairs if condition is not None]
        hidden, _ = block.mamba(block.norm(torch.cat([*prefix, tokens], dim=1)))
        tokens = tokens + hidden[:, -tokens.shape[1] :]
    return tokens


def with_states(blocks, tokens, camera, image):
    for block, state in zip(blocks, prefix_states(blocks, camera, image)):
        tokens, _ = block(tokens, state)
    return tokens


def make_blocks(depth: int, camera: int, image: int, **changes) -> torch.nn.ModuleList:
    small = {"width": 24, "state_size": 5, "encoder": "none", "depth": depth}
    return moved_blocks(GambaConfig(**(small | changes)), camera, image)


@pytest.mark.parametrize(
    "camera, image, length, changes",
    [
        (7, 0, 0, {}),  # one token: the convolution's state starts with zeros
        (0, 11, 2, {}),
        (7, 11, 2, {"norm": "rms"}),
        (7, 11, 70, {"discretization": "zoh", "conv_size": 3}),
        (0, 11, 1, {"discretization": "bilinear", "conv_size": 2}),
        (0, 0, 0, {}),
    ],
)
def test_equals_prepend_and_drop(camera, image, length, changes):
    blocks = make_blocks(3, camera, image, **changes)
    # Float32 sums in another order, through three blocks.
    assert_plain_form(prepend_and_drop, blocks, 67, camera, (length, image), 1e-6)


def test_full_depth_model_equals_prepend_and_drop():
    """14 blocks with the paper's states, taps and expansion; camera and image tokens first."""
    config = micro(image_size=32, patch_size=4, width=48, depth=14, state_size=16)
    model = Gamba(config, "random")
    images, cameras = inputs(2, 32)
    names = ("means", "scales", "opacities", "colors")
    cotangents = [torch.randn(2, 256, *s) for s in ((3,), (3,), (), (3,))]
    parameters = {n: p for n, p in model.named_parameters() if p.requires_grad}

    def gradients(gaussians):
        loss = sum((getattr(gaussians, n) * c).sum() for n, c in zip(names, cotangents))
        return dict(zip(parameters, torch.autograd.grad(loss, list(parameters.values()))))

    condition = model.camera_token(cameras), model.encoder(images)
    tokens = prepend_and_drop(model.blocks, model.tokens(images, cameras), *condition)
    want = model.decoder(model.norm(tokens))
    got = model(images, cameras)
    # Float32 rounding, through 14 blocks.
    for name in names:
        assert_rel_rms(getattr(got, name), getattr(want, name), 2e-6, name)
    wanted, gotten = gradients(want), gradients(got)
    for name, grad in wanted.items():
        assert_rel_rms(gotten[name], grad, 2e-5, name)


def test_autocast_equals_prepend_and_drop():
    blocks = make_blocks(3, 7, 11)
    leaves = [torch.randn(2, 67, 24), torch.randn(2, 1, 7), torch.randn(2, 5, 11)]
    exact = prepend_and_drop(blocks, *leaves)
    with torch.autocast("cpu", torch.bfloat16):
        want = prepend_and_drop(blocks, *leaves)
        got = with_states(blocks, *leaves)
        (got * torch.randn_like(got)).sum().backward()
    assert got.dtype == torch.float32
    assert all(torch.isfinite(p.grad).all() for p in blocks.parameters())
    error = (want - exact).square().mean().sqrt()
    # As far from float32 as the plain form, and no further from it than the two roundings.
    assert (got - exact).square().mean().sqrt() < 1.2 * error
    assert (got - want).square().mean().sqrt() < 1.4 * error


def test_states_do_what_they_say():
    """One state per block, independent of the others; float32 and in the order of the blocks."""
    blocks = make_blocks(3, 7, 11)
    camera, image = torch.randn(2, 1, 7), torch.randn(2, 5, 11)
    together = prefix_states(blocks, camera, image)
    for block, state in zip(blocks, together):
        (alone,) = prefix_states([block], camera, image)
        assert state.conv.shape == (2, 3, 48) and state.scan.shape == (2, 48, 5)
        assert state.scan.dtype == torch.float32
        # Another size of matrix product sums in another order.
        assert_rel_rms(state.conv, alone.conv, 1e-6, "conv")
        assert_rel_rms(state.scan, alone.scan, 1e-6, "scan")
