"""A micro configuration of the model, and random input for it."""

import timm
import torch
from timm.models.vision_transformer import _create_vision_transformer

from gamba_warp import cli
from gamba_warp.cameras import Cameras, intrinsics, orbit
from gamba_warp.model.config import GambaConfig


@timm.models.register_model
def gamba_test_vit(pretrained=False, **kwargs):
    """Makes a ViT of one block, which configurations name as "gamba_test_vit"."""
    tiny = {"patch_size": 8, "embed_dim": 16, "depth": 1, "num_heads": 2}
    name = "vit_base_patch16_224"  # for its pretrained_cfg alone
    return _create_vision_transformer(name, pretrained=pretrained, **(tiny | kwargs))


def micro(**changes) -> GambaConfig:
    """Makes a configuration of 36 Gaussians and 4 image tokens, with changes to its fields."""
    small = {
        "image_size": 12,
        "patch_size": 4,
        "width": 16,
        "depth": 2,
        "state_size": 4,
        "encoder": "gamba_test_vit",
        "encoder_size": 16,
    }
    return GambaConfig(**(small | changes))


def inputs(batch: int, size: int = 12) -> tuple[torch.Tensor, Cameras]:
    """Draws pictures ``[batch, size, size, 3]`` and makes a camera for each."""
    viewmats = orbit(torch.linspace(-30, 200, batch), 11.0)
    cameras = Cameras(viewmats, intrinsics(size, size).expand(batch, 3, 3), size, size)
    return torch.rand(batch, size, size, 3), cameras


def run_reconstruct(*arguments) -> int:
    """Runs ``gamba reconstruct`` in this process; returns the exit code."""
    return cli.run("reconstruct", [str(a) for a in arguments])


def quick(checkpoint, out):
    """Options of ``gamba reconstruct`` that make nothing but the Gaussians."""
    return ["--checkpoint", checkpoint, "--out", out, "--turntable", "none", "--no-page"]
