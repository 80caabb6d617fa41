"""The authors' public network at a small size: results, peculiarities, and their file."""

import inspect
import os
import tarfile
import zipfile
from argparse import Namespace
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import timm
import torch
from helpers.refusals import refused
from safetensors.torch import save_file
from timm.models.vision_transformer import _create_vision_transformer
from torch.nn import functional as F

from gamba_warp import cli
from gamba_warp.commands.weights import import_released_command
from gamba_warp.model import released
from gamba_warp.model.checkpoint import load_model
from gamba_warp.model.config import PRESETS
from gamba_warp.model.gamba import Gamba
from gamba_warp.model.posing import reference_cameras
from gamba_warp.model.released import DEPTH, convert_released, load_released

# What their code computed, with random weights: their state dict, its inputs and its output.
GOLDEN = Path(__file__).with_name("released_small.npz")


@timm.models.register_model
def gamba_test_wide_vit(pretrained=False, **kwargs):
    """One block of DINOv2 ViT-B with registers."""
    wide = {"patch_size": 14, "embed_dim": 768, "depth": 1, "num_heads": 12, "init_values": 0.1}
    registers = {"reg_tokens": 4, "no_embed_class": True}
    name = "vit_small_patch14_reg4_dinov2"  # for its pretrained_cfg alone
    return _create_vision_transformer(name, pretrained=pretrained, **(wide | registers | kwargs))


@pytest.fixture(scope="module")
def golden() -> dict[str, torch.Tensor]:
    with np.load(GOLDEN) as file:
        return {name: torch.from_numpy(file[name]) for name in file.files}


def _state(golden) -> dict[str, torch.Tensor]:
    prefix = "state/"
    return {k.removeprefix(prefix): v for k, v in golden.items() if k.startswith(prefix)}


class _Given(torch.nn.Module):
    """Stand-in for an encoder, with given tokens."""

    channels, frozen, name = 768, True, "given"

    def __init__(self, tokens):
        super().__init__()
        self.tokens = tokens

    def forward(self, images):
        return self.tokens


def _gaussians(golden, monkeypatch):
    """Our Gaussians from the golden inputs, transformed to our world."""
    config, weights = convert_released(_state(golden), "golden", 2)
    model = Gamba(config, encoder=_Given(golden["condition_tokens"]))
    model.load_stored_state(weights)
    pixels = golden["image_and_rays"].clone()
    pixels[:, [4, 5, 7, 8]] *= -1
    monkeypatch.setattr(model.tokens, "pixels", lambda images, cameras: pixels)
    with torch.no_grad():
        return model(torch.zeros(1, 64, 64, 3), reference_cameras(config, 1))[0]


def _theirs(golden) -> dict[str, torch.Tensor]:
    parts = golden["gaussians"][0].split([3, 1, 3, 4, 3], dim=-1)
    named = dict(zip(("means", "opacities", "scales", "quats", "colors"), parts))
    named["means"] = named["means"] * torch.tensor([1.0, -1.0, -1.0])
    return named | {"opacities": named["opacities"][:, 0]}


def test_equals_the_public_code(golden, monkeypatch):
    got, want = _gaussians(golden, monkeypatch), _theirs(golden)
    assert got.quats is None and (want["quats"] == torch.tensor([1.0, 0, 0, 0])).all()
    for name in ("means", "opacities", "scales", "colors"):
        # their scan is in float32; scales have our floor of 1e-6
        error = (getattr(got, name) - want[name]).abs().max()
        assert error < 1e-5, name
    assert want["means"].std() > 0.02 and want["scales"].std() > 1e-3  # no constants


def test_config_is_the_preset_at_their_sizes(golden):
    config, _ = convert_released(_state(golden), "golden", 2)
    small = {"image_size": 64, "width": 64, "depth": 2, "dt_rank": 4}
    assert config == replace(PRESETS["released"], **small)


def _file(golden, tmp_path, encoder=True, **changes) -> Path:
    """Write a file like their training, with an image encoder in Meta's layout."""
    state = _state(golden) | {"lpips_loss.lin0.weight": torch.ones(2)} | changes
    if encoder:
        vit = timm.create_model("gamba_test_wide_vit", img_size=518, num_classes=0).state_dict()
        vit["register_tokens"] = vit.pop("reg_token") + 0.1
        position = torch.randn(1, 1, 768)
        vit["pos_embed"] = torch.cat([position, vit["pos_embed"]], dim=1)
        vit["mask_token"] = torch.randn(1, 768)
        state |= {f"model.map_image.model.{name}": value for name, value in vit.items()}
    state = {name: value for name, value in state.items() if value is not None}
    path = tmp_path / "theirs.pth"
    torch.save({"model": state, "epoch": 3}, path)
    return path


@pytest.fixture
def wide(monkeypatch):
    monkeypatch.setitem(released._VITS, 768, "gamba_test_wide_vit")


def test_the_command_makes_a_folder_that_loads(golden, tmp_path, wide, capsys):
    path, out = _file(golden, tmp_path), tmp_path / "released"
    assert cli.run("import-released", [str(path), "--out", str(out), "--depth", "2"]) == 0
    assert "2 blocks of 64 channels, 256 Gaussians" in capsys.readouterr().out
    model, want = load_model(out), load_released(path, depth=2)
    assert model.config == want.config and not model.training
    images, cameras = torch.rand(1, 64, 64, 3), reference_cameras(model.config, 1)
    with torch.no_grad():
        got, again = model(images, cameras), want(images, cameras)
        tokens = model.encoder(images)
        # Theirs: class token and patches of the image between its pixels, not normalised.
        seen = F.interpolate(images.permute(0, 3, 1, 2), (336, 336), mode="bilinear")
        plain = model.encoder.network.vit.forward_features(seen)
    assert tokens.shape == (1, 577, 768)
    assert torch.allclose(tokens, torch.cat([plain[:, :1], plain[:, 5:]], 1), atol=1e-5)
    assert torch.equal(got.means, again.means) and torch.equal(got.colors, again.colors)


def test_encoder_from_a_file_of_its_own(golden, tmp_path, wide):
    whole = load_released(_file(golden, tmp_path), depth=2)
    save_file(whole.encoder.weights(), tmp_path / "vit.safetensors")
    path = _file(golden, tmp_path, encoder=False)
    model = load_released(path, tmp_path / "vit.safetensors", 2)
    assert model.encoder.fingerprint == whole.encoder.fingerprint
    refused(r"theirs.pth: has no image encoder", load_released, path, depth=2)


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16, torch.float64])
def test_any_float_dtype(golden, tmp_path, wide, dtype):
    """Rounded points of the position are no longer evenly spaced."""
    path = _file(golden, tmp_path)
    content = torch.load(path)["model"]
    rounded = {name: value.to(dtype) for name, value in content.items()}
    torch.save(rounded, path)
    got = load_released(path, depth=2)
    points = content["model.decoder.coords"]
    weights = {k: v.float() for k, v in rounded.items()} | {"model.decoder.coords": points}
    torch.save(weights, path)
    want = load_released(path, depth=2)
    assert got.config == want.config and got.config.position_range == 0.4
    assert all(x.dtype == torch.float32 for x in got.parameters())
    for (name, a), b in zip(got.state_dict().items(), want.state_dict().values(), strict=True):
        assert torch.equal(a, b), name
    for wrong in (points.square(), points + 0.02, points * torch.tensor([[1], [1], [1.02]])):
        state = rounded | {"model.decoder.coords": wrong.to(dtype)}
        refused("not the same evenly spaced points", convert_released, state, "wrong", 2)


@pytest.mark.parametrize("depth, found", [(2, 1), (14, 2), (1, 2)])
def test_a_file_without_its_last_blocks_is_refused(golden, tmp_path, depth, found):
    state = _state(golden)
    if found == 1:
        last = ("model.transformer.layers.1.mamba", "model.transformer.layers.1.cond")
        state = {name: value for name, value in state.items() if not name.startswith(last)}
    words = f"a: holds {found} blocks?, not {depth}: a part .* --depth {found} accepts"
    refused(words, convert_released, state, "a", depth)
    assert DEPTH == PRESETS["released"].depth == 14
    assert inspect.signature(import_released_command).parameters["depth"].default == DEPTH


WRAPPED = (
    lambda name: "module." + name,
    lambda name: "module._orig_mod." + name,
    lambda name: name.replace("model.", "model._orig_mod.", 1),
    lambda name: name.removeprefix("model."),
    lambda name: "net." + name.removeprefix("model."),
    lambda name: "model." + name,
    lambda name: "_orig_mod." + name.removeprefix("model."),
)


def test_wrappers_names_are_left_out(golden, tmp_path, wide):
    path = _file(golden, tmp_path)
    content = {k: v for k, v in torch.load(path)["model"].items() if k.startswith("model.")}
    want = load_released(path, depth=2)
    for change in WRAPPED:
        torch.save({change(name): value for name, value in content.items()}, path)
        got = load_released(path, depth=2)
        assert got.config == want.config and got.encoder.fingerprint == want.encoder.fingerprint
        assert torch.equal(got.decoder.position.weight, want.decoder.position.weight)
    torch.save(content | {"module." + name: value for name, value in content.items()}, path)
    refused("has a tensor twice, with 'module.'", load_released, path, depth=2)
    with zipfile.ZipFile(tmp_path / "a.pth", "w") as archive:
        archive.write(path, "theirs.pth")
    refused("a zip archive of theirs.pth; unpack it first", load_released, tmp_path / "a.pth")
    with tarfile.open(tmp_path / "a.pth", "w") as archive:
        archive.add(path, "theirs.pth")
    refused("a tar archive; unpack it first", load_released, tmp_path / "a.pth")


@pytest.mark.parametrize(
    "thing, name", [(Namespace(lr=1), "argparse.Namespace"), (os.system, "posix.system")]
)
def test_an_object_in_the_file_is_named(golden, tmp_path, thing, name):
    path = tmp_path / "theirs.pth"
    torch.save({"model": _state(golden), "args": thing}, path)
    refused(rf"it holds '{name}', which torch does not load", load_released, path, depth=2)


@pytest.mark.parametrize(
    "name, value, words",
    [
        ("model.stem_layer.weight", None, "no tensor 'stem_layer.weight'"),
        ("model.transformer.layers.1.mamba_block.mixer.D", None, "no tensor '.*mixer.D'"),
        ("model.transformer.extra", torch.ones(2), "unknown tensor 'model.transformer.extra'"),
        ("model.transformer.pos_embed", torch.ones(255, 64), "255 tokens"),
        ("model.transformer.pos_embed", torch.ones(256), "not 2 axes"),
        ("model.transformer.pos_embed", torch.ones(256, 63), "tokens.embedding' is"),
        ("model.decoder.coords", torch.rand(3, 21), "not the same evenly spaced points"),
        ("model.decoder.coords", torch.ones(3, 0), "not the same evenly spaced points"),
        ("model.decoder.gs_layer.rgb.bias", torch.full((3,), torch.nan), "not finite"),
        ("model.decoder.gs_layer.rgb.bias", torch.ones(3).int(), "not a tensor of floating"),
        ("model.stem_layer.weight", torch.ones(64, 8, 8, 8), "takes 8 channels, not 9"),
        ("model.transformer.layers.0.cond_affine.weight", torch.ones(64, 7), "not DINOv2's"),
        ("model.transformer.layers.9999.norm.weight", torch.ones(3), "config: depth is 10,?000"),
    ],
)
def test_other_networks_are_one_line(golden, tmp_path, name, value, words):
    path = _file(golden, tmp_path, encoder=False, **{name: value})
    said = refused(words, load_released, path, "random" if "embedding" in words else None, 2)
    assert str(path) in said


def test_the_file_itself_is_never_replaced(golden, tmp_path, wide, capsys):
    path = _file(golden, tmp_path).rename(tmp_path / "model.safetensors")
    before = path.read_bytes()
    assert cli.run("import-released", [str(path), "--out", str(tmp_path)]) == 2
    assert "would be overwritten" in capsys.readouterr().err and path.read_bytes() == before
