"""The whole network, from an image to Gaussians, and every gradient, against float64."""

import pytest
import torch
import torch.nn.functional as F
from helpers import assert_all_rel_rms
from helpers.mamba import gamba_block_in_float64, normalized, part
from helpers.model import inputs, moved_blocks, perturbed
from helpers.scan import assert_gradients, leaves

from gamba_warp.cameras import plucker_rays
from gamba_warp.model.config import GambaConfig
from gamba_warp.model.gamba import Gamba
from gamba_warp.model.parts.decoder import MIN_SCALE
from gamba_warp.model.parts.prefix import prefix_states
from gamba_warp.model.parts.tokens import camera_numbers, normalize_imagenet

IMAGE_CHANNELS = 6
SMALL = {"image_size": 6, "patch_size": 2, "width": 12, "depth": 2, "state_size": 4, "dt_rank": 2}
SMALL |= {"encoder": "none", "position_bins": 5}
# Changes of the configuration.
OPTIONS = [
    {"image_size": 4, "patch_size": 4, "norm": "rms", "expand": 1, "conv_size": 2, "dt_rank": 1},
    {"predict_rotation": True, "discretization": "bilinear", "conv_size": 3, "state_size": 16},
    {"prepend": False, "discretization": "zoh", "depth": 3, "position_bins": 21, "width": 20},
    {"additive_image_tokens": False, "patch_size": 1, "image_size": 3, "state_size": 1, "width": 4},
]
# Additions to parameters whose names end so.
ADDED = {
    "long steps": {"dt_proj.bias": 8.0},
    "short steps": {"dt_proj.bias": -25.0},
    "slow decay": {"A_log": -14.0},
    "fast decay": {"A_log": 7.0},
    "large scales": {"decoder.scale.bias": 8.0},
}
SCALED_IMAGES = {"black": 0.0, "out of range": 1e3}
# Of results and of gradients, by kind: measured 4e-7 and 3e-6, of saturated heads 1e-6 and 8e-6,
# with products of bfloat16 7e-3 and 3e-2.
LIMITS = dict.fromkeys(("uniform", *ADDED, *SCALED_IMAGES), (1e-6, 1e-5))
LIMITS |= {"saturated heads": (2e-6, 2e-5), "autocast": (2e-2, 1e-1)}


def linear(w, name, x):
    return x @ w[f"{name}.weight"].T + w[f"{name}.bias"]


def in_float64(model, w, cameras):
    """The Gaussians' tensors by name, from the weights and the inputs by name."""
    config, images = model.config, w["images"]
    x = w["tokens.embedding"].expand(len(images), -1, -1)
    if config.additive_image_tokens:
        rays = plucker_rays(cameras.viewmats.double(), cameras.Ks.double(), *images.shape[2:0:-1])
        pixels = torch.cat([normalize_imagenet(images), rays], -1).permute(0, 3, 1, 2)
        kernel = w["tokens.patchify.weight"], w["tokens.patchify.bias"], config.patch_size
        x = F.conv2d(pixels, *kernel).flatten(2).mT[:, model.tokens.orders] + x
    prefix = {"image": w["image_tokens"]}
    if model.camera_token:
        hidden = F.silu(linear(w, "camera_token.mlp.0", camera_numbers(cameras).double()))
        prefix["camera"] = linear(w, "camera_token.mlp.2", hidden)[:, None]
    for i in range(config.depth):
        given = {"tokens": x, **prefix, **part(w, f"blocks.{i}.")}
        x = gamba_block_in_float64(given, config.discretization)
    x = normalized(w, "norm", x)
    for name in ("decoder.mlp.0", "decoder.mlp.2"):
        x = F.silu(linear(w, name, x))
    points = torch.linspace(-1, 1, config.position_bins).double() * config.position_range
    logits = linear(w, "decoder.position", x).unflatten(-1, (3, -1))
    made = {"means": (logits.softmax(-1) * points).sum(-1)}
    made["scales"] = F.softplus(linear(w, "decoder.scale", x)) + MIN_SCALE
    made["opacities"] = linear(w, "decoder.opacity", x)[..., 0].sigmoid()
    made["colors"] = linear(w, "decoder.color", x).sigmoid()
    return made | ({"quats": linear(w, "decoder.rotation", x)} if config.predict_rotation else {})


CASES = [("uniform", changes) for changes in OPTIONS] + [(kind, {}) for kind in LIMITS]


@torch.no_grad()
def change(model, kind):
    for name, parameter in model.named_parameters():
        parameter += sum(x for end, x in ADDED.get(kind, {}).items() if name.endswith(end))
        if kind == "saturated heads" and name.startswith("decoder.") and "mlp" not in name:
            parameter *= 300


@pytest.mark.parametrize("kind, changes", CASES, ids=str)
def test_the_network_and_its_gradients_are_those_of_float64(kind, changes):
    config = GambaConfig(**SMALL | changes)
    model = perturbed(Gamba(config))
    camera = config.width if model.camera_token else 0
    model.blocks = moved_blocks(config, camera, IMAGE_CHANNELS)
    change(model, kind)
    images, cameras = inputs(3, config.image_size)
    images *= SCALED_IMAGES.get(kind, 1.0)
    mine = dict(model.named_parameters())
    mine["image_tokens"] = torch.randn(3, 4, IMAGE_CHANNELS, requires_grad=True)
    if config.additive_image_tokens:
        mine["images"] = images.requires_grad_()
    wide = leaves(mine, torch.float64)
    want = in_float64(model, {"images": images} | wide, cameras)
    with torch.autocast("cpu", torch.bfloat16, enabled=kind == "autocast"):
        token = model.camera_token(cameras) if model.camera_token else None
        condition = prefix_states(model.blocks, token, mine["image_tokens"])
        got = model(images, cameras, condition).tensors()
    limit, of_gradients = LIMITS[kind]
    assert_all_rel_rms(got, want, limit)
    outs = [got[name] for name in want]
    assert_gradients((mine, outs), (wide, [*want.values()]), of_gradients)
