"""gsplat's strategies in a fit: they reach a known scene, keep the cap and the generators."""

import importlib.util
import json
import sys
from dataclasses import replace

import pytest
import torch
from helpers.micro import cloud, photograph, views_around, write_object
from helpers.refusals import refused_command

from gamba_warp.cli import run
from gamba_warp.conventions import over_background
from gamba_warp.fitting import densify
from gamba_warp.fitting.config import FitConfig
from gamba_warp.fitting.densify import Densified, make_strategy, start_count
from gamba_warp.fitting.optimize import fit
from gamba_warp.fitting.start import random_start
from gamba_warp.image_metrics import psnr
from gamba_warp.render import render
from gamba_warp.versions import to_install

NEEDS_GSPLAT = pytest.mark.skipif(
    importlib.util.find_spec("gsplat") is None,
    reason="needs the package gsplat (pip install gsplat==1.5.3)",
)
BOTH = pytest.mark.parametrize("name", ["mcmc", "default"])
QUICK = FitConfig(gaussians=301, steps=70, views=4)
NAMES = ("means", "quats", "scales", "opacities", "colors")
pytestmark = pytest.mark.usefixtures("one_thread")


def counted(monkeypatch):
    """The numbers of Gaussians after each step, filled by the fits that follow."""
    counts, after = [], Densified.after

    def noted(self, step, done):
        after(self, step, done)
        counts.append(len(self.parameters["means"]))
        return 0

    monkeypatch.setattr(Densified, "after", noted)
    return counts


@NEEDS_GSPLAT
@BOTH
@pytest.mark.parametrize("mode", ["classic", "antialiased"])
def test_known_scene_is_found_with_a_growing_number(name, mode, monkeypatch):
    counts = counted(monkeypatch)
    cameras = views_around(8, width=33, height=29)
    images = photograph(cloud(3), cameras)
    config = replace(QUICK, strategy=name, rasterize_mode=mode)
    result = fit(images[:6], cameras[:6], config)
    rgb = render(result.gaussians, cameras[6:], torch.ones(3), rasterize_mode=mode).rgb.clamp(0, 1)
    # an empty picture has 19 dB
    assert psnr(rgb, over_background(images[6:], 1.0)).mean() > 25
    assert len(counts) == len(result.losses) == 70 and result.relocated == 0
    assert counts[0] == start_count(config) == 150 and result.gaussians.num == counts[-1]
    assert 290 <= max(counts) <= 301
    assert counts[int(0.7 * 70) :] == counts[-1:] * 21, "the number stays at the end"
    assert all(getattr(result.gaussians, x).isfinite().all() for x in NAMES)


@NEEDS_GSPLAT
@BOTH
def test_same_seed_same_bits_whatever_torch_drew_before(name):
    cameras = views_around(4)
    images = photograph(cloud(1), cameras)
    config = replace(QUICK, gaussians=60, steps=25, strategy=name)
    torch.manual_seed(5)
    first, drawn = fit(images, cameras, config).gaussians, torch.rand(3)
    again = fit(images, cameras, config).gaussians
    other = fit(images, cameras, replace(config, seed=1)).gaussians
    assert torch.equal(drawn, torch.rand(3, generator=torch.Generator().manual_seed(5)))
    for x in NAMES:
        assert torch.equal(getattr(first, x), getattr(again, x)), x
    assert first.means.shape != other.means.shape or not torch.equal(first.means, other.means)


@NEEDS_GSPLAT
@BOTH
@pytest.mark.parametrize("steps", [1, 2, 3, 7])
@pytest.mark.parametrize("count", [2, 3, 9])
def test_few_steps_and_few_gaussians(name, steps, count):
    cameras = views_around(2, width=21, height=19)
    images = photograph(cloud(1), cameras)
    config = replace(QUICK, gaussians=count, steps=steps, strategy=name, refine_start=0.0)
    assert 1 <= fit(images, cameras, config).gaussians.num <= count


@NEEDS_GSPLAT
def test_the_largest_number_holds_for_default():
    """gsplat's own has no limit: with far more candidates, the surplus is removed again."""
    cameras = views_around(3)
    images = photograph(cloud(1), cameras)
    config = replace(QUICK, gaussians=53, start_share=0.9, grow_grad=0.0, strategy="default")
    config = replace(config, steps=10, refine_start=0.0, refine_stop=1.0)
    rng = torch.Generator().manual_seed(0)
    start = random_start(images, cameras, 48, rng)
    start["opacities"] = torch.linspace(-1, 1, 48)
    number = Densified(start, config, rng)
    number._grow_threshold = lambda free: 0.0  # all that have a gradient grow
    for step in range(1, 4):
        before = number.parameters["opacities"].detach().clone()
        rgb, _ = number.draw(cameras, torch.rand(3, 3))
        (rgb - images[..., :3]).square().mean().backward()
        number.after(step, 0.0)
        assert {len(value) for value in number.parameters.values()} == {53}
        for key, optimizer in number.optimizers.items():
            assert optimizer.param_groups[0]["params"][0] is number.parameters[key]
        # each has a copy or two halves, so that the upper half of them is left
        opacities = number.parameters["opacities"].detach()
        assert opacities.min() > before.min() and opacities.unique().numel() < 30


@NEEDS_GSPLAT
def test_schedules_follow_the_steps():
    for steps in (1, 10, 600, 30_000):
        for name in ("mcmc", "default"):
            config = replace(QUICK, strategy=name, steps=steps, gaussians=77)
            strategy = make_strategy(config)
            assert strategy.refine_start_iter == steps // 12
            assert strategy.refine_stop_iter == int(0.7 * steps)
            assert strategy.refine_every == max(1, steps // 30)
        assert strategy.reset_every == max(1, steps // 4)
    assert make_strategy(replace(QUICK, strategy="mcmc")).cap_max == 301


@NEEDS_GSPLAT
@BOTH
def test_command(name, tmp_path):
    write_object(tmp_path / "data" / "ball", cloud(0))
    out = tmp_path / "out"
    options = ["--steps", "8", "--gaussians", "60", "--held-out", "3", "--strategy", name]
    assert run("fit", [str(tmp_path / "data"), "--out", str(out), *options]) == 0
    record = json.loads((out / "objects" / "ball.json").read_text())
    assert 30 <= record["gaussians"] <= 60 and record["settings"]["strategy"] == name
    assert 0 < record["ssim_held_out"] < 1
    assert f"strategy {name}".encode() in (out / "gaussians" / "ball.ply").read_bytes()[:500]


@NEEDS_GSPLAT
@BOTH
def test_interrupt(name, tmp_path, monkeypatch, capsys):
    """Finished objects are kept; nothing of the interrupted one is written."""
    for seed, uid in enumerate(("ball", "blob")):
        write_object(tmp_path / "data" / uid, cloud(seed))
    after, steps = densify.Densified.after, []

    def interrupted(self, step, done):
        steps.append(step)
        if len(steps) == 7:  # in the second object
            raise KeyboardInterrupt
        return after(self, step, done)

    monkeypatch.setattr(densify.Densified, "after", interrupted)
    out = tmp_path / "out"
    options = ["--steps", "5", "--gaussians", "30", "--held-out", "3", "--strategy", name]
    assert run("fit", [str(tmp_path / "data"), "--out", str(out), *options]) == 130
    report = json.loads((out / "report.json").read_text())
    assert [record["name"] for record in report["objects"]] == ["ball"]
    assert [path.name for path in (out / "gaussians").iterdir()] == ["ball.ply"]


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["--strategy", "mcmc", "--minutes", "1"], "--minutes 1 with --strategy mcmc: "),
        (["--strategy", "default", "--gaussians", "1"], "--gaussians 1: "),
    ],
)
def test_bad_input_in_one_line(arguments, message, tmp_path, capsys):
    write_object(tmp_path / "ball", cloud(0))
    words = [tmp_path / "ball", "--out", tmp_path / "out", *arguments]
    refused_command(capsys, "fit", words, message)
    assert not (tmp_path / "out").exists()


def test_without_gsplat(tmp_path, monkeypatch, capsys):
    write_object(tmp_path / "ball", cloud(0))
    for module in ("gsplat", "gsplat.strategy"):
        monkeypatch.setitem(sys.modules, module, None)
    monkeypatch.delitem(sys.modules, "gamba_warp.compat.gsplat.strategy", raising=False)
    arguments = [str(tmp_path / "ball"), "--out", str(tmp_path / "out"), "--strategy", "mcmc"]
    assert run("fit", arguments) == 2
    reason = "fit needs gsplat, which is not installed: " + to_install("fit")
    assert capsys.readouterr().err == f"gamba: {reason}\n"
    assert not (tmp_path / "out").exists()
    arguments = [*arguments[:-1], "fixed", "--steps", "2", "--gaussians", "9"]
    assert run("fit", arguments) == 0
