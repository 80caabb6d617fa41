"""A micro configuration of the model, and random input for it."""

import timm
import torch
from timm.models.vision_transformer import _create_vision_transformer

from gamba_warp import cli
from gamba_warp.cameras import Cameras, intrinsics, orbit
from gamba_warp.gaussians import Gaussians
from gamba_warp.model.config import GambaConfig
from gamba_warp.model.gamba import Gamba, make_blocks
from gamba_warp.model.parts.block import run_blocks
from gamba_warp.model.parts.prefix import prefix_states
from helpers import assert_rel_rms

FIELDS = ("means", "scales", "opacities", "colors")
NOTHING = slice(0, 0), slice(0, 0)
# Random noise has no flat cells; a disc on the left, one pixel, a square that touches two sides.
BOXES = [(slice(5, 9), slice(1, 5)), (slice(7, 8), slice(10, 11)), (slice(0, 12), slice(4, 12))]
SIZES = dict(image_size=16, patch_size=4, width=16, depth=1, encoder_size=16)
SMALLEST = GambaConfig(**SIZES, encoder="none")


@timm.models.register_model
def gamba_test_vit(pretrained=False, **kwargs):
    """Make a ViT of one block, which configurations name as "gamba_test_vit"."""
    tiny = {"patch_size": 8, "embed_dim": 16, "depth": 1, "num_heads": 2}
    name = "vit_base_patch16_224"  # only for its pretrained_cfg
    return _create_vision_transformer(name, pretrained=pretrained, **(tiny | kwargs))


def micro(**changes) -> GambaConfig:
    """Make a configuration of 36 Gaussians and 4 image tokens, with changes to its fields."""
    small = {"image_size": 12, "patch_size": 4, "width": 16, "depth": 2, "state_size": 4}
    small |= {"encoder": "gamba_test_vit", "encoder_size": 16}
    return GambaConfig(**(small | changes))


def inputs(batch: int, size: int = 12) -> tuple[torch.Tensor, Cameras]:
    """Draw images ``[batch, size, size, 3]`` and make a camera for each."""
    viewmats = orbit(torch.linspace(-30, 200, batch), 11.0)
    cameras = Cameras(viewmats, intrinsics(size, size).expand(batch, 3, 3), size, size)
    return torch.rand(batch, size, size, 3), cameras


def cut_outs(boxes=BOXES) -> tuple[torch.Tensor, Cameras]:
    """Draw noise in some boxes of transparent images, and make a camera for each."""
    images, cameras = inputs(len(boxes))
    rgba = torch.cat([images, torch.zeros_like(images[..., :1])], -1)
    for image, (rows, columns) in zip(rgba, boxes):
        image[rows, columns, 3] = 0.25 + 0.75 * torch.rand_like(image[rows, columns, 3])
    return rgba, cameras


def perturbed(blocks: torch.nn.Module) -> torch.nn.Module:
    """Move every parameter, so that none is 0 or 1 by chance, or as in another block."""
    with torch.no_grad():
        for parameter in blocks.parameters():
            parameter += 0.1 * torch.randn_like(parameter)
    return blocks


def moved_blocks(config: GambaConfig, camera: int, image: int) -> torch.nn.ModuleList:
    """Make blocks without a parameter of its initial value, of the channels of a condition."""
    return perturbed(make_blocks(config, camera, image))


def assert_plain_form(plain, blocks, length: int, camera: int, image, tolerance: float) -> None:
    """Assert that blocks give what a plain form does, and every gradient by its name.

    ``camera`` is the channels of the camera's token, ``image`` the shape of the image's.
    """
    width = blocks[0].norm.weight.numel()
    tokens, shapes = torch.randn(2, length, width), ((1, camera), tuple(image))
    condition = [torch.randn(2, *shape) if shape[-1] else None for shape in shapes]
    given = dict(zip(("tokens", "camera", "image"), (tokens, *condition)))
    leaves = {name: leaf.requires_grad_() for name, leaf in given.items() if leaf is not None}
    named = leaves | dict(blocks.named_parameters())
    cotangent = torch.randn(2, length, width)
    want = plain(blocks, tokens, *condition)
    got = run_blocks(blocks, tokens, prefix_states(blocks, *condition))
    assert_rel_rms(got, want, tolerance, "tokens")
    found = [
        torch.autograd.grad(out, [*named.values()], cotangent.to(out.dtype), allow_unused=True)
        for out in (want, got)
    ]
    for name, grad, other in zip(named, *found):
        assert (grad is None) == (other is None), name
        if name.endswith("kvq_proj.bias"):  # a key's bias changes nothing: its gradient is rounding
            grad, other = grad[width:], other[width:]
        if grad is not None:
            assert_rel_rms(other, grad, 10 * tolerance, name)


def assert_each_alone(model: Gamba, rgba: torch.Tensor, cameras: Cameras, cells) -> Gaussians:
    """Assert that a batch gives each image's own Gaussians, with known cells; return them."""
    together = model(rgba, cameras)
    for index, count in enumerate(cells):
        alone = model(rgba[index : index + 1], cameras[[index]])
        assert alone.num == count * 3
        for name in FIELDS:
            got = getattr(together, name)[index, : alone.num]
            # The same sums in products of other shapes: a few roundings.
            torch.testing.assert_close(got, getattr(alone, name)[0], rtol=2e-5, atol=2e-6)
    return together


def assert_recomputed_alike(model: Gamba, images: torch.Tensor, cameras: Cameras) -> None:
    """Assert that ``checkpointing`` does not change any gradient."""
    cotangent, grads = torch.randn(len(images), 36, 3), []
    for model.checkpointing in (False, True):
        model.zero_grad()
        (model(images, cameras).means * cotangent).sum().backward()
        grads.append({n: p.grad for n, p in model.named_parameters() if p.grad is not None})
    for name, grad in grads[0].items():
        assert torch.equal(grads[1][name], grad), name


def run_reconstruct(*arguments) -> int:
    """Run ``gamba reconstruct`` in this process; return the exit code."""
    return cli.run("reconstruct", [str(a) for a in arguments])


def quick(checkpoint, out, elevation=0):
    """Options of ``gamba reconstruct`` that only make the Gaussians."""
    options = ["--checkpoint", checkpoint, "--out", out, "--elevation", elevation]
    return [*options, "--turntable", "none", "--no-page"]
