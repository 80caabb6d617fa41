"""Checkpoints: bit-equal round trips, what is stored, and refusals that name the file."""

import pytest
import torch
from helpers.model import inputs, micro
from safetensors import safe_open
from safetensors.torch import save_file

from gamba_warp.errors import UserError
from gamba_warp.model.checkpoint import FILE_NAME, load_model, save_model
from gamba_warp.model.gamba import Gamba


@pytest.mark.parametrize(
    "changes, weights",
    [
        ({"encoder": "none", "predict_rotation": True}, None),
        ({}, "random"),
        ({"encoder_frozen": False}, "random"),
        ({"prepend": False}, None),
    ],
    ids=str,
)
def test_round_trip_is_bit_equal(tmp_path, changes, weights):
    model = Gamba(micro(**changes), weights).eval()
    with torch.no_grad():
        for parameter in model.parameters():
            if parameter.requires_grad:
                parameter += 0.01 * torch.randn_like(parameter)
    path = tmp_path / "any.safetensors"
    save_model(path, model, {"step": "12"})
    frozen = model.encoder is not None and model.config.encoder_frozen
    loaded = load_model(path, encoder_weights="random" if frozen else None)
    assert loaded.config == model.config and not loaded.training
    batch = inputs(2)
    want, got = model(*batch), loaded(*batch)
    for name in ("means", "scales", "opacities", "colors"):
        assert torch.equal(getattr(got, name), getattr(want, name)), name
    with safe_open(path, framework="pt") as file:
        assert file.metadata()["step"] == "12"
        stored = any(name.startswith("encoder.") for name in file.keys())
    assert stored == (model.encoder is not None and not frozen)


def test_folder_is_accepted(tmp_path):
    save_model(tmp_path / FILE_NAME, Gamba(micro(encoder="none")))
    assert load_model(tmp_path).config == micro(encoder="none")


def test_own_metadata_keys_are_protected(tmp_path):
    with pytest.raises(ValueError, match="config"):
        save_model(tmp_path / "m.safetensors", Gamba(micro(encoder="none")), {"config": "x"})


def test_frozen_encoder_must_be_the_same(tmp_path):
    model = Gamba(micro(), "random")
    with torch.no_grad():
        model.encoder.network.vit.norm.weight[0] += 0.5
    save_model(tmp_path / "m.safetensors", model)
    with pytest.raises(UserError, match="m.safetensors: was trained with other weights"):
        load_model(tmp_path / "m.safetensors", encoder_weights="random")
    with pytest.raises(UserError, match="must be named"):
        load_model(tmp_path / "m.safetensors")


def _damage(path, kind):
    model = Gamba(micro(encoder="none"))
    save_model(path, model)
    with safe_open(path, framework="pt") as file:
        metadata = file.metadata()
    state = model.stored_state()
    if kind == "truncated":
        path.write_bytes(path.read_bytes()[:-100])
    elif kind == "empty":
        path.write_bytes(b"")
    elif kind == "text":
        path.write_text("this is not a model " * 20)
    elif kind == "missing":
        path.unlink()
    elif kind == "no metadata":
        save_file(state, path)
    elif kind == "other format":
        save_file(state, path, metadata=metadata | {"format": "gamba_warp.model.0"})
    elif kind == "other preset":
        other = micro(encoder="none", width=24).to_json()
        save_file(state, path, metadata=metadata | {"config": other})
    elif kind == "tensor gone":
        state.pop("norm.weight")
        save_file(state, path, metadata=metadata)
    elif kind == "tensor more":
        save_file(state | {"stranger": torch.ones(1)}, path, metadata=metadata)
    elif kind == "config key":
        config = metadata["config"].replace('"fov"', '"view"')
        save_file(state, path, metadata=metadata | {"config": config})


@pytest.mark.parametrize(
    "kind, words",
    [
        ("truncated", "not a whole safetensors file"),
        ("empty", "not a whole safetensors file"),
        ("text", "not a whole safetensors file"),
        ("missing", "no such checkpoint"),
        ("no metadata", "not a Gamba checkpoint"),
        ("other format", "not a Gamba checkpoint .format gamba_warp.model.0"),
        ("other preset", "does not fit its own configuration: tensor '.*' is"),
        ("tensor gone", "no tensor 'norm.weight'"),
        ("tensor more", "an unknown tensor 'stranger'"),
        ("config key", "unknown view; missing fov"),
    ],
)
def test_bad_files_are_refused(tmp_path, kind, words):
    path = tmp_path / "bad.safetensors"
    _damage(path, kind)
    with pytest.raises(UserError, match=f"bad.safetensors: .*{words}"):
        load_model(path)
