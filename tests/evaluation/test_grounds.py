"""Figures on black and on grey beside white: haze that white hides is seen."""

import json
import math

import pytest
import torch
from helpers.micro import to_opengl

from gamba_warp.cameras import Cameras, intrinsics, orbit
from gamba_warp.cli import run
from gamba_warp.conventions import ON_GROUNDS, over_another, over_background
from gamba_warp.eval.views.compare import Shown, Truth, compare, render_views
from gamba_warp.formats.ply import save_ply
from gamba_warp.gaussians import Gaussians
from gamba_warp.images import save_image
from gamba_warp.render import render

pytestmark = pytest.mark.usefixtures("one_thread")

SIZE, VIEWS = 32, 3


def cameras():
    K = intrinsics(SIZE, SIZE).expand(VIEWS, 3, 3)
    return Cameras(orbit(torch.arange(VIEWS) * 70.0), K, SIZE, SIZE)


def balls(*colors):
    """Balls about the origin, each larger than the one before; all but the first are haze."""
    count = len(colors)
    return Gaussians(
        means=torch.zeros(count, 3),
        quats=None,
        scales=0.08 * torch.arange(1, count + 1)[:, None].expand(count, 3),
        opacities=torch.tensor([0.95] + [0.2] * (count - 1)),
        colors=torch.tensor(colors),
    )


RED, WHITE = [0.9, 0.1, 0.1], [1.0, 1.0, 1.0]


def rgba(gaussians):
    with torch.no_grad():
        out = render(gaussians, cameras())
    return torch.cat([out.rgb / out.alpha.clamp(min=1e-6), out.alpha], -1)


def test_one_rendering_serves_all_grounds():
    """What is composited by alpha is what the rasterizer draws on that background."""
    scene = balls(RED, [0.2, 0.9, 0.4])
    shown = render_views(scene, cameras())
    for grey in (1.0, 0.5, 0.0):
        with torch.no_grad():
            drawn = render(scene, cameras(), torch.full((3,), grey)).rgb
        assert (shown.on(grey) - drawn).abs().max() < 1e-6
    rgba = torch.rand(2, 5, 6, 4)
    turned = over_another(over_background(rgba, 1.0), rgba[..., 3:], 1.0, 0.5)
    assert (turned - over_background(rgba, 0.5)).abs().max() < 1e-6


def test_known_values_on_each_ground():
    """A flat half-covered picture, off by known amounts: by colour on white, by alpha elsewhere."""
    images = torch.tensor([1.0, 1.0, 1.0, 0.5]).expand(2, SIZE, SIZE, 4).clone()
    truth = Truth("a", images, cameras(), [0, 1])
    # White at a lesser alpha: nothing is wrong on white, (1 - grey) * 0.25 elsewhere.
    hazy = Shown(torch.ones(2, SIZE, SIZE, 3), torch.full((2, SIZE, SIZE), 0.25))
    values = compare({"hazy": hazy, "opaque": hazy._replace(alpha=None)}, truth)
    for view in values["hazy"]:
        assert view["psnr"] == 100
        assert view["psnr_black"] == pytest.approx(-20 * math.log10(0.25), abs=1e-5)
        assert view["psnr_grey"] == pytest.approx(-20 * math.log10(0.125), abs=1e-5)
    assert values["opaque"][0]["psnr"] == 100
    assert {values["opaque"][0][key] for key in ON_GROUNDS} == {None}


def test_a_report_tells_of_haze_that_white_hides(tmp_path, capsys):
    frames, views = [], rgba(balls(RED))
    (tmp_path / "data" / "a").mkdir(parents=True)
    for v, pose in enumerate(to_opengl(cameras().viewmats)):
        save_image(tmp_path / "data" / "a" / f"{v}.png", views[v].numpy())
        frames.append({"file_path": f"{v}.png", "transform_matrix": pose.tolist()})
    focal = float(cameras().Ks[0, 0, 0])
    top = {"w": SIZE, "h": SIZE, "fl_x": focal, "fl_y": focal, "frames": frames}
    (tmp_path / "data" / "a" / "transforms.json").write_text(json.dumps(top))
    (tmp_path / "pred").mkdir()
    found = {}
    for name, scene in {"clear": balls(RED), "hazy": balls(RED, WHITE)}.items():
        save_ply(tmp_path / "pred" / "a.ply", scene)
        places = ["--checkpoint", str(tmp_path / "pred"), "--data", str(tmp_path / "data")]
        options = ["--split", "all", "--no-lpips", "--device", "cpu", "--sheet", "0"]
        out = tmp_path / name
        words = [*places, *options, "--out", str(out), "--save-pictures"]
        assert run("eval-views", words) == 0
        found[name] = json.loads((out / "report.json").read_text())
    said = capsys.readouterr().out
    assert "PSNR on black" in said and "composited by their alpha" in said
    clear, hazy = (report["mean"] for report in found.values())
    assert clear["psnr_black"] > 45 and clear["psnr_grey"] > 45
    assert hazy["psnr"] > hazy["psnr_grey"] + 5 > hazy["psnr_black"] + 8
    # Red differs most from white, and least from grey; the input's own copy is itself.
    empty = found["clear"]["baselines"]["background"]
    assert empty["psnr_grey"] > empty["psnr_black"] > empty["psnr"]
    copy = found["clear"]["baselines"]["input_copy"]["input"]
    assert copy["psnr_black"] == copy["psnr_grey"] == 100
    report = found["hazy"]
    assert report["protocol"]["background"] == 1
    assert report["protocol"]["grounds"] == {"black": 0.0, "grey": 0.5}
    rows = {row["name"]: row for row in report["table"] if row["views"] == "novel"}
    assert rows["model"]["psnr_black"]["mean"] == hazy["psnr_black"]
    header = (tmp_path / "hazy" / "objects.csv").read_text().partition("\n")[0]
    assert "psnr_black" in report["differences"][0] and "input.psnr_grey" in header
    # What is written of the model, evaluated as another method's pictures, has the same figures.
    words = ["--predictions", str(tmp_path / "hazy" / "pictures" / "model"), *places[2:], *options]
    assert run("eval-views", [*words, "--no-baselines", "--json"]) == 0
    again = json.loads(capsys.readouterr().out)["mean"]
    assert again["psnr"] > 60
    for key in ("psnr_black", "psnr_grey"):
        assert again[key] == pytest.approx(hazy[key], abs=0.1)
