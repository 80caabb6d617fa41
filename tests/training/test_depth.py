"""Depth as a target: the renderer's depth files, the loss, and training."""

import json
import shutil

import numpy as np
import pytest
import torch
import trimesh
from helpers import micro
from helpers.meshes import render_views
from helpers.micro import lines, run
from helpers.refusals import refused

from gamba_warp.cameras import Cameras, intrinsics, orbit
from gamba_warp.data.dataset import open_dataset
from gamba_warp.gaussians import Gaussians
from gamba_warp.train.batches import load_sample
from gamba_warp.train.data.samples import Change
from gamba_warp.train.objective.losses import DEPTH_BETA, SLOPE_STEPS, SLOPE_WEIGHT, depth_loss

SIDES = (1.0, 0.4, 0.6)
RAYS = (*micro.MODEL, "decoder=rays", "ray_cells=2", "ray_layers=3", "ray_features=8")


@pytest.fixture(scope="module")
def boxes(tmp_path_factory):
    """Two boxes of one size in five views of 16², with their depths; one is held out."""
    root = tmp_path_factory.mktemp("boxes")
    (root / "meshes").mkdir()
    for name in ("a", "b"):
        trimesh.creation.box(extents=SIDES).export(root / "meshes" / f"{name}.ply")
    render_views(root / "meshes", root / "data", views=5, size=16, depth=True, workers=1)
    micro.write_split(root / "data", train=["a"], val=["b"])
    return root / "data"


def through_the_box(cameras):
    """Depths at which the rays of the pixels' centres enter and leave the box; nan if they miss."""
    size = cameras.width
    x = torch.arange(size, dtype=torch.float64) + 0.5
    column, row = torch.meshgrid(x, x, indexing="xy")
    pixels = torch.stack([column, row, torch.ones_like(row)], -1)
    found = []
    for viewmat, K in zip(cameras.viewmats.double(), cameras.Ks.double()):
        d = (pixels @ torch.linalg.inv(K).T) @ viewmat[:3, :3]
        origin = -viewmat[:3, :3].T @ viewmat[:3, 3]
        walls = torch.stack([(sign * torch.tensor(SIDES) / 2 - origin) / d for sign in (-1, 1)])
        enter, leave = walls.amin(0).amax(-1), walls.amax(0).amin(-1)
        missed = torch.full_like(enter, torch.nan)
        found.append(torch.stack([torch.where(enter < leave, t, missed) for t in (enter, leave)]))
    return torch.stack(found)


def test_the_renderer_writes_the_first_and_the_last_surface(boxes):
    views = open_dataset(boxes).load("a")
    want = through_the_box(views.cameras)
    for number, depths in enumerate((views.depths, views.backs)):
        hit, true = depths > 0, want[:, number]
        assert (hit == ~true.isnan()).float().mean() > 0.995  # an edge may fall to either side
        both = hit & ~true.isnan()
        assert both.sum() > 100
        # steps of 1e-4; at a silhouette the ray's few µm decide which wall it meets
        assert ((depths[both] - true[both]).abs() < 1e-3).float().mean() > 0.99
    assert (views.backs >= views.depths).all()


def test_only_the_views_asked_for_are_read(boxes):
    data = open_dataset(boxes)
    few = data.load("a", views=[3, 1, 2], depths=1)
    assert few.images.shape[0] == 3 and few.depths.shape == few.backs.shape == (1, 16, 16)
    assert torch.equal(few.backs, data.load("a", views=[3]).backs)
    none = data.load("a", depths=0)
    assert none.depths is None and none.backs is None


def some(seed, layers=3, count=40):
    """Gaussians of some layers about the origin, before two cameras, and random surfaces."""
    rng = torch.Generator().manual_seed(seed)
    viewmats = orbit(torch.tensor([10.0, 130.0]), 20.0, distance=1.5)
    cameras = Cameras(viewmats, intrinsics(12, 12).expand(2, 3, 3), 12, 12)
    means = 0.35 * torch.randn(2, layers * count, 3, generator=rng)
    opacities = torch.rand(2, layers * count, generator=rng).round(decimals=0)  # some are 0
    surfaces = 1.2 + 0.6 * torch.rand(2, 2, 12, 12, generator=rng)
    surfaces[torch.rand(surfaces.shape, generator=rng) < 0.3] = 0
    scales = torch.ones_like(means)
    return Gaussians(means, None, scales, opacities, torch.ones_like(means)), cameras, surfaces


def bent(gap):
    size = gap.abs()
    return torch.where(size < DEPTH_BETA, size**2 / (2 * DEPTH_BETA), size - DEPTH_BETA / 2)


def slow_depth_loss(gaussians, layers, cameras, surfaces):
    """Plain form of the loss, one Gaussian after the other."""
    totals = []
    for b in range(len(surfaces)):
        total = 0.0
        for layer, surface in zip((0, layers - 1), surfaces[b]):
            values, pixels = [], {}
            for n in range(layer, gaussians.num, layers):
                point = cameras.viewmats[b, :3, :3] @ gaussians.means[b, n]
                point = point + cameras.viewmats[b, :3, 3]
                x, y, w = (cameras.Ks[b] @ point).tolist()
                column, row = int(np.floor(x / w)), int(np.floor(y / w))
                if not (0 <= column < 12 and 0 <= row < 12) or gaussians.opacities[b, n] == 0:
                    continue
                if (true := surface[row, column].item()) > 0:
                    values.append(bent(point[2] - true))
                    pixels.setdefault((row, column), []).append(point[2] - true)
            total = total + sum(values) / max(1, len(values))
            gaps = {place: sum(each) / len(each) for place, each in pixels.items()}
            for down, right in [(s, 0) for s in SLOPE_STEPS] + [(0, s) for s in SLOPE_STEPS]:
                pairs = [((r, c), (r + down, c + right)) for r, c in gaps]
                slopes = [bent(gaps[b] - gaps[a]) for a, b in pairs if b in gaps]
                fraction = SLOPE_WEIGHT / (2 * len(SLOPE_STEPS))
                total = total + fraction * sum(slopes) / max(1, len(slopes))
        totals.append(total)
    return torch.stack(totals)


@pytest.mark.parametrize("layers", [1, 3])
def test_the_loss_and_its_gradient(layers):
    gaussians, cameras, surfaces = some(layers, layers)
    gaussians.means.requires_grad_()
    weights = torch.tensor([0.7, -1.3])
    found = []
    for loss in (depth_loss, slow_depth_loss):
        value = loss(gaussians, layers, cameras, surfaces)
        (gradient,) = torch.autograd.grad((value * weights).sum(), gaussians.means)
        found.append((value.detach(), gradient))
    for got, want in zip(*found):
        torch.testing.assert_close(got, want, atol=1e-5, rtol=1e-5)  # float32 sums in other orders
    assert (found[0][0] > 0.05).all() and found[0][1].abs().max() > 0


def test_nothing_known_is_no_loss():
    gaussians, cameras, surfaces = some(0)
    gaussians.means.requires_grad_()
    value = depth_loss(gaussians, 3, cameras, 0 * surfaces)
    value.sum().backward()
    assert value.tolist() == [0, 0] and gaussians.means.grad.abs().max() == 0


def test_surfaces_of_a_sample_are_in_the_models_world(boxes):
    """With the camera at the model's distance, also for the mirrored object."""
    config = micro.options(boxes, boxes, loss={"lpips": "off"}).model_config()
    data, background = open_dataset(boxes), torch.ones(3)
    stored = data.load(0, [2]).cameras
    scale = config.distance / stored.viewmats[0, :3, 3].norm()
    assert (scale - 1).abs() > 0.02
    true = (through_the_box(stored)[0] * scale).nan_to_num(0)
    assert (true - true.flip(-1)).abs().max() > 0.05
    for change, want in ((None, true), (Change(flip=True), true.flip(-1))):
        batch = load_sample(data, 0, [2, 0], 16, config, background, change, surfaces=True)
        assert batch.surfaces.shape == (1, 2, 16, 16)
        assert ((batch.surfaces[0] - want).abs() < 2e-3).float().mean() > 0.98  # but for boundaries
    assert load_sample(data, 0, [2, 0], 16, config, background).surfaces is None


def test_a_training_brings_the_layers_to_the_surfaces(boxes, tmp_path):
    changes = {"optim": {"lr": 1e-2}, "length": {"steps": 40}}
    one, ends = tmp_path / "one", {}
    shutil.copytree(boxes, one)
    for path in one.glob("*/transforms.json"):  # always the same input
        values = json.loads(path.read_text())
        path.write_text(json.dumps(values | {"frames": values["frames"][:1]}))
    for weight in (0.0, 2.0):
        out = tmp_path / str(weight)
        loss = {"lpips": "off", "depth_weight": weight}
        assert run(one, out, RAYS, loss=loss, **changes) == 0
        ends[weight] = lines(out, "train")[-1]
    assert "loss_depth" not in ends[0.0]
    first = lines(tmp_path / "2.0", "train")[0]["loss_depth"]
    assert ends[2.0]["loss_depth"] < 0.3 * first


def test_bad_use_is_said_in_one_line(tmp_path):
    clouds = micro.write_dataset(tmp_path / "clouds")
    loss = {"lpips": "off", "depth_weight": 1.0}
    refused('needs the decoder "rays"', run, clouds, tmp_path / "out", loss=loss)
    refused("has no depth images", run, clouds, tmp_path / "out", RAYS, loss=loss)
