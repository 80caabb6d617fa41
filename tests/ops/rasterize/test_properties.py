"""Promises of the rasterizer beyond the oracle: known answers, culling, limits, errors."""

import math

import pytest
import torch
from helpers import rel_rms
from helpers.raster import NAMES, drawn, leaves, make, mapped, one

from gamba_warp.kernels.cases.raster import orbit_cameras, raster_case, shell
from gamba_warp.kernels.rasterize import autograd, rasterization
from gamba_warp.kernels.rasterize.cpu import bin as bin_cpu
from gamba_warp.kernels.rasterize.reference import rasterization_reference


def test_one_gaussian():
    """On the axis the footprint is exp(-d² / 2σ²) with σ² = (f s / z)² + 0.3."""
    renders, alphas, meta = rasterization(**one())
    y, x = torch.meshgrid(torch.arange(31) - 15.0, torch.arange(33) - 16.0, indexing="ij")
    alpha = 0.8 * torch.exp(-0.5 * (x * x + y * y) / (2.0**2 + 0.3))
    alpha = torch.where(alpha >= 1 / 255, alpha, 0.0)
    assert (alphas[0, ..., 0] - alpha).abs().max() < 1e-6
    assert (renders[0] - alpha[..., None] * torch.tensor([0.2, 0.5, 1.0])).abs().max() < 1e-6
    assert meta["pairs"] == 4 and meta["tiles"] == 6 and meta["tiles_empty"] == 2
    assert meta["means2d"].tolist() == [[[16.5, 15.5]]]


def test_order_and_transmittance():
    """Two opaque-ish Gaussians at one pixel: the nearer hides the farther, whatever the order."""
    scene = one()
    scene["means"] = torch.tensor([[0, 0, 3.0], [0, 0, 2.0]])
    scene["scales"], scene["opacities"] = torch.full((2, 3), 5.0), torch.tensor([0.5, 0.75])
    scene["colors"] = torch.eye(3)[:2]
    renders, alphas, _ = rasterization(**scene)
    want = torch.tensor([0.25 * 0.5, 0.75, 0.0])
    assert (renders[0, 15, 16] - want).abs().max() < 1e-6
    assert abs(alphas[0, 15, 16, 0] - 0.875) < 1e-6


def test_clamped_alpha_has_no_gradient():
    scene = leaves(one(opacity=0.999), torch.float32)
    renders, _, _ = rasterization(**scene)
    renders[0, 15, 16].sum().backward()  # the centre, alpha would be 0.999
    assert renders[0, 15, 16, 2].item() == pytest.approx(0.99)
    assert scene["opacities"].grad.item() == 0.0 and (scene["scales"].grad == 0).all()


def test_stops_before_falling_to_the_limit():
    """Three layers of 0.99 leave 1e-2, then would leave 1e-4: only the first is drawn."""
    scene = one()
    scene["means"] = torch.tensor([[0, 0, 2.0], [0, 0, 2.1], [0, 0, 2.2]])
    scene["scales"], scene["opacities"] = torch.full((3, 3), 50.0), torch.ones(3)
    scene["colors"] = torch.eye(3)
    renders, alphas, _ = rasterization(**scene, alpha_max=0.992)
    assert renders[0, 15, 16].tolist() == pytest.approx([0.992, 0.0, 0.0])
    assert alphas[0, 15, 16, 0] == pytest.approx(0.992)


def test_culls_and_the_near_plane_that_is_seen():
    _, alphas, meta = rasterization(**one(mean=(0.0, 0.0, 0.5)), near_plane=0.5)
    assert alphas.max() > 0.7 and meta["culled"]["near"] == 0
    assert rasterization(**one(), far_plane=1.9)[2]["culled"]["far"] == 1
    assert rasterization(**one(mean=(9.0, 0.0, 2.0)))[2]["culled"]["outside"] == 1
    assert rasterization(**one(), radius_clip=30.0)[2]["culled"]["small"] == 1
    assert rasterization(**one(), radius_clip=5.0)[2]["culled"]["small"] == 0


@pytest.mark.parametrize("batch, views, num", [(2, 3, 0), (2, 0, 5), (0, 2, 5), (1, 1, 1)])
def test_empty(batch, views, num):
    scene = leaves(make(batch, views, num), torch.float32)
    for mode, channels in (("RGB", 3), ("RGB+ED", 4), ("D", 1)):
        renders, alphas, meta = rasterization(**scene, render_mode=mode)
        assert renders.shape == (batch, views, 53, 37, channels)
        assert alphas.shape == (batch, views, 53, 37, 1)
        assert sum(meta["culled"].values()) <= batch * views * num
        (renders.sum() + alphas.sum()).backward()
    assert torch.isfinite(scene["means"].grad).all()
    if num == 0:
        background = scene["backgrounds"][:, :, None, None].expand(-1, -1, 53, 37, -1)
        assert torch.equal(rasterization(**scene)[0], background)


@pytest.mark.parametrize("lead", [(), (3,), (1, 2)])
def test_leading_dimensions(lead):
    flat = make(batch=max(1, math.prod(lead)))
    scene = mapped(flat, lambda v: v.view(*lead, *v.shape[1:]))
    scene["means"].requires_grad_()
    want, want_alpha, _ = rasterization(**flat)
    got, alpha, meta = rasterization(**scene)
    assert torch.equal(got, want.view(*lead, *want.shape[1:]))
    assert torch.equal(alpha, want_alpha.view(*lead, *want_alpha.shape[1:]))
    assert meta["radii"].shape == (*lead, 3, 60, 2)
    # densification reads the gradients of the projected means from meta, as with gsplat
    meta["means2d"].retain_grad()
    got.square().sum().backward()
    assert meta["means2d"].grad.abs().max() > 0


def test_only_what_is_asked_for():
    scene = make()
    full, _ = drawn(scene)
    for name in NAMES:
        some, _ = drawn(scene, needs=[name])
        assert some.keys() == {"renders", "alphas", name}
        assert torch.equal(some[name], full[name]), name


def test_tiles_without_upstream_gradient_are_skipped():
    scene = make(batch=1, views=1, num=300, width=64, height=64)

    def in_a_tile(v):
        for x in v:
            x[:, :, :20], x[:, :, 30:], x[..., :20, :], x[..., 30:, :] = 0, 0, 0, 0

    _, meta = drawn(scene, edit=in_a_tile)
    assert meta["tiles_empty"] == 0 and meta["tiles_skipped"] == 15
    assert drawn(scene)[1]["tiles_skipped"] == 0


def test_half_precision_inputs():
    scene = make()
    for dtype in (torch.bfloat16, torch.float16):
        half = {k: v.to(dtype) if k in NAMES[:5] and k != "means" else v for k, v in scene.items()}
        exact = {k: v.float() if k in NAMES[:5] else v for k, v in half.items()}
        half = {k: v.requires_grad_() if k == "colors" else v for k, v in half.items()}
        renders, _, _ = rasterization(**half)
        assert renders.dtype == torch.float32
        assert torch.equal(renders, rasterization(**exact)[0])
        renders.sum().backward()
        assert half["colors"].grad.dtype == dtype


def test_meta_counts():
    _, _, meta = rasterization(**make(num=300, size=0.1, width=100, height=70))
    assert 0 < meta["pairs_traversed"] <= meta["pairs"] < meta["pairs_box"]
    assert meta["tiles"] == 2 * 3 * 7 * 5 and meta["tiles_skipped"] is None
    assert 0 < meta["blocks_used"] <= 16 * meta["pairs_traversed"]
    assert meta["width"] == 100 and meta["tile_size"] == 16
    with pytest.raises(KeyError):
        meta["nothing"]


@pytest.mark.parametrize(
    "change, error, words",
    [
        ({"means": torch.zeros(2, 60, 2)}, ValueError, "means"),
        ({"means": torch.zeros(2, 60, 3, dtype=torch.float64)}, TypeError, "means"),
        ({"quats": torch.zeros(2, 59, 4)}, ValueError, r"quats .*\[2, 60, 4\]"),
        ({"scales": torch.zeros(2, 60)}, ValueError, "scales"),
        ({"opacities": torch.zeros(2, 60, 1)}, ValueError, "opacities"),
        ({"colors": torch.zeros(2, 60, 0)}, ValueError, "colors"),
        ({"colors": torch.zeros(2, 4, 60, 3)}, ValueError, "colors"),
        ({"colors": torch.zeros(2, 60, 3), "sh_degree": 1}, ValueError, "colors"),
        ({"colors": torch.zeros(2, 60, 3), "sh_degree": 4}, ValueError, "sh_degree"),
        ({"viewmats": torch.zeros(2, 3, 3, 4)}, ValueError, "viewmats"),
        ({"viewmats": torch.zeros(3, 3, 4, 4)}, ValueError, "viewmats"),
        ({"Ks": torch.zeros(2, 2, 3, 3)}, ValueError, "Ks"),
        ({"Ks": None}, TypeError, "Ks"),
        ({"backgrounds": torch.zeros(2, 3, 4)}, ValueError, "backgrounds"),
        ({"width": 0}, ValueError, "width"),
        ({"height": 3.5}, ValueError, "height"),
        ({"near_plane": 0.0}, ValueError, "near_plane"),
        ({"alpha_max": 1.0}, ValueError, "alpha_max"),
        ({"alpha_min": math.nan}, ValueError, "alpha_min"),
        ({"eps2d": -1.0}, ValueError, "eps2d"),
        ({"render_mode": "rgb"}, ValueError, "render_mode"),
        ({"rasterize_mode": "mip"}, ValueError, "rasterize_mode"),
    ],
)
def test_bad_input(change, error, words):
    with pytest.raises(error, match=words):
        rasterization(**{**make(), **change})


@pytest.mark.parametrize("many", [0, 1 << 30])
def test_too_many_pairs(monkeypatch, many):
    monkeypatch.setattr(bin_cpu, "MANY", many)
    monkeypatch.setattr(autograd, "MAX_PAIRS", 5000)
    with pytest.raises(ValueError, match="pairs of tiles and Gaussians"):
        rasterization(**make(num=400, size=1.0))


def scene(**options):
    viewmats, Ks = orbit_cameras(2, 75)
    viewmats[:, 0, 3] += 0.03
    return raster_case(shell(400, 3), (viewmats, Ks), 75, torch.device("cpu"), **options)


def results(of):
    renders, alphas, meta = of.forward()
    return [renders, alphas, *of.backward()], meta


@pytest.mark.parametrize("t_min", [0.3, 1e-2, 1e-30])
def test_the_limit_of_transmittance(t_min):
    """Against the oracle with the same limit; the default's image is another one."""
    made = scene(t_min=t_min)
    got, _ = results(made)
    x = {k: v.double() for k, v in made.inputs.items() if k != "pixels"}
    want, _, alphas = rasterization_reference(**x, width=75, height=75, t_min=t_min)
    # a pixel at a threshold may fall on its other side
    assert ((got[0] - want).abs() < 1e-4).float().mean() > 0.999
    assert ((got[1] - alphas).abs() < 1e-4).float().mean() > 0.999
    assert rel_rms(got[0], results(scene())[0][0]) > 1e-6
    assert all(g.isfinite().all() for g in got)


@pytest.mark.parametrize("t_min", [0.0, 1.0, -1e-4, float("nan")])
def test_limits_that_are_refused(t_min):
    with pytest.raises(ValueError, match="t_min must be in"):
        scene(t_min=t_min).forward()
