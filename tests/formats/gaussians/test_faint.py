"""Gaussians that are never drawn are left out of files, and no image changes by a bit."""

import numpy as np
import pytest
import torch
from helpers.gaussians import some
from helpers.refusals import refused

from gamba_warp.cameras import Cameras, intrinsics, orbit
from gamba_warp.cli import run
from gamba_warp.formats.gaussians.files import to_be_written, write_gaussians
from gamba_warp.formats.names import SPLAT_FORMATS, splat_suffix
from gamba_warp.formats.ply import load_ply, save_ply
from gamba_warp.formats.read import read_gaussians
from gamba_warp.render import render
from gamba_warp.surfaces.extract import unit_frame
from gamba_warp.trajectories.movies import turntable_frames

LIMIT = np.float32(1 / 255)
AROUND = [np.nextafter(LIMIT, 0, dtype="f4"), LIMIT, np.nextafter(LIMIT, 1, dtype="f4")]


def faint(count=3000):
    """A third are large and fainter than 1/255, one of them by its last bit."""
    gaussians = some(count)
    gaussians.opacities.clamp_(min=0.01)
    gaussians.opacities[::3] = torch.rand(len(gaussians.opacities[::3])) * 0.99 * float(LIMIT)
    gaussians.scales[::3] *= 3
    gaussians.opacities[:3] = torch.tensor(np.array(AROUND))
    return gaussians


@pytest.mark.parametrize("mode", ["classic", "antialiased"])
def test_images_keep_every_bit(mode):
    gaussians = faint()
    kept, said = to_be_written(gaussians)
    assert kept.num == 2000
    assert said == "2,000 Gaussians."
    viewmats = orbit(torch.tensor([0.0, 70.0, 200.0]), elevation=20.0)
    cameras = Cameras(viewmats, intrinsics(64, 64).expand(3, 3, 3), 64, 64)
    want, got = (
        render(part, cameras, torch.tensor([0.3, 0.9, 0.1]), True, rasterize_mode=mode)
        for part in (gaussians, kept)
    )
    for name in ("rgb", "alpha", "depth"):
        assert torch.equal(getattr(want, name), getattr(got, name)), name
    assert (want.alpha > 0.9).any()
    assert torch.equal(unit_frame(gaussians)[0], unit_frame(kept)[0])
    assert unit_frame(gaussians)[1] == unit_frame(kept)[1]  # by which pages and meshes are sized
    fewer = render(gaussians.drawn(0.02), cameras, rasterize_mode=mode)
    assert not torch.equal(fewer.alpha, want.alpha)  # faint ones are seen, down to the limit


@pytest.mark.parametrize("kind", SPLAT_FORMATS)
def test_what_is_drawn_is_drawn_from_the_file(tmp_path, kind):
    """A format of 8 bits has no step between 0 and 1/255."""
    gaussians = faint()
    gaussians.opacities[1:3] = float(LIMIT) * 1.0001  # a .ply rounds its logarithm
    kept, _ = to_be_written(gaussians)
    path = tmp_path / f"a{splat_suffix(kind)}"
    write_gaussians(path, kept, kind)
    assert read_gaussians(path).drawn().num == kept.num == 2000


def test_limits_of_ones_own():
    gaussians = faint(300)
    kept, said = to_be_written(gaussians, 0.0)
    assert kept.num == 300 and said == "300 Gaussians."
    kept, said = to_be_written(gaussians, 0.5)
    assert 0 < kept.num < 200 and bool((kept.opacities >= 0.5).all())
    assert said == f"{kept.num} Gaussians, {300 - kept.num} left out (opacity under 0.5)."
    refused(r"no Gaussian has an opacity of 1\.5 or more", to_be_written, gaussians, 1.5)
    gaussians.opacities[:] = float(LIMIT) / 2
    refused("no Gaussian has an opacity of 1/255 or more", to_be_written, gaussians)
    gaussians.opacities[5] = float("nan")  # which is refused where it is written
    assert to_be_written(gaussians)[0].num == 1


def test_export_leaves_them_out_and_says_so(tmp_path, capsys):
    gaussians = faint()
    gaussians.opacities[1:3] = 0.01  # those on the limit are rounded
    save_ply(tmp_path / "a.ply", gaussians, comments=["from a chair by tiny.safetensors"])
    common = ["export", tmp_path / "a.ply", "--mesh", "--splats", *SPLAT_FORMATS]
    few, all_ = tmp_path / "few", tmp_path / "all"
    for out, options, count in (
        (few, [], "2,000 Gaussians."),
        (few, ["-v"], "2,000 Gaussians, 1,000 left out (opacity under 1/255, never drawn)."),
        (all_, ["--min-opacity", 0], "3,000 Gaussians."),
    ):
        words = map(str, [*common[1:], "--out", out, *options])
        assert run(common[0], list(words)) == 0
        assert f"a: {count}\n" in capsys.readouterr().out
        for kind in SPLAT_FORMATS:
            name = f"a{splat_suffix(kind)}"
            assert read_gaussians(out / name).num == (2000 if out == few else 3000)
            if "ply" in kind:
                assert b"comment from a chair by tiny.safetensors\n" in (out / name).read_bytes()
    # Formats of 8 bits round other opacities up to 1/255.
    drawn = (read_gaussians(out / "a.ply") for out in (few, all_))
    assert np.array_equal(*(turntable_frames(each, size=48, frames=3) for each in drawn))
    assert load_ply(few / "a.ply").num == 2000
