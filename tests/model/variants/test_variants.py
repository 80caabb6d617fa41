"""Variants of the network: unchanged presets, and files of each variant."""

import hashlib
import json

import pytest
import torch
from helpers.model import FIELDS, inputs, micro
from safetensors import safe_open

from gamba_warp.model.checkpoint import load_model, save_model
from gamba_warp.model.config import PRESETS, GambaConfig
from gamba_warp.model.gamba import Gamba
from gamba_warp.model.predict import reconstruct
from gamba_warp.vision.vgg import VGG16Features, VGG16Trunk

# Names and shapes of the tensors in files of the presets; the same as in older files.
STORED = {
    "tiny": "3f61a702eabbc5c7",
    "rays": "8c65916990cee708",
    "small": "7d49ecd3649f9569",
    "paper": "ce8b5e294b63d7c8",
    "released": "d2aa8d5e9898f27a",
}
NEW = ("mixer", "attention_heads", "attention_mlp", "mixed_tokens")
NEW += ("triplane_size", "triplane_features", "image_tokens", "num_orders", "ray_back")
NEW += ("final_norm", "scan_orders", "encoder_resize", "position_weights", "scale_factor")
NEW += ("decoder", "ray_cells", "ray_layers", "ray_features", "ray_hidden", "ray_coarse")
VARIANTS = [
    {"mixer": "attention", "attention_heads": 2},
    {"mixer": "attention", "attention_mlp": 1, "norm": "rms", "prepend": False},
    {"mixer": "attention", "decoder": "rays", "ray_cells": 2, "ray_coarse": 1},
    {"mixed_tokens": True, "image_size": 8},
    {"mixed_tokens": True, "image_size": 8, "mixer": "attention"},
    {"decoder": "triplane", "triplane_size": 3, "triplane_features": 5},
    {"image_tokens": "mixed"},
    {"image_tokens": "mixed", "norm": "rms", "decoder": "rays", "ray_cells": 2},
    {"image_tokens": "mixed", "decoder": "triplane", "triplane_size": 3},
    {"decoder": "triplane", "triplane_size": 2, "mixer": "attention", "predict_rotation": True},
    {"decoder": "triplane", "triplane_size": 5, "mixed_tokens": True, "image_size": 8},
    {"num_orders": 1, "mixed_tokens": True, "image_size": 8},
    {"num_orders": 3, "decoder": "rays", "ray_cells": 2},
    {"decoder": "rays", "ray_cells": 2, "ray_layers": 2, "ray_back": "opaque"},
]


LENGTHS = {"tiny": (4096, 0), "rays": (49152, 0), "small": (9216, 144), "paper": (16384, 576)}
LENGTHS["released"] = (16384, 577)
# The paper's ablations, and other options of the plain network.
ABLATIONS = [
    {},
    {"encoder": "none"},
    {"additive_image_tokens": False},
    {"prepend": False},
    {"camera_token": False},
    {"predict_rotation": True, "norm": "rms"},
    {"encoder_frozen": False},
    {"discretization": "zoh"},
    {"discretization": "bilinear"},
    {"dt_rank": 3, "expand": 3, "conv_size": 2, "decoder_width": 20},
]


@pytest.mark.parametrize("preset", PRESETS)
def test_presets_store_what_they_stored(preset, monkeypatch):
    features = "gamba_warp.vision.vgg.vgg16_features"
    monkeypatch.setattr(features, lambda path: VGG16Features(VGG16Trunk().state_dict()))
    config = PRESETS[preset]
    with torch.device("meta"):
        model = Gamba(config, None if config.encoder == "vgg16" else "random")
        images = torch.rand(1, config.encoder_size, config.encoder_size, 3)
        image_tokens = model.encoder(images).shape[1] if model.encoder else 0
    state = model.stored_state()
    text = json.dumps([[name, list(value.shape)] for name, value in state.items()])
    assert hashlib.sha256(text.encode()).hexdigest()[:16] == STORED[preset]
    assert (config.num_gaussians, image_tokens) == LENGTHS[preset]
    assert model.tokens.orders.shape == (config.num_tokens,)
    if preset == "paper":  # whose own figure is "about 10 %" of 500 M parameters of an LRM
        assert 40e6 < sum(value.numel() for value in state.values()) < 55e6
        assert config.step_rank == 32 and model.encoder.channels == 768


def test_older_files_mean_the_defaults():
    values = json.loads(PRESETS["tiny"].to_json())
    old = {name: value for name, value in values.items() if name not in NEW}
    assert len(old) == len(values) - len(NEW)
    assert GambaConfig.from_json(json.dumps(old)) == PRESETS["tiny"]


@pytest.mark.parametrize(
    "changes, weights",
    [
        *(({"encoder": "none"} | changes, None) for changes in VARIANTS),
        ({"encoder": "none", "predict_rotation": True}, None),
        ({}, "random"),
        ({"encoder_frozen": False}, "random"),
        ({"prepend": False}, None),
    ],
    ids=str,
)
def test_files_hold_the_bits(tmp_path, changes, weights):
    model, path = Gamba(micro(**changes), weights).eval(), tmp_path / "any.safetensors"
    with torch.no_grad():
        for parameter in model.parameters():
            if parameter.requires_grad:
                parameter += 0.01 * torch.randn_like(parameter)
    save_model(path, model, {"step": "12"})
    frozen = model.encoder is not None and model.config.encoder_frozen
    loaded = load_model(path, encoder_weights="random" if frozen else None)
    assert loaded.config == model.config and not loaded.training
    size = model.config.image_size
    image = torch.rand(size, size, 4).numpy()
    want, got = reconstruct(model, image), reconstruct(loaded, image)
    for name in FIELDS:
        assert torch.equal(getattr(got, name), getattr(want, name)), name
        assert getattr(got, name).isfinite().all()
    with safe_open(path, framework="pt") as file:
        assert file.metadata()["step"] == "12"
        stored = any(name.startswith("encoder.") for name in file.keys())
    assert stored == (model.encoder is not None and not frozen)


@pytest.mark.parametrize(
    "changes",
    [{"encoder": name} | x for x in VARIANTS for name in ("none", "gamba_test_vit")] + ABLATIONS,
    ids=str,
)
def test_every_parameter_of_a_variant_learns(changes):
    model = Gamba(micro(**changes), "random")
    images, cameras = inputs(2, model.config.image_size)
    if model.config.input_channels == 4:
        images = torch.cat([images, 0.2 + 0.6 * torch.rand_like(images[..., :1])], -1)
    made = model(images, cameras)
    parts = [made.means, made.scales, made.opacities, made.colors]
    parts += [] if made.quats is None else [made.quats]
    sum((part * torch.randn_like(part)).sum() for part in parts).backward()
    for name, parameter in model.named_parameters():
        frozen = name.startswith("encoder.") and model.config.encoder_frozen
        assert parameter.requires_grad != frozen, name
        if parameter.requires_grad:
            assert parameter.grad is not None, name
            assert parameter.grad.isfinite().all() and parameter.grad.abs().max() > 0, name
