"""Model folders: written, read, compared; from a cache of the Hub, and to the Hub."""

import json

import pytest
import torch
from helpers.model import inputs, micro
from helpers.refusals import refused

from gamba_warp import Gamba, load_model
from gamba_warp.errors import UserError
from gamba_warp.model.pretrained import WRITTEN


def _model(**changes) -> Gamba:
    torch.manual_seed(0)
    changes = {"prepend": False} | changes
    return Gamba(micro(**changes), "random" if changes["prepend"] else None).eval()


def _same(a: Gamba, b: Gamba) -> bool:
    images, cameras = inputs(2)
    with torch.no_grad():
        return torch.equal(a(images, cameras).means, b(images, cameras).means)


@pytest.mark.parametrize("prepend", [False, True])
def test_round_trip(tmp_path, prepend):
    model = _model(prepend=prepend)
    folder = model.save_pretrained(tmp_path / "mine", "## Data\nNone.")
    names = {path.name for path in folder.iterdir()}
    assert names == set(WRITTEN) - (set() if prepend else {"encoder.safetensors"})
    for back in (Gamba.from_pretrained(folder), load_model(folder)):
        assert back.config == model.config and not back.training and _same(model, back)
    card = (folder / "README.md").read_text()
    assert card.startswith("---\nlibrary_name: gamba-warp\n") and card.endswith("## Data\nNone.\n")
    assert 'Gamba.from_pretrained("mine")' in card and "36 Gaussians" in card
    assert json.loads((folder / "config.json").read_text())["width"] == 16


def test_an_edited_card_stays(tmp_path):
    model = _model()
    model.save_pretrained(tmp_path)
    (tmp_path / "README.md").write_text("mine")
    model.save_pretrained(tmp_path)
    assert (tmp_path / "README.md").read_text() == "mine"


def test_config_json_of_another_model(tmp_path):
    _model().save_pretrained(tmp_path)
    fields = json.loads((tmp_path / "config.json").read_text())
    (tmp_path / "config.json").write_text(json.dumps(fields | {"state_size": 5}))
    refused("is not the configuration in", Gamba.from_pretrained, tmp_path)
    (tmp_path / "config.json").write_bytes(b"\xff\xfe")
    refused("config.json: .* not valid JSON", Gamba.from_pretrained, tmp_path)


def test_needs_no_hub_for_a_folder(tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "huggingface_hub", None)
    model = _model()
    model.save_pretrained(tmp_path)
    assert _same(model, Gamba.from_pretrained(tmp_path))
    refused(r"pip install '\.\[hub\]' in the checkout", Gamba.from_pretrained, "nobody/nothing")


def _cached(tmp_path, model):
    """Make a repository in a cache of huggingface_hub."""
    repository = tmp_path / "models--owner--name"
    commit = "a" * 40
    (repository / "refs").mkdir(parents=True)
    (repository / "refs" / "main").write_text(commit)
    return model.save_pretrained(repository / "snapshots" / commit)


def test_a_cached_repository_needs_no_network(tmp_path, monkeypatch):
    model = _model()
    _cached(tmp_path, model)
    monkeypatch.setattr("socket.socket.connect", _no_network)
    assert _same(model, Gamba.from_pretrained("owner/name", cache_dir=tmp_path))
    with pytest.raises(UserError, match="owner/other: neither a local folder nor available"):
        Gamba.from_pretrained("owner/other", cache_dir=tmp_path)


def _no_network(*arguments):
    raise OSError("no network in this test")


@pytest.mark.parametrize("name", ["", "a/b/c", "../x", "owner/" + "n" * 300, "weiß nicht"])
def test_names_that_are_none(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("socket.socket.connect", _no_network)
    refused(None, Gamba.from_pretrained, name, cache_dir=tmp_path)


def test_a_repository_without_a_model(tmp_path, monkeypatch):
    folder = _cached(tmp_path, _model())
    (folder / "model.safetensors").unlink()
    monkeypatch.setattr("socket.socket.connect", _no_network)
    with pytest.raises(UserError, match="owner/name: neither"):
        Gamba.from_pretrained("owner/name", cache_dir=tmp_path, local_files_only=True)


def test_push(tmp_path, monkeypatch):
    model, sent = _model(), {}

    class Api:
        def __init__(self, token=None):
            self.token = token

        def create_repo(self, repo_id, **options):
            sent["repository"] = repo_id, options["private"], self.token
            return type("Url", (), {"repo_id": repo_id})

        def upload_folder(self, folder_path, commit_message, **options):
            sent["model"] = load_model(folder_path)
            sent["files"] = {path.name for path in folder_path.iterdir()}
            return "https://hub.test/commit"

    monkeypatch.setattr("huggingface_hub.hub_mixin.HfApi", Api)
    assert model.push_to_hub("owner/name", private=True, token="t") == "https://hub.test/commit"
    assert sent["repository"] == ("owner/name", True, "t") and _same(model, sent["model"])
    assert sent["files"] == {"README.md", "config.json", "model.safetensors"}
    monkeypatch.setattr(Api, "create_repo", _no_network)
    refused("owner/name: cannot be written to the Hub", model.push_to_hub, "owner/name")
