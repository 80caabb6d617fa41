"""Resumed runs with changed options (``--override``) or another split of a step's objects."""

import shutil

import pytest
from helpers import micro
from helpers.micro import lines, run, same_weights
from helpers.refusals import refused

from gamba_warp.train.checkpoint import list_checkpoints, read_state
from gamba_warp.train.config import GROUPS
from gamba_warp.train.run import train

FIVE = {"views": {"batch_size": 2}, "length": {"steps": None, "epochs": 5}}


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """Four clouds to train on and a held-out one."""
    return micro.write_dataset(tmp_path_factory.mktemp("data") / "clouds", 5)


@pytest.fixture(scope="module")
def begun(data, tmp_path_factory):
    """A run of five epochs, two steps each, with a checkpoint at every second step."""
    out = tmp_path_factory.mktemp("runs") / "begun"
    assert run(data, out, run={"save_every": 2, "keep": 9}, **FIVE) == 0
    return out


def resumed(begun, out, step):
    """A copy of the run, cut after ``step``; returns its checkpoint."""
    shutil.copytree(begun, out)
    for checkpoint in list_checkpoints(out):
        if not checkpoint.name.endswith(f"{step:06d}"):
            shutil.rmtree(checkpoint)
    (out / "log.jsonl").unlink()
    return list_checkpoints(out)[0]


def test_the_moments_stay_and_the_rate_changes(data, begun, tmp_path):
    checkpoint = resumed(begun, tmp_path / "run", 4)
    before = read_state(checkpoint)["optimizer"]["state"]
    # So small a rate leaves the weights alone; the second moment is b2 * m + (1 - b2) * g².
    changed = ("lr=1e-30,beta2=0.5",)
    assert run(data, tmp_path / "run", run={"override": changed, "save_every": 1, "keep": 9},
               **FIVE) == 0  # fmt: skip
    after = read_state(list_checkpoints(tmp_path / "run")[1])["optimizer"]["state"]
    for index, entry in before.items():
        assert int(after[index]["step"]) == 5
        assert (after[index]["exp_avg_sq"] >= 0.49 * entry["exp_avg_sq"]).all()
    noted = [line["message"] for line in lines(tmp_path / "run", "warning")]
    assert noted == [
        "--override: optim.beta2 (0.95 there, 0.5 here)",
        "--override: optim.lr (0.001 there, 1e-30 here)",
    ]
    share = lines(tmp_path / "run", "train")[0]["lr"] / 1e-30
    assert share == pytest.approx(lines(begun, "train")[4]["lr"] / 1e-3, rel=1e-4)
    # The same command goes on; without the override the options differ.
    again = {"override": changed, "save_every": 1, "keep": 9}
    assert run(data, tmp_path / "run", run=again, **FIVE) == 0
    refused(r"optim\.lr \(1e-30 there, 0\.001 here\)", run, data, tmp_path / "run", **FIVE)


def test_another_batch_goes_on_at_the_next_sample(data, begun, tmp_path, monkeypatch):
    """Four steps of 2 are 8 of 20 samples; the 12 others are 3 steps of 4, in the old order."""
    from gamba_warp.train import batches

    taken = []
    object_of = batches.Batches._object
    monkeypatch.setattr(
        batches.Batches, "_object", lambda self, n: (taken.append(n), object_of(self, n))[1]
    )
    resumed(begun, tmp_path / "run", 4)
    changed = {"override": ("batch_size=4",), "save_every": 1, "keep": 9}
    assert run(data, tmp_path / "run", run=changed, **FIVE) == 0
    assert sorted(taken) == list(range(8, 20))
    assert [line["step"] for line in lines(tmp_path / "run", "train")] == [5, 6, 7]
    assert [line["epoch"] for line in lines(tmp_path / "run", "train")] == [3, 4, 5]
    (_, note) = [line["message"] for line in lines(tmp_path / "run", "warning")]
    assert note.startswith("the run's length is now 7 steps, not 10 steps")
    # A later resumption knows where the samples began.
    taken.clear()
    shutil.rmtree(list_checkpoints(tmp_path / "run")[-1])
    (tmp_path / "run" / "log.jsonl").unlink()
    assert run(data, tmp_path / "run", run=changed, **FIVE) == 0
    assert sorted(taken) == list(range(16, 20)) and not lines(tmp_path / "run", "warning")


def test_the_same_objects_a_step_may_be_split_otherwise(data, begun, tmp_path):
    resumed(begun, tmp_path / "run", 4)
    halves = {"views": {"batch_size": 1, "accumulate": 2}, "length": {"steps": None, "epochs": 5}}
    assert run(data, tmp_path / "run", **halves) == 0
    assert not lines(tmp_path / "run", "warning")
    a, b = (lines(out, "train")[-1] for out in (begun, tmp_path / "run"))
    assert a["step"] == b["step"] == 10
    # Sums in another order: the log's six digits, after six steps of Adam (tests/nodes).
    assert b["grad_norm"] == pytest.approx(a["grad_norm"], rel=1e-3)
    four = {"views": {"batch_size": 4}, "length": {"steps": None, "epochs": 5}}
    words = r"objects a step \(2 there, 4 here: --batch-size 2 keeps it, --override batch_size=4"
    refused(words, run, data, tmp_path / "run", **four)


@pytest.mark.parametrize(
    "change, words",
    [
        ("seed=3", "--override seed=3: a resumed run cannot change it, only batch_size, acc"),
        ("depth=2", "--override depth=2: a resumed run cannot change it"),
        ("lr", "--override lr: a resumed run cannot change it"),
        ("lr=fast", "--override: lr: Expected `float`"),
        ("lr=100", "--override: lr: Expected `float` <= 10.0"),
        ("ema=0", r"optim\.ema \(0\.999 there, 0\.0 here\)"),
        ("extra=there", "--override extra=there: a resumed run cannot"),
    ],
)
def test_what_cannot_change_is_refused_and_nothing_lost(data, begun, tmp_path, change, words):
    before = {p: p.read_bytes() for p in begun.rglob("*") if p.is_file() and p.name != ".lock"}
    refused(words, run, data, begun, run={"override": (change,)}, **FIVE)
    assert before == {p: p.read_bytes() for p in before}
    refused("--override: .* has no checkpoint", run, data, tmp_path / "x",
            run={"override": ("lr=1e-4",)}, **FIVE)  # fmt: skip
    assert not (tmp_path / "x").exists()


def test_every_option_that_may_change_has_one_group():
    from gamba_warp.train.config import _OVERRIDABLE

    for name, full in _OVERRIDABLE.items():
        groups = [g for g in ("views", "loss", "optim") if name in GROUPS[g].__dataclass_fields__]
        assert groups == [full.split(".")[0]]


def test_an_override_of_nothing_keeps_the_bits(data, begun, tmp_path):
    resumed(begun, tmp_path / "run", 4)
    assert run(data, tmp_path / "run", run={"override": ("lr=1e-3",)}, **FIVE) == 0
    assert not lines(tmp_path / "run", "warning")
    assert same_weights(tmp_path / "run" / "model.safetensors", begun / "model.safetensors")


def test_made_objects_keep_their_batches(data, tmp_path):
    made = micro.options(data, tmp_path, views={"made": 0.5}, run={"override": ("batch_size=1",)})
    refused("--override batch_size: a run with --made cannot", train, made, micro.ALONE)
