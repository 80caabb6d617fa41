"""Unreadable objects are counted, named and skipped; too many of them end the run."""

import pytest
from helpers import micro
from helpers.micro import ALONE, lines, take
from helpers.refusals import refused

from gamba_warp.train import batches
from gamba_warp.train.batches import Batches, FixedObjects, fixed_batches, open_data
from gamba_warp.train.loop import train


@pytest.fixture
def root(tmp_path):
    """Six objects to train on, and one to validate on."""
    return micro.write_dataset(tmp_path / "clouds", objects=7)


def spoil(root, *names):
    for name in names:
        for path in (root / f"cloud{name}").glob("*.png"):
            path.write_bytes(b"not an image")


def source_of(root):
    views = {"background": "white", "batch_size": 1}
    config = micro.options(root, root, views=views)
    return Batches(open_data(config), config, ALONE)


def test_objects_that_go_bad_during_a_run_are_passed_over(root):
    source = source_of(root)
    before = [take(source, n).uids[0] for n in range(6)]
    assert len(set(before)) == 6 and not source.failures
    spoil(root, "a", "b", "c")
    after = [take(source, n).uids[0] for n in range(12)]
    assert set(after) == {"cloudd", "cloude", "cloudf"}
    assert set(source.failures) == {"clouda", "cloudb", "cloudc"}
    assert "not an image" in source.failures["clouda"]
    again = source_of(root)  # a resumed run draws the same batches
    assert [take(again, n).uids[0] for n in range(12)] == after


def test_more_than_half_of_the_objects_end_the_run(root):
    source = source_of(root)
    spoil(root, "a", "b", "c", "d")
    line = r"^4 of 6 objects cannot be read; the last: .*\.png: not"
    refused(line, lambda: [take(source, number) for number in range(12)])


def test_too_many_in_a_row_end_the_run(root, monkeypatch):
    source = source_of(root)
    spoil(root, "a", "b", "c")
    monkeypatch.setattr(batches, "_TRIES", 2)
    line = "^2 objects in a row cannot be read; the last: "
    refused(line, lambda: [take(source, number) for number in range(30)])


@pytest.mark.parametrize("error", [MemoryError(), OSError(5, "I/O error"), RuntimeError("a\nb")])
def test_whatever_one_object_raises_stops_no_other(root, monkeypatch, error):
    source, real = source_of(root), batches.load_sample

    def load(dataset, index, *rest):
        if index == 0:
            raise error
        return real(dataset, index, *rest)

    monkeypatch.setattr(batches, "load_sample", load)
    assert {take(source, n).uids[0] for n in range(6)} == {f"cloud{c}" for c in "bcdef"}
    assert len(source.failures["clouda"].splitlines()) == 1


def test_a_validation_passes_over_what_it_cannot_read(root):
    config, failures = micro.options(root, root), {}
    part = FixedObjects(open_data(config).train, [0, 1, 2])
    spoil(root, "b")
    found = fixed_batches(part, config.model_config(), micro.SIZE, failures)
    assert [batch.uids for batch in found] == [["clouda"], ["cloudc"]]
    assert list(failures) == ["cloudb"]


def test_a_run_names_bad_objects_when_it_meets_them(root, tmp_path, capsys):
    spoil(root, "a", "g")  # g is the one to validate on
    (root / "cloudb" / "001.png").unlink()
    config = micro.options(root, tmp_path / "run", run={"val_every": 3, "save_every": 3})
    assert train(config, ALONE) == 1
    said = [record["message"] for record in lines(tmp_path / "run", "warning")]
    for known in ("clouda is skipped", "cloudg is skipped", "cloudb is left out"):
        assert sum(known in line for line in said) == 1
    assert sum("no validation" in line for line in said) == 2
    end = lines(tmp_path / "run", "end")[0]
    assert end["step"] == 6 and set(end["failures"]) == {"clouda", "cloudg"}
    assert "could not read clouda" in capsys.readouterr().err
    assert (tmp_path / "run" / "model.safetensors").exists()
