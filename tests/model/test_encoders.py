"""Encoders with tiny random weights: files in timm's and in Meta's layout, errors, freezing."""

import pytest
import timm
import torch
from helpers.refusals import refused
from safetensors.torch import save_file
from timm.models.vision_transformer import _create_vision_transformer

from gamba_warp.model.config import GambaConfig
from gamba_warp.model.encoders import build_encoder
from gamba_warp.vision.vgg import VGG16Features, VGG16Trunk

_TINY = {"patch_size": 14, "embed_dim": 24, "depth": 2, "num_heads": 2}


@timm.models.register_model
def gamba_test_reg_vit(pretrained=False, **kwargs):
    """The shape of DINOv2 with registers: no class position, layer scale, 4 registers."""
    tiny = {**_TINY, "init_values": 0.1, "reg_tokens": 4, "no_embed_class": True}
    name = "vit_small_patch14_reg4_dinov2"  # only for its pretrained_cfg
    return _create_vision_transformer(name, pretrained=pretrained, **(tiny | kwargs))


def _config(**changes) -> GambaConfig:
    small = {"encoder": "gamba_test_reg_vit", "encoder_size": 42, "width": 16, "depth": 1}
    return GambaConfig(**(small | changes))


def _random_vit(size: int = 42) -> torch.nn.Module:
    vit = timm.create_model("gamba_test_reg_vit", img_size=size, num_classes=0)
    with torch.no_grad():
        for parameter in vit.parameters():
            parameter += 0.05 * torch.randn_like(parameter)
    return vit.eval()


def _meta_state(vit: torch.nn.Module) -> dict:
    """timm's weights in the layout of Meta's own DINOv2-with-registers files."""
    state = dict(vit.state_dict())
    class_position = torch.randn(1, 1, 24)
    state["register_tokens"] = state.pop("reg_token")
    state["cls_token"] = state["cls_token"] - class_position
    state["pos_embed"] = torch.cat([class_position, state["pos_embed"]], dim=1)
    state["mask_token"] = torch.randn(1, 24)
    return state


def _want(vit, images, config):
    mean, std = torch.tensor([0.485, 0.456, 0.406]), torch.tensor([0.229, 0.224, 0.225])
    if not config.encoder_normalize:
        mean, std = torch.zeros(3), torch.ones(3)
    tokens = vit.forward_features(((images - mean) / std).permute(0, 3, 1, 2))
    return tokens[:, 5:]


@pytest.mark.parametrize("normalize", [True, False])
@pytest.mark.parametrize("form", ["timm.safetensors", "timm.pth", "meta.pth", "nested.pth"])
def test_local_files(tmp_path, form, normalize):
    vit, config = _random_vit(), _config(encoder_normalize=normalize)
    path = tmp_path / form
    if form.endswith("safetensors"):
        save_file(vit.state_dict(), path)
    else:
        state = vit.state_dict() if form == "timm.pth" else _meta_state(vit)
        torch.save({"model": state} if form == "nested.pth" else state, path)
    encoder = build_encoder(config, path)
    images = torch.rand(3, 42, 42, 3)
    got = encoder(images)
    assert got.shape == (3, 9, 24) and encoder.channels == 24
    # The class token is a sum and a difference of the same float32 numbers in Meta's layout.
    assert torch.allclose(got, _want(vit, images, config), atol=1e-5)


def test_class_token_comes_first(tmp_path):
    vit = _random_vit()
    save_file(vit.state_dict(), tmp_path / "vit.safetensors")
    images = torch.rand(1, 42, 42, 3)
    plain = build_encoder(_config(), tmp_path / "vit.safetensors")(images)
    full = build_encoder(_config(encoder_class_token=True), tmp_path / "vit.safetensors")(images)
    assert full.shape == (1, 10, 24) and torch.equal(full[:, 1:], plain)


def test_another_image_size_resizes_images_and_positions(tmp_path):
    vit = _random_vit(size=70)
    save_file(vit.state_dict(), tmp_path / "vit.safetensors")
    encoder = build_encoder(_config(), tmp_path / "vit.safetensors")
    assert encoder(torch.rand(2, 60, 60, 3)).shape == (2, 9, 24)
    grey = torch.full((1, 60, 60, 3), 0.25)  # resizing must not change a plain image
    assert torch.allclose(encoder(grey), encoder(grey[:, :42, :42]), atol=1e-5)


def test_frozen_is_in_eval_mode_without_gradient():
    encoder = build_encoder(_config(), "random").train()
    assert not encoder.network.training and not encoder.network.vit.blocks[0].training
    assert not any(p.requires_grad for p in encoder.parameters())
    assert not encoder(torch.rand(1, 42, 42, 3, requires_grad=True)).requires_grad


def test_unfrozen_trains():
    encoder = build_encoder(_config(encoder_frozen=False), "random").train()
    assert encoder.network.training
    encoder(torch.rand(1, 42, 42, 3)).square().sum().backward()
    assert all(p.grad is not None for n, p in encoder.named_parameters() if "reg" in n)


def test_random_is_the_same_each_time_and_leaves_the_seed_alone():
    torch.manual_seed(3)
    want = torch.rand(1)
    torch.manual_seed(3)
    first = build_encoder(_config(), "random").fingerprint
    assert torch.equal(torch.rand(1), want)
    assert build_encoder(_config(), "random").fingerprint == first


def test_fingerprint_tells_weights_apart(tmp_path):
    vit = _random_vit()
    save_file(vit.state_dict(), tmp_path / "vit.safetensors")
    one = build_encoder(_config(), tmp_path / "vit.safetensors").fingerprint
    with torch.no_grad():
        vit.norm.bias[3] += 1e-3
    save_file(vit.state_dict(), tmp_path / "vit.safetensors")
    assert build_encoder(_config(), tmp_path / "vit.safetensors").fingerprint != one


@pytest.mark.parametrize(
    "changes, weights, words",
    [
        ({}, None, "must be given"),
        ({}, "missing.pth", "missing.pth: no such file"),
        ({"encoder": "vit_of_nobody"}, "random", "vit_of_nobody: neither"),
        ({"encoder": "resnet18"}, "random", "resnet18"),
        ({"encoder_size": 43}, "random", "encoder_size 43 is not a multiple of 14"),
        ({"encoder": "vgg16"}, "random", "not 'random'"),
        ({"encoder": "vgg16"}, "hub", "not 'hub'"),
    ],
)
def test_errors(changes, weights, words):
    refused(words, build_encoder, _config(**changes), weights)


@pytest.mark.parametrize("kind", ["empty", "text", "other", "list", "truncated", "nan", "keys"])
@pytest.mark.parametrize("suffix", [".pth", ".safetensors"])
def test_bad_files_name_the_file(tmp_path, kind, suffix):
    path = tmp_path / f"weights{suffix}"
    state = _random_vit().state_dict()
    write = save_file if suffix == ".safetensors" else torch.save
    if kind in ("empty", "text"):
        path.write_bytes(b"" if kind == "empty" else b"not weights at all" * 9)
    elif kind == "list" and suffix == ".pth":
        torch.save([1, 2], path)
    elif kind == "truncated":
        write(state, path)
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    elif kind == "nan":
        state["norm.weight"][0] = float("nan")
        write(state, path)
    elif kind == "keys" and suffix == ".pth":
        torch.save({"model": {3: torch.ones(2)}}, path)
    else:
        state.pop("norm.weight")
        write(state, path)
    refused(f"{path.name}: ", build_encoder, _config(), path)


def test_vgg16_tokens(monkeypatch):
    shapes = VGG16Trunk().state_dict()
    monkeypatch.setattr("gamba_warp.vision.vgg.vgg16_features", lambda path: VGG16Features(shapes))
    encoder = build_encoder(_config(encoder="vgg16", encoder_size=48), None)
    assert encoder(torch.rand(2, 50, 50, 3)).shape == (2, 9, 512)
    assert encoder.channels == 512
    assert not any(p.requires_grad for p in encoder.parameters())
