"""Hostile input to the rasterizer: it stays finite, repeats its bits and is right."""

import math

import pytest
import torch
from helpers.raster import IMAGE, NAMES, assert_gradients, both, drawn, make, mapped, one

from gamba_warp.kernels.rasterize import rasterization

ALPHA_MIN = 1 / 255
GAUSSIAN = NAMES[:5]
FLIPS = 2e-3  # the fraction of pixels on the other side of a cut
HARD_ROWS = 0.99  # the fraction of Gaussians whose own gradient is right to 1e-3


def render(scene, mode="RGB+ED", **options):
    """Renders, alphas, gradients by name under a cotangent that repeats, and meta."""
    grads, meta = drawn(scene, mode, **options)
    return grads.pop("renders"), grads.pop("alphas"), grads, meta


def survives(scene, **options):
    """Renders twice, plain and antialiased: all finite, the same bits. Returns the plain one."""
    for kind in ("antialiased", "classic"):
        first, again = (render(scene, rasterize_mode=kind, **options) for _ in range(2))
        for name, gradient in first[2].items():
            assert torch.isfinite(gradient).all(), f"gradient of {name}"
            assert torch.equal(gradient, again[2][name]), f"two runs differ in {name}"
        assert torch.isfinite(first[0]).all()
        assert all(torch.equal(a, b) for a, b in zip(first[:2], again[:2])), "two runs differ"
        assert (first[1] >= 0).all() and (first[1] <= 1).all()
    return first


def base(num=60, **changes):
    return make(1, 2, num, **changes)


def before_the_camera(scene, place, camera_points):
    """Moves Gaussians to points of the first camera's frame."""
    to_world = torch.linalg.inv(scene["viewmats"][0, 0].double())
    points = torch.nn.functional.pad(camera_points.double(), (0, 1), value=1.0)
    scene["means"][0, place] = (points @ to_world.T)[:, :3].float()


@pytest.mark.parametrize("near", [0.01, 1e-6, 1e-12])
def test_around_the_camera_plane(near):
    z = torch.tensor([-1, -1e-3, -1e-6, -1e-7, 0, 1e-7, 1e-6, 1e-3, 0.00999, 0.0101, 0.02])
    scene = base()
    points = torch.cat([0.003 * torch.randn(11, 2), z[:, None]], 1)
    before_the_camera(scene, torch.arange(11), points)
    _, alphas, _, meta = survives(scene, near_plane=near)
    assert alphas[0, 0].mean() > 0.1
    assert meta["culled"]["near"] >= 4


def test_at_the_camera_exactly():
    """z is 0 without rounding, and just off it by every power of ten."""
    scene = base()
    scene["viewmats"] = torch.eye(4).repeat(1, 2, 1, 1)
    scene["means"] = scene["means"] + torch.tensor([0.0, 0.0, 2.0])
    z = torch.tensor([0.0, -0.0, *(s * 10.0**-e for e in range(3, 46, 6) for s in (1, -1))])
    scene["means"][0, : len(z)] = torch.stack([1e-3 * z, -1e-3 * z, z], 1)
    for near in (0.01, 1e-30):
        _, alphas, _, meta = survives(scene, near_plane=near)
        assert alphas.mean() > 0.1
        assert meta["culled"]["near"] >= len(z) + 2


@pytest.mark.parametrize("length", [0.0, 1e-30, 1e-15, 1e15, 1e30, 3e38])
def test_length_of_quaternions(length):
    scene = base()
    scene["quats"] = torch.nn.functional.normalize(scene["quats"], dim=-1)
    want = rasterization(**scene)[0]
    scene["quats"] = scene["quats"] * length
    renders, _, grads, _ = survives(scene)
    assert (grads["quats"] == 0).all() == (length == 0)
    assert ((renders[..., :3] - want).abs().max() < IMAGE) == (length > 0)


@pytest.mark.parametrize("scale", [0.0, 1e-30, 1e-9, 1e-3, 1.0, 1e3, 1e6, 1e12, 1e30])
def test_scales(scale):
    scene = base()
    scene["scales"] = torch.full_like(scene["scales"], scale)
    _, alphas, grads, meta = survives(scene)
    if scale > 1e7:  # the determinant leaves float32's range
        assert meta["culled"]["not_finite"] == 120 and (alphas == 0).all()
    else:
        assert alphas.mean() > (0.99 if scale >= 1 else 0.01)
        assert (grads["means"] != 0).any() and meta["culled"]["not_finite"] == 0


SHAPES = {  # scales and the largest opacity, so that neither nothing is left nor all hidden
    "all sizes": (lambda num: 10 ** (-9 + 12 * torch.rand(1, num, 3)), 0.1),
    "needles": (lambda num: torch.tensor([1.0, 1e-5, 1e-5]).expand(1, num, 3), 0.2),
    "long needles": (lambda num: torch.tensor([1e3, 1e-2, 1e-2]).expand(1, num, 3), 0.1),
    "discs": (lambda num: torch.tensor([1.0, 1e-5, 1.0]).expand(1, num, 3), 0.02),
    "points": (lambda num: 1e-9 * torch.exp(torch.randn(1, num, 3)), 1.0),
}


@pytest.mark.parametrize("shape", SHAPES)
def test_shapes_are_right(shape):
    num = 2000 if shape == "points" else 600
    scales, opacity = SHAPES[shape]
    scene = base(num)
    scene["means"] = scene["means"] * (0.6 if shape == "points" else 1.0)
    scene["scales"] = scales(num).contiguous()
    scene["opacities"] = ALPHA_MIN + opacity * scene["opacities"]
    survives(scene)
    found = both(scene)
    assert found.flipped.float().mean() < FLIPS
    assert_gradients(found, HARD_ROWS)


def test_opacities_around_the_cut():
    """Below alpha_min nothing is drawn; above it, a Gaussian on a pixel's centre is."""
    around = [1 - 1e-6, 1 - 1e-7, 1.0, 1 + 1e-7, 1 + 1e-6, 1.01]
    values = torch.tensor([0.0, *(ALPHA_MIN * x for x in around), 0.5, 1.0])
    scene = base(len(values) * 5, size=0.02)
    scene["opacities"][0] = values.repeat(5)
    _, alphas, grads, _ = survives(scene)
    assert 0.98 < alphas.max() < 1
    drawn = values >= torch.tensor(1.005 * ALPHA_MIN)
    assert (grads["colors"][0].view(5, len(values), 3)[:, drawn] != 0).any((0, 2)).all()
    assert (grads["colors"][0].view(5, len(values), 3)[:, values < ALPHA_MIN] == 0).all()


@pytest.mark.usefixtures("each_device")
def test_at_a_limit_exactly():
    """A pixel of alpha_min itself is drawn, and so is a Gaussian on the near and the far plane."""
    scene = one((0.0, 0.0, 1.0), scale=0.3, opacity=0.6, size=(17, 17), focal=8.0)

    def shown(**changes):
        colors = torch.ones(1, 3, requires_grad=True)
        renders, _, meta = rasterization(**scene | {"colors": colors} | changes)
        renders[0, 8, 2, 0].backward()
        culled = [reason for reason, count in meta["culled"].items() if count]
        return renders[0, 8, 2, 0].item(), colors.grad[0, 0].item(), culled

    alpha, *_ = shown()
    pixel, gradient, _ = shown(alpha_min=alpha)
    assert pixel == alpha and gradient == pytest.approx(alpha)
    assert shown(alpha_min=alpha * (1 + 2**-22))[:2] == (0, 0)
    for limits, culled in (
        ({"near_plane": 1.0, "far_plane": 1.0}, []),
        ({"near_plane": 1 + 2**-23}, ["near"]),
        ({"far_plane": 1 - 2**-24}, ["far"]),
        ({"opacities": torch.tensor([ALPHA_MIN])}, ["small"]),  # its box is a point
    ):
        assert shown(**limits)[2] == culled


@pytest.mark.parametrize("opacity", [1.5, 1e30, 3e38])
def test_opacities_beyond_one(opacity):
    scene = base()
    scene["opacities"][:] = opacity
    _, alphas, grads, meta = survives(scene)
    assert alphas.mean() > 0.3 and meta["culled"]["not_finite"] == 0
    assert (grads["colors"] != 0).any()


def test_ten_thousand_at_one_pixel():
    """Most are hidden: a pixel stops after a few."""
    scene = base(10_000)
    scene["means"] = 1e-4 * torch.randn(1, 10_000, 3)
    scene["scales"] = torch.full((1, 10_000, 3), 1e-4)
    _, alphas, grads, meta = survives(scene)
    assert alphas.max() > 0.99
    assert meta["pairs"] >= 20_000
    assert 0 < (grads["colors"] != 0).any(-1).sum() < 5000


def test_a_thousand_faint_ones_at_one_pixel():
    """None is hidden: long sums, and the light falls by a percent at a time."""
    num = 1000
    scene = base(num)
    scene["means"] = 0.01 * torch.randn(1, num, 3)
    scene["scales"] = 0.2 * torch.exp(0.3 * torch.randn(1, num, 3))
    scene["opacities"] = torch.full((1, num), 5 * ALPHA_MIN)
    survives(scene)
    found = both(scene)
    assert_gradients(found, HARD_ROWS)


def test_one_gaussian_over_all_pixels():
    scene = base(1, width=515, height=390)
    scene["means"][:], scene["scales"][:], scene["opacities"][:] = 0.0, 50.0, 0.7
    _, alphas, grads, meta = survives(scene)
    assert (alphas - 0.7).abs().max() < 1e-3
    assert meta["pairs"] == meta["tiles"] == 2 * 33 * 25
    generator = torch.Generator().manual_seed(1)
    v = torch.randn(1, 2, 390, 515, 4, generator=generator).double()
    want = (alphas.double() * v[..., :3]).sum((1, 2, 3))
    assert (grads["colors"][0].double() - want).abs().max() < 1e-5 * want.abs().max()


def test_equal_depths():
    """All in a plane before the camera: order is by index, as in the oracle."""
    scene = base(400)
    scene["viewmats"] = torch.eye(4).repeat(1, 2, 1, 1)
    scene["means"][..., 2] = 1.5
    survives(scene)
    found = both(scene, "RGB+D")
    assert (found.meta["depths"] == 1.5).sum() > 500 and found.flipped.sum() <= 1
    assert_gradients(found)
    back = {k: v.flip(1) if k in GAUSSIAN else v for k, v in scene.items()}
    change = rasterization(**back)[0] - found.got[1][..., :3]
    assert change.abs().max() > 0.01, "order has no effect"


@pytest.mark.parametrize(
    "name, value, reason",
    [
        *((n, x, "not_finite") for n in GAUSSIAN for x in (math.nan, math.inf, -math.inf)),
        *(("scales", 1e30, "not_finite"), ("means", 1e20, None)),
        *(("opacities", -1.0, "transparent"), ("opacities", 1e-3, "transparent")),
    ],
)
def test_bad_gaussians_are_left_out_and_counted(name, value, reason):
    """Every entry of an input, each in another Gaussian: the rest stays, to the bit."""
    scene = base(90)
    bad = mapped(scene, torch.Tensor.clone)
    flat = bad[name][0].view(90, -1)
    size = flat.shape[1]
    for entry in range(size):
        flat[entry * 3, entry] = value
    place = torch.arange(size) * 3
    keep = torch.ones(90, dtype=torch.bool)
    keep[place] = False
    rest = {k: v[:, keep] if k in GAUSSIAN else v for k, v in scene.items()}
    renders, alphas, grads, meta = survives(bad)
    want, _, want_grads, _ = survives(rest)
    assert torch.equal(renders, want) and alphas.mean() > 0.1
    assert reason is None or meta["culled"][reason] == 2 * size
    for key in NAMES:
        got = grads[key][:, keep] if key in GAUSSIAN else grads[key]
        assert key not in GAUSSIAN or (grads[key][:, place] == 0).all(), key
        if key == "viewmats":  # summed over Gaussians, culled ones too, in another order
            assert torch.allclose(got, want_grads[key], rtol=1e-4, atol=1e-3)
        else:
            assert torch.equal(got, want_grads[key]), key


@pytest.mark.parametrize("value", [math.nan, math.inf])
@pytest.mark.parametrize(
    "name, entry", [("viewmats", (0, 1)), ("viewmats", (2, 3)), ("Ks", (0, 0)), ("Ks", (1, 2))]
)
def test_camera_not_finite(name, entry, value):
    """Its view is empty, the other stays to the bit."""
    scene = base()
    clean, *_ = render(scene)
    scene[name][(0, 1, *entry)] = value
    renders, alphas, grads, meta = survives(scene)
    assert meta["culled"]["not_finite"] == 60 and (alphas[0, 1] == 0).all()
    assert torch.equal(renders[0, 0], clean[0, 0]) and alphas[0, 0].mean() > 0.1
    assert (grads["viewmats"][0, 1] == 0).all() and (grads["viewmats"][0, 0] != 0).any()


def test_background_not_finite():
    """The background is drawn as given, in its view and channel alone."""
    scene = base()
    clean = rasterization(**scene)
    scene["backgrounds"][0, 1, 2] = math.nan
    renders, alphas, _ = rasterization(**scene)
    assert torch.equal(alphas, clean[1]) and renders[0, 1, ..., 2].isnan().all()
    assert torch.equal(renders[0, 0], clean[0][0, 0])
    assert torch.equal(renders[0, 1, ..., :2], clean[0][0, 1, ..., :2])


@pytest.mark.parametrize("value", [math.nan, math.inf])
@pytest.mark.parametrize("name", ["means", "colors", "scales"])
def test_bad_gaussians_with_harmonics(name, value):
    scene = base()
    scene["colors"] = 0.4 * torch.randn(1, 60, 16, 3)
    scene[name][0, ::7] = value
    _, alphas, grads, meta = survives(scene, sh_degree=3)
    assert alphas.mean() > 0.1 and meta["culled"]["not_finite"] == 18
    assert (grads["means"][0, ::7] == 0).all() and (grads["viewmats"] != 0).any()


# one pixel beyond a multiple of the tile: the last row or column of tiles is one pixel wide
SIZES = [(1, 1), (1, 2000), (2000, 1), (15, 17), (20, 33), (16, 16), (17, 48), (33, 5)]


@pytest.mark.parametrize("width, height", SIZES)
def test_sizes(width, height):
    scene = base(300, width=width, height=height, size=0.15)
    scene["opacities"] = scene["opacities"] * 0.03
    survives(scene)
    found = both(scene, "RGB+ED")
    assert found.got[1].shape == (1, 2, height, width, 4) and found.flipped.sum() <= 4
    assert_gradients(found)


@pytest.mark.parametrize("center", [(-40.0, 20.0), (37.5, 130.0), (1e4, 0.0)])
def test_principal_point_outside(center):
    scene = base(400)
    scene["Ks"][..., 0, 2], scene["Ks"][..., 1, 2] = center
    survives(scene)
    if center[0] > 1e3:
        assert rasterization(**scene)[2]["culled"]["outside"] == 800
        return
    scene["scales"] = scene["scales"] * 8
    found = both(scene, "RGB+D")
    assert found.flipped.sum() <= 2
    assert_gradients(found)


@pytest.mark.parametrize("views", [(), (2,)])
def test_permutation_at_size(views):
    """Thousands of Gaussians, some culled, some hidden, also colours per view: the same bits."""
    num = 3000
    scene = make(2, 2, num, width=70, height=50, size=0.05)
    scene["colors"] = torch.rand(2, *views, num, 3)
    scene["means"] = scene["means"] * 2
    order = torch.randperm(num)

    def turned(name, x):
        return x[..., order, :] if name == "colors" else x[:, order] if name in GAUSSIAN else x

    a, b = render(scene), render({k: turned(k, v) for k, v in scene.items()})
    assert a[1].mean() > 0.5 and torch.equal(a[0], b[0]) and torch.equal(a[1], b[1])
    for name in GAUSSIAN:
        assert torch.equal(turned(name, a[2][name]), b[2][name]), name
