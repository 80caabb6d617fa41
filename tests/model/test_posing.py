"""Conversion of a dataset's view to a model's posed input."""

from dataclasses import replace

import pytest
import torch
from helpers.gaussians import some
from helpers.micro import write_dataset
from helpers.model import SMALLEST

from gamba_warp.cameras import intrinsics, reference_viewmat
from gamba_warp.data.dataset import open_dataset
from gamba_warp.errors import UserError
from gamba_warp.eval.views.compare import ViewsProtocol, load_gt
from gamba_warp.eval.views.options import ViewsOptions
from gamba_warp.eval.views.predictions import ModelPredictions, open_predictions
from gamba_warp.formats.ply import save_ply
from gamba_warp.model.checkpoint import save_model
from gamba_warp.model.gamba import Gamba
from gamba_warp.model.posing import posed_input, reference_cameras, relative_cameras
from gamba_warp.train.batches import load_sample

CONFIG = replace(SMALLEST, distance=1.7, fov=40.0, background="black")


@pytest.fixture
def dataset(tmp_path):
    return open_dataset(write_dataset(tmp_path / "data", objects=1), "all")


def test_reference_cameras():
    cameras = reference_cameras(CONFIG, 3)
    assert cameras.viewmats.shape == (3, 4, 4) and cameras.Ks.shape == (3, 3, 3)
    assert (cameras.width, cameras.height) == (16, 16)
    assert torch.equal(cameras.viewmats[2], reference_viewmat(1.7))
    assert torch.equal(cameras.Ks[1], intrinsics(16, 16, 40.0))


def test_the_first_camera_becomes_the_reference(dataset):
    views = dataset.load(dataset.uids[0], views=[2, 0, 5])
    cameras = relative_cameras(views.cameras, 1.7)
    # the dataset's cameras look at the origin; float32 rotations
    torch.testing.assert_close(cameras.viewmats[0], reference_viewmat(1.7), atol=1e-5, rtol=0)
    centres = -(cameras.viewmats[:, :3, :3].mT @ cameras.viewmats[:, :3, 3:])[..., 0]
    before = views.cameras.viewmats
    old = -(before[:, :3, :3].mT @ before[:, :3, 3:])[..., 0]
    scale = 1.7 / before[0, :3, 3].norm()
    torch.testing.assert_close(centres, scale * old @ before[0, :3, :3].mT, atol=1e-5, rtol=0)
    assert torch.equal(cameras.Ks, views.cameras.Ks) and cameras.width == views.cameras.width


def test_the_input_lies_on_the_model_s_background(dataset):
    views = dataset.load(dataset.uids[0], views=[1, 3], size=16)
    images, cameras = posed_input(views, CONFIG)
    assert images.shape == (1, 16, 16, 3) and cameras.viewmats.shape == (1, 4, 4)
    empty = views.images[0, ..., 3] == 0
    assert empty.any() and (images[0][empty] == 0).all()


def test_training_and_evaluation_see_the_same_input(dataset, tmp_path, monkeypatch):
    """Bit-identical, for any other views and any size of the target images."""
    uid = dataset.uids[0]
    want = posed_input(dataset.load(uid, views=[4], size=16), CONFIG)
    for size in (16, 24):
        batch = load_sample(dataset, 0, [4, 1, 2], size, CONFIG, torch.ones(3))
        assert torch.equal(batch.inputs, want[0])
        assert torch.equal(batch.input_cameras.viewmats, want[1].viewmats)
        assert torch.equal(batch.input_cameras.Ks, want[1].Ks)

    (tmp_path / "model").mkdir()
    save_model(tmp_path / "model" / "model.safetensors", Gamba(CONFIG))
    options = ViewsOptions(checkpoint=tmp_path / "model", data=tmp_path)
    predictions = ModelPredictions(options, "cpu")
    seen = []
    run = predictions.model.forward

    def noted(*inputs, **options):
        seen.append(inputs)
        return run(*inputs, **options)

    monkeypatch.setattr(predictions.model, "forward", noted)
    predictions.gaussians(dataset, uid, 4)
    assert torch.equal(seen[0][0], want[0]) and torch.equal(seen[0][1].Ks, want[1].Ks)
    assert torch.equal(seen[0][1].viewmats, want[1].viewmats)

    protocol = ViewsProtocol("all", 4, None, None, None, None, predictions.distance)
    gt = load_gt(dataset, uid, protocol, "cpu")
    assert torch.equal(gt.cameras.viewmats[:1], want[1].viewmats)


def test_an_evaluation_states_the_precision_of_its_model(dataset, tmp_path):
    model = tmp_path / "model.safetensors"
    save_model(model, Gamba(CONFIG))
    uid, made = dataset.uids[0], {}
    for precision in ("float32", "bfloat16"):
        options = ViewsOptions(checkpoint=model, data=tmp_path, precision=precision)
        predictions = open_predictions(options, "cpu")
        made[precision] = predictions.gaussians(dataset, uid, 4).means
        said = predictions.source.get("precision")
        assert said == (None if precision == "float32" else precision)
    assert 0 < (made["bfloat16"] - made["float32"]).abs().max() < 0.02
    (tmp_path / "plys").mkdir()
    save_ply(tmp_path / "plys" / "a.ply", some(3))
    with pytest.raises(UserError, match="--precision: .*plys holds no model"):
        open_predictions(replace(options, checkpoint=tmp_path / "plys"), "cpu")
