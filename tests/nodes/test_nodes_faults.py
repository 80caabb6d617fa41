"""Several processes that differ, share no disk, or find it full: none of them hangs."""

import json
import re
import shutil

import pytest
from helpers import micro
from helpers.forked import python
from helpers.micro import lines, same_weights
from helpers.nodes.processes import run_all, train_all, words

from gamba_warp import versions
from gamba_warp.files import PART
from gamba_warp.train.checkpoint import damage, list_checkpoints

FULL = 20_000  # bytes: enough for the log, not for a checkpoint
FIVE = ("--views-per-object", 5)  # all of them, at every step
pytestmark = pytest.mark.slow  # a process takes seconds to


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return micro.write_dataset(tmp_path_factory.mktemp("data") / "clouds", 4)


@pytest.fixture(scope="module")
def ends(data, tmp_path_factory):
    """Results of two processes for a series of runs, by name: exit codes and lines by rank."""
    root = tmp_path_factory.mktemp("nodes")
    (root / "empty").mkdir()
    later = root / "later" / "checkpoints" / "step_000009"
    later.mkdir(parents=True)
    spoilt = root / "clouds"
    shutil.copytree(data, spoilt)
    image = spoilt / "cloudb" / "003.png"  # the second process's alone; sizes are compared
    image.write_bytes(b"no image".ljust(image.stat().st_size))
    plan = []

    def step(name, out, steps, *, data=(data, data), outs=None, limits=(None, None), more=()):
        pairs = zip(data, outs or (root / out, root / out))
        own = [words(d, o, "--steps", steps, "--save-every", 3, *more) for d, o in pairs]
        plan.append([name, own, limits])

    def begin(name):
        third = "checkpoints/step_000003"
        plan.append(["copy", f"{root}/undisturbed/{third}", f"{root}/{name}/{third}"])

    step("missing", "missing", 2, data=(data, root / "none"))
    step("undisturbed", "undisturbed", 6)
    begin("run")
    step("full", "run", 6, limits=(FULL, None))
    plan.append(["copy", f"{root}/run", f"{root}/left"])
    step("goes on", "run", 6)
    begin("far")
    far = (root / "far", root / "elsewhere")
    step("copied", "far", 6, outs=far)
    step("newer", "far", 7, outs=(root / "far", root / "later"))
    step("spoilt", "spoilt", 6, data=(data, spoilt), more=FIVE)
    (root / "plan.json").write_text(json.dumps(plan))
    command = [python(), "-m", "helpers.nodes.worker", root / "plan.json", root / "end"]
    done = run_all([[*map(str, command)]] * 2)
    assert [end.returncode for end in done] == [0, 0], done
    found = [json.loads((root / f"end{rank}").read_text()) for rank in (0, 1)]
    return root, {name: [own[name] for own in found] for name in found[0]}


def test_a_folder_that_one_process_lacks_ends_all(ends):
    root, found = ends
    reason = f"{root / 'none'}: no such folder"
    (main, other) = found["missing"]
    assert other == [2, reason]
    assert main[0] == 2 and main[1].startswith("process 1 on ") and main[1].endswith(reason)
    assert not (root / "missing").exists()


def test_a_full_disk_in_the_middle_of_a_checkpoint_ends_all(ends):
    root, found = ends
    (main, other) = found["full"]
    assert main[0] == 2 and "cannot write" in main[1] and "run/checkpoints" in main[1]
    assert other[0] == 2 and other[1].startswith("process 0 on ") and other[1].endswith(main[1])
    (kept,) = list_checkpoints(root / "left")
    assert damage(kept) is None and kept.name == "step_000003"
    assert not [path for path in (root / "left").rglob(f"{PART}*")]
    assert found["goes on"] == [[0, ""], [0, ""]]
    assert same_weights(root / "run/model.safetensors", root / "undisturbed/model.safetensors")


def test_processes_without_a_common_disk_get_the_checkpoint_sent(ends):
    root, found = ends
    assert found["copied"] == [[0, ""], [0, ""]]
    assert same_weights(root / "far/model.safetensors", root / "undisturbed/model.safetensors")
    assert lines(root / "far", "start")[-1]["resumed_from"].endswith("far/checkpoints/step_000003")
    assert not (root / "elsewhere").exists()


def test_a_newer_checkpoint_elsewhere_is_not_thrown_away(ends):
    root, found = ends
    (main, other) = found["newer"]
    assert main == other and main[0] == 2
    assert main[1].startswith("process 1 on ")
    assert f"sees {root}/later/checkpoints/step_000009, process 0 on" in main[1]


def test_images_that_only_another_process_cannot_read_are_named(ends):
    root, found = ends
    assert found["spoilt"] == [[1, ""], [1, ""]]
    (end,) = lines(root / "spoilt", "end")
    assert list(end["failures"]) == ["cloudb"]


def test_processes_that_differ_are_refused_with_the_difference(data, tmp_path):
    """Options, data, versions of the package and of a library, in one line on each."""
    other = tmp_path / "clouds"
    shutil.copytree(data, other)
    shutil.copy(other / "cloudb" / "001.png", other / "cloudb" / "000.png")
    patch = (
        "import gamba_warp.train.run as r\n"
        "a, r.__version__ = r.installed, '9.8'\n"
        "r.installed = lambda *names: {**a(*names), 'torch': '9.9'}\n"
    )
    arguments = [words(folder, tmp_path / "out", "--steps", 2) for folder in (data, other)]
    ends = train_all([arguments[0], [*arguments[1], "--lr", "0.01"]], {1: patch})
    assert [end.returncode for end in ends] == [2, 2] and not (tmp_path / "out").exists()
    assert ends[0].stderr == ends[1].stderr and ends[0].stderr.count("\n") == 1, ends
    line = ends[0].stderr
    for part in (
        "gamba: process 1 on",
        "options: optim.lr is 0.01, not 0.001;",
        f"versions: gamba-warp is 9.8, not {versions.__version__},",
        f"torch is 9.9, not {versions.installed('torch')['torch']}",
    ):
        assert part in line, line
    assert re.search(r"data: cloudb is [0-9a-f]{16}, not [0-9a-f]{16};", line), line
    for word in ("run.out", "clouda", "numpy"):
        assert word not in line
