"""Fitting of one object: convergence from a random start to a known scene, and the command."""

import functools
import json
from dataclasses import replace

import pytest
import torch
from helpers.micro import cloud, photograph, views_around, write_object
from helpers.refusals import refused_command

from gamba_warp.cli import run
from gamba_warp.commands.fit import fit_command
from gamba_warp.conventions import GROUNDS, over_background
from gamba_warp.data.dataset import open_dataset
from gamba_warp.eval.views.compare import ViewsProtocol, load_truth, render_views
from gamba_warp.eval.views.predictions import PlyPredictions
from gamba_warp.fitting import objects
from gamba_warp.fitting.config import FitConfig
from gamba_warp.fitting.objects import choose_objects, split_views
from gamba_warp.fitting.optimize import activate, fit
from gamba_warp.fitting.start import random_start, sample_views, visual_hull
from gamba_warp.image_metrics import psnr
from gamba_warp.images import load_rgba, save_image
from gamba_warp.render import render

VIEWS = 12
QUICK = FitConfig(gaussians=300, steps=80, views=4)
STILL = dict.fromkeys(("lr_means", "lr_scales", "lr_quats", "lr_opacities", "lr_colors"), 0.0)


@functools.cache
def held_out_psnr(config: FitConfig) -> tuple[float, list[float]]:
    """Mean PSNR of three held-out views of a many-coloured cloud, on white; losses of the fit."""
    cameras = views_around(VIEWS)
    scene = cloud(3)
    scene.colors = torch.rand(40, 3, generator=torch.Generator().manual_seed(0))
    images = photograph(scene, cameras)
    fitted, kept = split_views(VIEWS, 4)
    result = fit(images[fitted], cameras[fitted], config)
    rgb = render(result.gaussians, cameras[kept], torch.ones(3)).rgb.clamp(0, 1)
    return psnr(rgb, over_background(images[kept], 1.0)).mean().item(), result.losses


def test_known_scene_is_found_from_a_random_start():
    reached, losses = held_out_psnr(QUICK)
    # reaches 28.7 dB; an empty picture has 19.0, and so has the start
    assert reached >= 27
    assert sum(losses[-5:]) < 0.2 * sum(losses[:5])


@pytest.mark.parametrize("frozen", ["all", "lr_means", "lr_scales", "lr_opacities", "lr_colors"])
def test_each_gradient_has_its_part(frozen):
    """No fit without learning, and a worse one without one attribute's gradient."""
    rates = STILL if frozen == "all" else {frozen: 0.0}
    reached, _ = held_out_psnr(replace(QUICK, **rates))
    assert reached < (20 if frozen == "all" else held_out_psnr(QUICK)[0] - 0.5)


def test_same_seed_same_bits():
    cameras = views_around(4)
    images = photograph(cloud(1), cameras)
    config = replace(QUICK, gaussians=101, steps=12)
    first, again = (fit(images, cameras, config) for _ in range(2))
    other = fit(images, cameras, replace(config, seed=1))
    for name in ("means", "quats", "scales", "opacities", "colors"):
        assert torch.equal(getattr(first.gaussians, name), getattr(again.gaussians, name)), name
        assert not torch.equal(getattr(first.gaussians, name), getattr(other.gaussians, name)), name


def test_the_mode_reaches_the_fit():
    """Gaussians fitted in one mode look better in it than in the other."""
    cameras = views_around(6)
    images = photograph(cloud(1), cameras)
    truth = over_background(images, 1.0)
    modes = ("classic", "antialiased")
    for mode, other in (modes, modes[::-1]):
        config = replace(QUICK, rasterize_mode=mode)
        gaussians = fit(images, cameras, config).gaussians
        own, cross = (
            psnr(render(gaussians, cameras, torch.ones(3), rasterize_mode=m).rgb, truth).mean()
            for m in (mode, other)
        )
        assert own > cross + 0.5, mode


def test_seconds_end_a_fit():
    cameras = views_around(4)
    images = photograph(cloud(1), cameras)
    config = replace(QUICK, steps=10**6, seconds=0.5)
    shown = []
    result = fit(images, cameras, config, lambda done, loss: shown.append(done))
    assert 0 < len(result.losses) < 10**4
    assert shown[-1] == 1 and shown == sorted(shown)


def test_fewer_views_than_a_step_wants():
    cameras = views_around(2, width=33, height=19)
    images = photograph(cloud(1), cameras)
    result = fit(images, cameras, replace(QUICK, gaussians=7, steps=3))
    assert result.gaussians.num == 7 and len(result.losses) == 3


def test_hull_of_a_ball():
    """Silhouettes of a ball of radius 0.3: the hull contains it and is little larger."""
    cameras = views_around(24, width=130, height=128)
    centres = -(cameras.viewmats[:, :3, :3].mT @ cameras.viewmats[:, :3, 3:])[..., 0]
    y, x = torch.meshgrid(torch.arange(128) + 0.5, torch.arange(130) + 0.5, indexing="ij")
    pixels = torch.stack([x, y, torch.ones_like(x)], -1)
    rays = pixels @ (torch.linalg.inv(cameras.Ks[0]).mT @ cameras.viewmats[:, None, :3, :3])
    rays = torch.nn.functional.normalize(rays, dim=-1)
    nearest = torch.linalg.cross(centres[:, None, None].expand_as(rays), rays).norm(dim=-1)
    hull = visual_hull((nearest < 0.3).float(), cameras, grid=48)
    axis = (torch.arange(48) + 0.5) / 48 - 0.5
    radius = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij")).norm(dim=0)
    assert hull[radius < 0.29].all()
    # 2 %: small caps above and below, where no camera looks, and a rim of a quarter of alpha
    assert (hull & (radius > 0.3)).sum() < 0.04 * hull.sum()


def test_hull_without_full_agreement():
    cameras = views_around(5)
    alphas = photograph(cloud(2), cameras)[..., 3]
    whole = visual_hull(alphas[:4], cameras[:4])
    alphas[4] = 0
    assert torch.equal(visual_hull(alphas, cameras), whole)
    with pytest.raises(ValueError, match="no silhouette"):
        visual_hull(torch.zeros_like(alphas), cameras)


def test_points_project_where_the_rasterizer_draws_them():
    cameras = views_around(3, width=40, height=36)
    scene = cloud(0)
    means2d = render(scene, cameras).meta["means2d"]
    # pictures that hold their own pixel coordinates: bilinear sampling is exact on them
    y, x = torch.meshgrid(torch.arange(36) + 0.5, torch.arange(40) + 0.5, indexing="ij")
    pixels = torch.stack([x, y], -1).expand(3, 36, 40, 2)
    torch.testing.assert_close(
        sample_views(pixels, cameras, scene.means), means2d, rtol=0, atol=1e-3
    )
    behind = 20 * (scene.means - torch.linalg.inv(cameras.viewmats)[0, :3, 2])
    assert sample_views(pixels, cameras, behind)[0].eq(0).all()


def test_start_lies_in_the_hull():
    cameras = views_around(VIEWS)
    images = photograph(cloud(2), cameras)
    start = random_start(images, cameras, 501, torch.Generator().manual_seed(0))
    hull = visual_hull(images[..., 3], cameras)
    cells = ((start["means"] + 0.5) * hull.shape[0]).long()
    assert hull[tuple(cells.T)].all()
    gaussians = activate(start)
    assert gaussians.num == 501 and (gaussians.scales > 0).all()
    # one hue: the views' mean colour is near the scene's
    true = cloud(2).colors.mean(0)
    assert (gaussians.colors.mean(0) - true).abs().max() < 0.1


def test_views_and_objects_are_chosen_by_rule():
    assert split_views(24, 6)[1] == [5, 11, 17, 23]
    assert split_views(24, 6)[0] == [v for v in range(24) if v % 6 != 5]
    assert split_views(3, 6) == ([0, 1, 2], [])
    assert split_views(3, 0) == ([0, 1, 2], [])
    assert choose_objects(list("abcdefg"), (), 3) == ["a", "c", "e"]
    assert choose_objects(list("abc"), ("c", "a", "c"), None) == ["c", "a"]


@pytest.fixture
def dataset(tmp_path):
    for seed, name in enumerate(("ball", "blob")):
        write_object(tmp_path / "data" / name, cloud(seed))
    return tmp_path / "data"


OPTIONS = ("--steps", "8", "--gaussians", "60", "--held-out", "3", "--device", "cpu")


def test_command_measures_as_eval_views_does(dataset, tmp_path):
    out = tmp_path / "out"
    assert run("fit", [str(dataset), "--out", str(out), *OPTIONS]) == 0
    report = json.loads((out / "report.json").read_text())
    assert [record["name"] for record in report["objects"]] == ["ball", "blob"]
    record = json.loads((out / "objects" / "ball.json").read_text())
    assert record["views_held_out"] == [2, 5] and record["gaussians"] == 60
    assert record["settings"]["steps"] == 8 and record["protocol"]["background"] == 1.0
    assert record["loss_last"] < record["loss_first"]
    assert report["summary"]["psnr_held_out"]["max"] >= record["psnr_held_out"]
    assert "| ball |" in (out / "report.md").read_text()
    assert load_rgba(out / "strips" / "ball.png").shape == (2 * 16, 2 * 16, 4)

    opened = open_dataset(dataset)
    source = PlyPredictions(out / "gaussians", 1.5, "cpu")
    protocol = ViewsProtocol("all", 0, None, None, None, None, source.distance)
    truth = load_truth(opened, "ball", protocol, "cpu")
    shown = render_views(source.gaussians(opened, "ball", 0), truth.cameras)
    got = psnr(shown.on(), truth.rgb)
    # another world and back, and the .ply's logits: float32 noise
    torch.testing.assert_close(
        got, torch.tensor(record["psnr_by_view"], dtype=got.dtype), rtol=0, atol=0.01
    )
    for ground, grey in GROUNDS.items():
        got = psnr(shown.on(grey), truth.shown.on(grey))[[2, 5]].mean()
        assert record[f"psnr_{ground}_held_out"] == pytest.approx(float(got), abs=0.01)


def test_one_failure_does_not_stop_the_rest(dataset, tmp_path, capsys):
    (dataset / "ball" / "003.png").write_bytes(b"not a picture")
    out = tmp_path / "out"
    assert run("fit", [str(dataset), "--out", str(out), *OPTIONS]) == 1
    report = json.loads((out / "report.json").read_text())
    assert [item["name"] for item in report["failures"]] == ["ball"]
    assert [record["name"] for record in report["objects"]] == ["blob"]
    assert "failed: ball: " in capsys.readouterr().err


def test_transparency_and_two_views_are_needed(dataset, tmp_path, capsys):
    for path in (dataset / "blob").glob("*.png"):
        save_image(path, load_rgba(path)[..., :3])
    write_object(tmp_path / "single", cloud(0), views=1)
    for folder, reason in (
        (dataset / "blob", "no transparent pixel"),
        (tmp_path / "single", "at least 2"),
    ):
        assert run("fit", [str(folder), "--out", str(tmp_path / "out"), *OPTIONS]) == 1
        assert reason in capsys.readouterr().err


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["NOWHERE"], "no such folder"),
        (["EMPTY"], "no objects found"),
        (["DATA", "--objects", "sofa"], "--objects sofa"),
        (["DATA", "--out", "DATA/ball/transforms.json"], "cannot write into"),
    ],
)
def test_bad_input_in_one_line(dataset, tmp_path, capsys, arguments, message):
    (tmp_path / "empty").mkdir()
    places = {"NOWHERE": tmp_path / "nowhere", "EMPTY": tmp_path / "empty", "DATA": dataset}
    for name, place in places.items():
        arguments = [argument.replace(name, str(place)) for argument in arguments]
    if "--out" not in arguments:
        arguments += ["--out", str(tmp_path / "out")]
    refused_command(capsys, "fit", arguments, message)


def test_interrupt_keeps_what_is_finished(dataset, tmp_path, monkeypatch):
    real = objects.fit_object

    def interrupted(job, uid):
        if uid == "blob":
            raise KeyboardInterrupt
        return real(job, uid)

    monkeypatch.setattr(objects, "fit_object", interrupted)
    with pytest.raises(KeyboardInterrupt):
        fit_command(dataset, out=tmp_path / "out", steps=3, gaussians=20, held_out=3)
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert [record["name"] for record in report["objects"]] == ["ball"]
