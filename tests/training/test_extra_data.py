"""Training objects from several datasets, and inputs from the front."""

import json
from dataclasses import replace

import numpy as np
import pytest
from helpers import micro
from helpers.refusals import refused

from gamba_warp.data.dataset import open_dataset
from gamba_warp.train.batches import Batches, open_data
from gamba_warp.train.data.poses import front_views


@pytest.fixture
def roots(tmp_path):
    """Two datasets with objects of the same names: 3 to train on, and 2."""
    for name, objects in (("first", 4), ("second", 3)):
        micro.write_dataset(tmp_path / name, objects)
    return tmp_path / "first", tmp_path / "second"


def test_the_training_objects_of_all_sets_are_trained_on(roots, tmp_path):
    first, second = roots
    data = open_data(micro.options(first, tmp_path, views={"extra": (second,)}))
    assert data.train.uids == ["clouda", "cloudb", "cloudc", "second/clouda", "second/cloudb"]
    assert data.objects == [0, 1, 2, 3, 4]
    assert data.held_out.dataset.uids == ["cloudd"]  # of the first set alone
    alone = open_dataset(second).load("cloudb")
    assert data.train.load(4).images.equal(alone.images)
    assert data.train.load(4).uid == "second/cloudb"
    assert data.fingerprint != open_data(micro.options(first, tmp_path)).fingerprint


def test_a_set_of_another_layout_is_read_by_its_own_rules(roots, tmp_path):
    first, _ = roots
    other = tmp_path / "third" / "some"
    (other / "rgba").mkdir(parents=True)
    (other / "pose").mkdir()
    source = first / "clouda"
    for number, frame in enumerate(json.loads((source / "transforms.json").read_text())["frames"]):
        (source / frame["file_path"]).rename(other / "rgba" / f"{number:03d}.png")
        pose = np.array(frame["transform_matrix"])[:3]
        np.save(other / "pose" / f"{number:03d}.npy", pose)
    side = micro.SIZE
    np.save(other / "intrinsics.npy", np.array([[side, side], [side / 2, side / 2], [side, side]]))
    joined = open_dataset(roots[1], "train").joined("third", open_dataset(tmp_path / "third"))
    assert joined.uids[-1] == "third/some" and joined.check() == {}
    assert joined.load("third/some").images.shape == (micro.VIEWS, side, side, 4)


def test_the_objects_of_a_set_named_twice_come_twice_in_an_epoch(roots, tmp_path):
    first, second = roots
    config = micro.options(first, tmp_path, views={"extra": (second, second, first)})
    data = open_data(config)
    assert data.objects == [0, 1, 2, 3, 4, 3, 4, 0, 1, 2]
    batches = Batches(data, config, micro.ALONE)
    epochs = [[batches._object(10 * epoch + n) for n in range(10)] for epoch in range(9)]
    assert all(sorted(epoch) == sorted(data.objects) for epoch in epochs)
    assert len({tuple(epoch) for epoch in epochs}) == 9
    assert data.fingerprint != open_data(micro.options(first, tmp_path)).fingerprint


def test_two_sets_of_one_name_are_refused(roots, tmp_path):
    other = micro.write_dataset(tmp_path / "other" / "second", 3)
    config = micro.options(roots[0], tmp_path, views={"extra": (roots[1], other)})
    refused("two objects are called 'second/clouda'", open_data, config)


@pytest.mark.parametrize("fraction", [0.0, 1.0])
def test_inputs_are_from_the_front_as_often_as_told(roots, tmp_path, fraction):
    options = micro.options(roots[0], tmp_path, views={"front_fraction": fraction, "batch_size": 1})
    data = replace(open_data(options), objects=[0])
    dataset = data.train
    poses = dataset.files(0).camera_to_world
    assert 0 < len(front_views(poses)) < micro.VIEWS
    source = Batches(data, options, micro.ALONE, lambda number: 1)
    views = dataset.load(0)
    seen = set()
    for number in range(40):
        target = micro.take(source, number).targets[0, 0]
        seen |= {v for v in range(micro.VIEWS) if views.images[v].equal(target)}
    assert seen == (set(front_views(poses)) if fraction else set(range(micro.VIEWS)))


@pytest.mark.parametrize("crop", [8, 17])
def test_crops_that_lpips_cannot_see_or_no_image_has_are_refused(roots, tmp_path, crop):
    said = f"--lpips-crop {crop}: must be 0, or 16 to --size 16"
    refused(said, micro.options, roots[0], tmp_path, loss={"lpips_crop": crop})


def test_google_scanned_objects_are_refused_wherever_they_come_from(roots, tmp_path):
    """They are for evaluation. One of the second dataset is for training, one for validation."""
    first, second = roots
    for old, new in (("clouda", "Dino_4"), ("cloudc", "Elephant")):
        (second / old).rename(second / new)
    micro.write_split(second, train=["Dino_4", "cloudb"], val=["Elephant"])
    out = tmp_path / "run"
    for data, views, names in (
        (second, {}, "Dino_4, Elephant"),
        (first, {"extra": (second,)}, "second/Dino_4"),
    ):
        line = f"the data has Google Scanned Objects.*\\({names}\\): leave them out"
        refused(line, micro.run, data, out, views=views)
    assert not out.exists()
