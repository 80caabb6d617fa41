"""Plugins: each kind of addition in a run, what a run and a model record, and bad plugins."""

import hashlib
import json
import shutil
from pathlib import Path

import pytest
import torch
from helpers import micro
from helpers.micro import lines, run
from helpers.refusals import refused

from gamba_warp import cli, plugins
from gamba_warp.data.dataset import open_dataset
from gamba_warp.errors import FileWarning
from gamba_warp.model.checkpoint import load_model
from gamba_warp.train.checkpoint import list_checkpoints

EXAMPLE = Path(__file__).resolve().parents[2] / "docs" / "examples" / "plugin.py"


@pytest.fixture(autouse=True)
def unloaded():
    yield
    plugins.unload()


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """Clouds in the layout that the example adds."""
    root = micro.write_dataset(tmp_path_factory.mktemp("data") / "clouds", 3)
    for path in root.glob("*/transforms.json"):
        names = [frame["file_path"] for frame in json.loads(path.read_text())["frames"]]
        path.with_name("orbit.json").write_text(
            json.dumps({"distance": 1.8, "focal": 1.2, "pictures": names})
        )
        path.unlink()
    return root


def test_the_example_of_each_kind_trains_and_its_model_loads(data, tmp_path, capsys):
    plugin = tmp_path / "plugin.py"
    shutil.copy(EXAMPLE, plugin)
    with_it = {"plugin": (str(plugin), "edges=0.5"), "val_every": 6}
    plugins.load(with_it["plugin"])
    model = (*micro.MODEL, "encoder=patches", "encoder_size=16", "encoder_frozen=false")
    model += ("decoder=cloud",)
    options = {"views": {"sampler": "hard_first"}, "optim": {"schedule": "linear"}}
    out = tmp_path / "run"
    assert run(data, out, model, run=with_it, **options) == 0
    assert open_dataset(data).layout == "orbit"
    first, *_, last = lines(out, "train")
    assert first["loss_edges"] > 0
    terms = sum(first[f"loss_{name}"] for name in ("rgb", "mask")) + 0.5 * first["loss_edges"]
    assert first["loss"] == pytest.approx(terms + 0.1 * first["loss_rdist"], rel=1e-4)
    # A warm-up of a tenth of six steps, then the line: the rate of the last step is 5/6 of it down.
    assert last["lr"] == pytest.approx(1e-3 * (1 - (5 - 0.6) / (6 - 0.6)), rel=1e-4)
    assert 0 < lines(out, "val")[0]["mae_novel"] < 1
    (record,) = json.loads((out / "config.json").read_text())["plugins"]
    assert record["name"] == "plugin" and record["options"] == {"edges": 0.5}
    assert len(record["sha256"]) == 64
    # The same run goes on with the same plugin; --config gives it with its options.
    assert run(data, out, model, run=with_it, length={"steps": 7}, **options) == 0
    got = load_model(out / "model.safetensors")
    assert type(got.decoder).__name__ == "Cloud" and got.encoder is not None
    plugins.unload()
    line = refused("needs the plugin 'plugin' .SHA-256", load_model, out / "model.safetensors")
    assert line.endswith("give --plugin plugin.py")
    words = ["--checkpoint", out / "model.safetensors", "--data", data, "--no-baselines"]
    words += ["--no-lpips", "--split", "val", "--plugin", plugin, "edges=0.5", "--json"]
    capsys.readouterr()
    assert cli.run("eval-views", [*map(str, words)]) == 0
    assert "mae" in json.loads(capsys.readouterr().out)["objects"][0]
    # Another text: the model loads with a warning, the run is another one.
    plugins.unload()
    plugin.write_text(plugin.read_text() + "# changed\n")
    plugins.load(with_it["plugin"])
    with pytest.warns(FileWarning, match="another text or other options of a plugin"):
        load_model(out / "model.safetensors")
    refused("belongs to another run: plugins", run, data, out, model, run=with_it, **options)
    assert list_checkpoints(out)


BAD = {
    "import no_such_module\n": "ModuleNotFoundError: No module named 'no_such_module'",
    "def register(plugin: (:\n": "SyntaxError",
    "x = 1\n": "has no function register",
    "def register(plugin):\n    plugin.loss_term('rgb', None, 1)\n": "already a loss term 'rgb'",
    "def register(plugin):\n    plugin.decoder('rays', None)\n": "already a decoder 'rays'",
    "def register(plugin):\n    plugin.sampler('a b', None)\n": "not a name of letters",
    "def register(plugin):\n    plugin.sampler('x', None)\n    1 / 0\n": "ZeroDivisionError",
    "def register(plugin, size):\n    pass\n": "TypeError",
}


@pytest.mark.parametrize("text", BAD)
def test_a_bad_plugin_is_one_line_and_adds_nothing(data, tmp_path, text):
    path = tmp_path / "bad.py"
    path.write_text(text)
    refused(f"--plugin .*bad.py: .*{BAD[text]}", micro.options, data, tmp_path / "run",
            run={"plugin": (str(path),)})  # fmt: skip
    assert not plugins.added("sampler") and not (tmp_path / "run").exists()


def test_what_is_not_a_plugin(data, tmp_path):
    refused("--plugin none.py: ", plugins.load, ["none.py"])
    refused("neither a .py file nor an installed plugin", plugins.load, ["unknown"])
    refused("an option before any plugin", plugins.load, ["x=1"])
    refused("scheduler 'linear': expected one of cosine, trapezoid", micro.options, data, tmp_path,
            optim={"schedule": "linear"})  # fmt: skip
    refused("sampler 'x'", micro.options, data, tmp_path, views={"sampler": "x"})


def test_an_order_that_is_none_is_refused(data, tmp_path):
    path = tmp_path / "orders.py"
    path.write_text("def register(plugin):\n    plugin.sampler('far', lambda rng, uids: [9, 9])\n")
    marks = tmp_path / "layout.py"
    shutil.copy(EXAMPLE, marks)
    options = {"views": {"sampler": "far"}, "run": {"plugin": (str(path), str(marks))}}
    plugins.load(options["run"]["plugin"])
    refused("--sampler far: expected 2 positions", run, data, tmp_path / "run", **options)


def test_rates_by_name_other_optimizers_and_partial_weights(tmp_path):
    data = micro.write_dataset(tmp_path / "set", 3)
    options = {"lr_of": ("blocks=0", "blocks.0.norm=1", "decoder=0.1"), "optimizer": "SGD"}
    options |= {"optimizer_options": ("momentum=0.9",), "weight_decay": 0.0, "ema": 0.0}
    out = tmp_path / "run"
    assert run(data, out, optim=options, run={"save_every": 1, "keep": 9}) == 0
    first, *_, last = (load_model(p / "model.safetensors") for p in list_checkpoints(out))
    moved = {
        name: not torch.equal(a, b)
        for (name, a), b in zip(first.named_parameters(), last.parameters())
    }
    assert {n for n, m in moved.items() if n.startswith("blocks.") and m} <= {
        "blocks.0.norm.weight", "blocks.0.norm.bias"}  # fmt: skip
    assert any(m for n, m in moved.items() if n.startswith("decoder"))
    # Momentum is kept: a run that goes on has the bits of one that was not cut.
    cut = tmp_path / "cut"
    shutil.copytree(out, cut)
    for checkpoint in list_checkpoints(cut)[3:]:
        shutil.rmtree(checkpoint)
    assert run(data, cut, optim=options) == 0
    assert micro.same_weights(cut / "model.safetensors", out / "model.safetensors")
    for lr_of, words in (("nothing=1", "no such parameter; there are"), ("blocks", "expected NAME"),
                         ("blocks=-1", "FACTOR from 0")):  # fmt: skip
        refused(words, run, data, tmp_path / "x", optim={"lr_of": (lr_of,)})
    refused("not one of torch.optim", run, data, tmp_path / "x", optim={"optimizer": "os"})
    bad = {"optimizer": "SGD", "optimizer_options": ("speed=1",)}
    refused("--optimizer SGD: .*speed", run, data, tmp_path / "x", optim=bad)

    wider = tuple(change.replace("depth=1", "depth=2") for change in micro.MODEL)
    wider = tuple(change.replace("state_size=4", "state_size=8") for change in wider)
    still = {"lr": 1e-30, "weight_decay": 0.0, "ema": 0.0}
    partial = {"init_partial": out / "model.safetensors", "val_every": 100}
    wide = tmp_path / "wide"
    assert run(data, wide, wider, run=partial, optim=still, length={"steps": 1}) == 0
    named = json.loads((wide / "init.json").read_text())
    assert "decoder.mlp.0.weight" in named["taken"] or named["taken"]
    assert "blocks.0.mamba.A_log" in named["other shape"] and not named["not in the model"]
    assert any(name.startswith("blocks.1.") for name in named["not in the file"])
    got, source = load_model(wide / "model.safetensors"), load_model(out / "model.safetensors")
    theirs = source.state_dict()
    assert all(torch.equal(got.state_dict()[name], theirs[name]) for name in named["taken"])
    assert [line["step"] for line in lines(wide, "val")] == [0, 1]


def test_the_best_by_a_metric_of_a_plugin(tmp_path):
    """The error falls, and less is better, so the last validation is the best."""
    data = micro.write_dataset(tmp_path / "clouds", 3)
    with_it = {"best_by": "mae", "val_every": 2}
    refused("image metric 'mae': expected one of psnr", run, data, tmp_path / "no", run=with_it)
    with_it["plugin"] = (str(EXAMPLE),)
    assert run(data, tmp_path / "run", run=with_it) == 0
    errors = [line["mae_novel"] for line in lines(tmp_path / "run", "val")]
    best = [line["mae"] for line in lines(tmp_path / "run", "best")]
    assert best[-1] == min(errors) and best == sorted(best, reverse=True)
    assert json.loads((tmp_path / "run" / "config.json").read_text())["run"]["best_by"] == "mae"


def installed(folder, name, text):
    """Write a distribution with an entry point ``name`` of its module ``NAME_module``."""
    info = folder / f"{name}-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    group = f"[{plugins.GROUP}]\n{name} = {name}_module\n"
    (info / "entry_points.txt").write_text(group)
    (folder / f"{name}_module.py").write_text(text)


def test_an_installed_plugin_is_loaded_by_its_name(tmp_path, monkeypatch):
    text = "def register(plugin, by=1):\n    plugin.scheduler('steady', lambda done: 1.0 / by)\n"
    installed(tmp_path / "site", "steadily", text)
    refused("--plugin steadily: neither a .py file nor an installed", plugins.load, ["steadily"])
    monkeypatch.syspath_prepend(str(tmp_path / "site"))
    (record,) = plugins.load(["steadily", "by=2"])
    assert record["name"] == "steadily" and record["options"] == {"by": 2}
    assert plugins.added("scheduler")["steady"](0.5) == 0.5
    content = (tmp_path / "site" / "steadily_module.py").read_bytes()
    assert record["sha256"] == hashlib.sha256(content).hexdigest()
    plugins.unload()
    assert "steady" not in plugins.added("scheduler")


def test_an_installed_plugin_that_fails_is_one_line(tmp_path, monkeypatch):
    installed(tmp_path, "failing", "raise OSError('no such table')\n")
    installed(tmp_path, "silent", "x = 1\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    refused("--plugin failing: OSError: no such table", plugins.load, ["failing"])
    refused("--plugin silent: has no function register", plugins.load, ["silent"])
