"""The camera's elevation from the Gaussians, and results that stand upright."""

import json

import numpy as np
import pytest
import torch
from helpers.model import run_reconstruct
from helpers.views import cloud_of

from gamba_warp.app import cutting, work
from gamba_warp.files import STARTER
from gamba_warp.formats.ply import load_ply
from gamba_warp.gaussians import Gaussians
from gamba_warp.model.checkpoint import load_model
from gamba_warp.model.predict import reconstruct
from gamba_warp.photo.cutout import CutoutOptions
from gamba_warp.trajectories.elevation import UNKNOWN, estimate_elevation
from gamba_warp.trajectories.paths import upright

ICON = STARTER / "icons" / "scopia-cardboard-box.png"
GREY = (0.5, 0.5, 0.5)


def table(count=4000) -> Gaussians:
    """Top and four legs, upright: 0.8 wide, 0.5 deep, 0.5 high."""
    rng = np.random.default_rng(5)
    top = rng.uniform([-0.4, -0.25, -0.25], [0.4, -0.2, 0.25], (count, 3))
    corners = rng.choice([-1, 1], (count, 2)) * [0.37, 0.22]
    legs = np.stack([corners[:, 0], rng.uniform(-0.2, 0.25, count), corners[:, 1]], 1)
    return cloud_of(np.concatenate([top, legs + rng.normal(0, 0.01, legs.shape)]), 0.01, 1.0, GREY)


@pytest.mark.parametrize("elevation", [-8, 0, 17, 40])
def test_a_table_is_set_upright(elevation):
    """Also turned about the vertical, and with faint Gaussians around it, which do not count."""
    lying = table()
    for azimuth in (0.0, 30.0):
        a, b = np.cos(np.radians(azimuth)), np.sin(np.radians(azimuth))
        turn = torch.tensor([[a, 0, b], [0, 1, 0], [-b, 0, a]], dtype=torch.float32)
        seen = upright(elevation).T @ turn
        found = estimate_elevation(lying.transformed(seen, torch.zeros(3)))
        assert abs(found.degrees - elevation) <= 6 and not found.doubtful
    fog = table()
    fog.means, fog.opacities = torch.randn_like(fog.means), 0.2 * fog.opacities
    names = "means", "scales", "opacities", "colors"
    both = {name: torch.cat([getattr(lying, name), getattr(fog, name)]) for name in names}
    found = estimate_elevation(Gaussians(quats=None, **both).transformed(seen, torch.zeros(3)))
    assert abs(found.degrees - elevation) <= 6


def test_a_ball_leaves_the_elevation_in_doubt(capsys, tmp_path):
    """Its profile is the same from all sides; a line says so, with the quartiles."""
    means = torch.nn.functional.normalize(torch.randn(4000, 3), dim=-1) / 2
    found = estimate_elevation(cloud_of(means, 0.01, 1.0, GREY))
    assert found.doubtful and found.low < found.degrees < found.high
    assert str(found) == f"{found.degrees} degrees, in doubt ({found.low} to {found.high})"
    (icon,) = (STARTER / "icons").glob("*-fordfocus.png")
    options = "--no-page", "--turntable", "none", "--json", "--out", tmp_path
    assert run_reconstruct(icon, *options) == 0
    said = capsys.readouterr()
    (result,) = json.loads(said.out)["results"]
    low, high = result["elevation_doubt"]
    assert f"is about {result['elevation']} degrees, in doubt ({low} to {high}); --elev" in said.err


def test_invalid_gaussians_do_not_count():
    broken = table()
    broken.means[::7], broken.scales[3::7] = torch.nan, torch.inf
    assert abs(estimate_elevation(broken).degrees) <= 6


def test_nothing_to_estimate_from():
    lying, order = table().transformed(upright(40).T, torch.zeros(3)), torch.arange(8000)
    found = [estimate_elevation(lying.select(order < count)) for count in (0, 49, 50)]
    assert found[:2] == [UNKNOWN, UNKNOWN] and UNKNOWN.doubtful and found[2].degrees > 20


def test_reconstruct_turns_by_the_estimate(tmp_path, capsys):
    common = ICON, "--no-page", "--turntable", "none", "--json", "--out"
    said = run_json(capsys, *common, tmp_path / "auto")
    assert run_json(capsys, *common, tmp_path / "flat", "--elevation", 0)["elevation"] == 0
    auto, flat = (load_ply(tmp_path / name / f"{ICON.stem}.ply") for name in ("auto", "flat"))
    assert said["elevation"] == estimate_elevation(flat).degrees != 0
    want = flat.transformed(upright(said["elevation"]), torch.zeros(3)).means
    torch.testing.assert_close(auto.means, want, rtol=1e-4, atol=1e-5)


def run_json(capsys, *words) -> dict:
    capsys.readouterr()
    assert run_reconstruct(*words) == 0
    return json.loads(capsys.readouterr().out)["results"][0]


def test_the_app_begins_with_the_estimate():
    cut = cutting.cut_image(ICON, "thing.png", CutoutOptions())
    made = work.run_model(load_model(), cut)
    assert made.view.elevation == made.estimate.degrees > 10
    assert work.run_model(load_model(), cut, 3.0).view.elevation == 3.0


ICONS = {"by-fordfocus": 9, "cardboard-box": 22, "jacuzzi": 32, "toaster": 30}


@pytest.mark.parametrize("name", ICONS)
def test_estimates_of_icons_by_the_shipped_model(name):
    """The same to a degree, for sums in another order; a quartile, or no prior, moves them by 3."""
    (path,) = (STARTER / "icons").glob(f"*-{name}.png")
    found = estimate_elevation(reconstruct(load_model(), path, detail=1))
    assert abs(found.degrees - ICONS[name]) <= 1
    assert found.doubtful == (name == "by-fordfocus")
