"""Checkpoints: bit-equal round trips, their content, and errors that name the file."""

import json
import os
import struct
import sys
from pathlib import Path

import pytest
import torch
from helpers.model import inputs, micro
from helpers.refusals import refused
from safetensors import safe_open
from safetensors.torch import save_file

from gamba_warp.errors import UserError
from gamba_warp.model.checkpoint import ENCODER_NAME, FILE_NAME, load_model, save_folder, save_model
from gamba_warp.model.gamba import Gamba
from gamba_warp.train.checkpoint import load_weights


def test_equal_models_are_equal_bytes(tmp_path):
    model = Gamba(micro(encoder="none"))
    extra = {letter: letter * 9 for letter in 'ghijklmä\n\x7f"'}  # some are escaped in the header
    save_model(tmp_path / "a", model, extra)
    save_model(tmp_path / "b", model, dict(reversed(extra.items())))
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()
    with safe_open(tmp_path / "a", framework="pt") as file:
        found = file.metadata()
    assert extra.items() <= found.items() and found.keys() - extra.keys() == {"format", "config"}


def test_folder_is_accepted(tmp_path):
    save_model(tmp_path / FILE_NAME, Gamba(micro(encoder="none")))
    assert load_model(tmp_path).config == micro(encoder="none")


def test_own_metadata_keys_are_protected(tmp_path):
    with pytest.raises(ValueError, match="config"):
        save_model(tmp_path / "m.safetensors", Gamba(micro(encoder="none")), {"config": "x"})


def test_swapped_arguments_are_told(tmp_path):
    model = Gamba(micro(encoder="none"))
    with pytest.raises(TypeError, match="takes the path, then the model, and got Gamba, .*Path$"):
        save_model(model, tmp_path / "m.safetensors")
    assert not list(tmp_path.iterdir())


def test_frozen_encoder_must_be_the_same(tmp_path):
    model = Gamba(micro(), "random")
    with torch.no_grad():
        model.encoder.network.vit.norm.weight[0] += 0.5
    save_model(tmp_path / "m.safetensors", model)
    with pytest.raises(UserError, match="m.safetensors: was trained with weights of"):
        load_model(tmp_path / "m.safetensors", encoder_weights="random")
    refused("must be given", load_model, tmp_path / "m.safetensors")


def _damage(path, kind):
    model = Gamba(micro(encoder="none"))
    save_model(path, model)
    with safe_open(path, framework="pt") as file:
        metadata = file.metadata()
    config, state = metadata["config"], model.stored_state()

    def stored(tensors=state, **changes):
        save_file(tensors, path, metadata=metadata | changes)

    def configured(old, new):
        stored(config=config.replace(old, new))

    if kind == "pipe":
        path.unlink()
        os.mkfifo(path)
    elif kind == "not finite":
        state["norm.weight"][3:5] = torch.tensor([float("nan"), float("inf")])
        stored()
    elif kind == "huge":
        huge = json.dumps(json.loads(config) | {"width": 2048, "depth": 200})
        stored({"x": torch.ones(1)}, config=huge)
    elif kind == "no text":
        header = json.dumps({"__metadata__": {"config": 7, "format": "x"}}).encode()
        path.write_bytes(struct.pack("<Q", len(header)) + header)
    else:
        nested = f'"depth": {"[" * 60 + "]" * 60}'
        {
            "truncated": lambda: path.write_bytes(path.read_bytes()[:-100]),
            "empty": lambda: path.write_bytes(b""),
            "text": lambda: path.write_text("this is not a model " * 20),
            "missing": path.unlink,
            "no metadata": lambda: save_file(state, path),
            "other format": lambda: stored(format="gamba_warp.model.0"),
            "other preset": lambda: stored(config=micro(encoder="none", width=24).to_json()),
            "tensor gone": lambda: stored({k: v for k, v in state.items() if k != "norm.weight"}),
            "tensor more": lambda: stored(state | {"stranger": torch.ones(1)}),
            "config key": lambda: configured('"fov"', '"view"'),
            "nobody's": lambda: configured('"encoder": "none"', '"encoder": "vit_of_nobody"'),
            "endless depth": lambda: configured('"depth": 2', '"depth": 1000000000'),
            "nested": lambda: configured('"depth": 2', nested),
            "integers": lambda: stored({name: value.int() for name, value in state.items()}),
            "header": lambda: path.write_bytes(struct.pack("<Q", 1 << 40) + path.read_bytes()[8:]),
        }[kind]()


@pytest.mark.parametrize(
    "kind, words",
    [
        ("truncated", "not a valid safetensors file"),
        ("empty", "not a valid safetensors file"),
        ("text", "not a valid safetensors file"),
        ("missing", "no such checkpoint"),
        ("no metadata", "not a Gamba checkpoint"),
        ("other format", "not a Gamba checkpoint .format gamba_warp.model.0"),
        ("other preset", "does not fit its own configuration: tensor '.*' is"),
        ("tensor gone", "no tensor 'norm.weight'"),
        ("tensor more", "an unknown tensor 'stranger'"),
        ("config key", "unknown view; missing fov"),
        ("huge", "does not fit its own configuration: no tensor"),
        ("endless depth", "config: depth is 1000000000, must be at least 1 and at most 256"),
        ("nobody's", "encoder vit_of_nobody: neither"),
        ("nested", "configuration: nested deeper than 32 levels"),
        ("integers", "'.*' is of I32, not F32, BF16, F16"),
        ("not finite", "2 of 16 numbers of 'norm.weight' are not finite"),
        ("no text", "not a valid safetensors file"),
        ("header", "not a valid safetensors file .its header is too large"),
        ("pipe", "not a plain file"),
    ],
)
def test_bad_files_are_refused(tmp_path, kind, words):
    path = tmp_path / "bad.safetensors"
    _damage(path, kind)
    refused(f"bad.safetensors: .*{words}", load_model, path)
    refused("bad.safetensors: ", load_weights, path, Gamba(micro(encoder="none")))


def test_a_small_file_that_claims_a_large_model_takes_no_memory(tmp_path, monkeypatch):
    config = micro(encoder="none", width=2048, depth=100)  # 10 GB
    metadata = {"format": "gamba_warp.model.1", "config": config.to_json()}
    save_file({"norm.weight": torch.ones(2048)}, tmp_path / "m.safetensors", metadata=metadata)
    built = []

    def watched(*arguments, **options):
        built.append(torch.empty(0).device.type)
        assert built == ["meta"]
        return Gamba(*arguments, **options)

    monkeypatch.setattr("gamba_warp.model.checkpoint.Gamba", watched)
    refused("no tensor 'blocks.0.mamba.A_log'", load_model, tmp_path / "m.safetensors")
    assert built == ["meta"]


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_half_precision_becomes_float32(tmp_path, dtype):
    model = Gamba(micro(encoder="none"))
    save_model(tmp_path / "m.safetensors", model)
    with safe_open(tmp_path / "m.safetensors", framework="pt") as file:
        metadata = file.metadata()
    half = {name: value.to(dtype) for name, value in model.stored_state().items()}
    save_file(half, tmp_path / "m.safetensors", metadata=metadata)
    for name, value in load_model(tmp_path / "m.safetensors").stored_state().items():
        assert value.dtype == torch.float32 and torch.equal(value, half[name].float()), name


@pytest.mark.parametrize("prepend", [False, True])
def test_a_folder_has_a_frozen_encoder(tmp_path, prepend):
    torch.manual_seed(0)
    model = Gamba(micro(prepend=prepend), "random" if prepend else None).eval()
    folder = save_folder(tmp_path / "mine", model)
    names = {path.name for path in folder.iterdir()}
    assert names == {FILE_NAME} | ({ENCODER_NAME} if prepend else set())
    back, (images, cameras) = load_model(folder), inputs(2)
    with torch.no_grad():
        assert torch.equal(back(images, cameras).means, model(images, cameras).means)
    assert back.config == model.config and not back.training


def test_a_repository_of_the_hub(tmp_path, monkeypatch):
    """One in the cache is read; another one, without a network, is refused in one line."""
    model, commit = Gamba(micro(prepend=False)).eval(), "a" * 40
    repository = tmp_path / "models--owner--name"
    (repository / "refs").mkdir(parents=True)
    (repository / "refs" / "main").write_text(commit)
    save_folder(repository / "snapshots" / commit, model)
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path))
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    for name in ("hf://owner/name", Path("hf://owner/name")):
        assert load_model(name).config == model.config
    for name in ("owner/other", "", "a/b/c", "../x", "owner/" + "n" * 300, "weiß nicht"):
        refused("^hf://.*: cannot be read", load_model, f"hf://{name}")
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    refused(r"pip install '\.\[hub\]' in the checkout", load_model, "hf://owner/name")
