"""The Gamba block and the states of its prefix, against their equations in float64."""

import math

import pytest
import torch
from helpers import assert_rel_rms
from helpers.mamba import TRANSITIONS, gamba_block_in_float64
from helpers.model import FIELDS, assert_plain_form, inputs, micro, moved_blocks, perturbed

from gamba_warp.model.config import GambaConfig
from gamba_warp.model.gamba import Gamba
from gamba_warp.model.parts.block import GambaBlock
from gamba_warp.model.parts.mamba import Mamba
from gamba_warp.model.parts.prefix import prefix_states


def _config(**changes) -> GambaConfig:
    small = {"width": 24, "state_size": 5, "dt_rank": 3, "depth": 2, "encoder": "none"}
    return GambaConfig(**(small | changes))


def _run(block: GambaBlock, tokens, camera, image) -> torch.Tensor:
    """Run the block after its own prefix."""
    return block(tokens, *prefix_states([block], camera, image))[0]


@pytest.mark.parametrize(
    "changes, camera, image",
    [
        *(({"norm": n, "discretization": d}, 7, 11) for n in ("layer", "rms") for d in TRANSITIONS),
        *(({}, *channels) for channels in ((7, 0), (0, 11), (0, 0))),
    ],
    ids=str,
)
def test_the_block_and_its_gradients_are_those_of_float64(changes, camera, image):
    """Also with parts of the condition."""
    block = perturbed(GambaBlock(_config(**changes), camera, image))
    given = {"tokens": torch.randn(3, 9, 24)}
    given |= {"camera": torch.randn(3, 1, camera)} if camera else {}
    given |= {"image": torch.randn(3, 4, image)} if image else {}
    leaves = {name: x.requires_grad_() for name, x in given.items()}
    leaves |= dict(block.named_parameters())
    wide = {name: x.detach().double().requires_grad_() for name, x in leaves.items()}
    got = _run(block, given["tokens"], given.get("camera"), given.get("image"))
    want = gamba_block_in_float64(wide, block.mamba.discretization)
    assert_rel_rms(got, want, 2e-6, "block")  # float32 against float64
    cotangent = torch.randn_like(got)
    grads = torch.autograd.grad(got, [*leaves.values()], cotangent)
    wanted = torch.autograd.grad(want, [*wide.values()], cotangent.double())
    for name, a, b in zip(leaves, grads, wanted):
        assert_rel_rms(a, b, 1e-5, name)  # sums over up to 42 tokens


def test_prefix_reaches_the_first_token_and_nothing_flows_back():
    block = perturbed(GambaBlock(_config(), 7, 11))
    tokens, camera, image = torch.randn(1, 8, 24), torch.randn(1, 1, 7), torch.randn(1, 4, 11)
    base = _run(block, tokens, camera, image)
    assert not torch.allclose(base[:, 0], _run(block, tokens, camera + 1, image)[:, 0])
    assert not torch.allclose(base[:, 0], _run(block, tokens, camera, image + 1)[:, 0])
    later = tokens.clone()
    later[:, 5] += 1
    changed = _run(block, later, camera, image)
    assert torch.equal(base[:, :5], changed[:, :5])
    assert not torch.allclose(base[:, 5:], changed[:, 5:])


def test_start_values_are_those_of_mamba():
    config = _config(width=64, depth=9)
    mamba = Mamba(config)
    assert torch.allclose(mamba.A_log.exp(), torch.arange(1, 6.0).expand(128, 5))
    assert torch.equal(mamba.D, torch.ones(128))
    step = torch.nn.functional.softplus(mamba.dt_proj.bias)
    assert step.min() >= 0.99e-3 and step.max() <= 0.101
    log = step.log()  # log-uniform: its mean is the middle of the range
    assert abs(log.mean().item() - math.log(1e-2)) < 0.5
    # Linear's uniform start within ±1/sqrt(fan_in), over sqrt(depth).
    assert abs(mamba.out_proj.weight.abs().max().item() - 128**-0.5 / 3) < 1e-3
    for name in ("A_log", "D", "conv_bias"):
        assert getattr(mamba, name)._no_weight_decay


def test_bfloat16_autocast_stays_near_float32():
    block = perturbed(GambaBlock(_config(), 7, 11))
    tokens, camera, image = torch.randn(2, 19, 24), torch.randn(2, 1, 7), torch.randn(2, 4, 11)
    want = _run(block, tokens, camera, image)
    with torch.autocast("cpu", torch.bfloat16):
        got = _run(block, tokens, camera, image)
    assert got.dtype == torch.float32  # the residual stream is not rounded
    # bfloat16 keeps 8 bits; the branch passes through six roundings of 0.2 to 0.4 %.
    assert_rel_rms(got - tokens, want - tokens, 2e-2, "branch")


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
    cotangents = [torch.randn(2, 256, *s) for s in ((3,), (3,), (), (3,))]
    parameters = {n: p for n, p in model.named_parameters() if p.requires_grad}

    def gradients(gaussians):
        loss = sum((getattr(gaussians, n) * c).sum() for n, c in zip(FIELDS, cotangents))
        return dict(zip(parameters, torch.autograd.grad(loss, list(parameters.values()))))

    condition = model.camera_token(cameras), model.encoder(images)
    tokens = prepend_and_drop(model.blocks, model.tokens(images, cameras), *condition)
    want = model.decoder(model.norm(tokens))
    got = model(images, cameras)
    # Float32 rounding, through 14 blocks.
    for name in FIELDS:
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
