"""The rasterizer against gsplat's own torch functions: somebody else's code for the same maths.

They run on the CPU: projection, harmonics, tile lists and ``accumulate``, which blends given pairs
of pixels and Gaussians (with two functions of nerfacc, written in helpers/raster.py). gsplat clamps
alpha at 0.999 there, so opacities stay below 0.99, and never stops, so pixels are kept from
saturating.
"""

import importlib.util
import sys

import pytest
import torch
from helpers import assert_rel_rms
from helpers.raster import NAMES, leaves, make, nerfacc, visible_pairs

from gamba_warp.kernels.rasterize import rasterization
from gamba_warp.kernels.rasterize.constants import ALPHA_MIN, TILE
from gamba_warp.kernels.rasterize.harmonics import colors_from_harmonics

if importlib.util.find_spec("gsplat") is None:
    pytest.skip("needs the package gsplat (pip install gsplat==1.5.3)", allow_module_level=True)
from gsplat.cuda import _torch_impl as gsplat

EXACT = 1e-5  # float32 against float64: a few hundred roundings
GRADIENT = 1e-4


# Small operations: on a busy machine threads would only wait.
pytestmark = pytest.mark.usefixtures("one_thread")


def scene_of(num=300, **changes):
    scene = make(2, 2, num, **{"width": 70, "height": 45, "size": 0.04, **changes})
    scene["opacities"] = 0.02 + 0.5 * torch.rand(2, num)
    del scene["backgrounds"]
    return scene


def wide_scene():
    """Centres beside the picture, where the Jacobian is clamped, and behind the camera."""
    scene = scene_of(size=0.1)
    scene["means"] = scene["means"] * 4
    scene["Ks"][..., 0, 0] *= 0.4
    return scene


def project(scene, antialiased=False):
    """gsplat's radii, means2d, depths, conics and compensations, in the scene's dtype."""
    covars, _ = gsplat._quat_scale_to_covar_preci(scene["quats"], scene["scales"], True, False)
    names = ("viewmats", "Ks", "width", "height")
    return gsplat._fully_fused_projection(
        scene["means"], covars, *(scene[k] for k in names), calc_compensations=antialiased
    )


def plain_conics(conics):
    """Ours, (a, k, e) of a (dx + k dy)² + e dy², as gsplat's xx, xy, yy of the inverse."""
    a, k, e = conics.unbind(-1)
    return torch.stack([a, a * k, a * k * k + e], -1)


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("build", [scene_of, wide_scene])
def test_projection_and_its_gradients(build, antialiased):
    scene = build()
    got, want = leaves(scene, torch.float32), leaves(scene, torch.float64)
    kind = "antialiased" if antialiased else "classic"
    meta = rasterization(**got, rasterize_mode=kind)[2]
    radii, means2d, depths, conics, compensations = project(want, antialiased)
    seen = (meta["radii"] > 0).all(-1)
    assert seen.float().mean() > (0.1 if build is wide_scene else 0.8)
    if build is wide_scene:
        assert meta["culled"]["near"] > 100
    opacities = want["opacities"][:, None].expand_as(depths)
    if antialiased:
        opacities = opacities * compensations
        seen = seen & (compensations > 0.01)  # ours has a floor, theirs has none
    ours = [meta["means2d"], plain_conics(meta["conics"]), meta["depths"], meta["opacities"]]
    theirs = [means2d, conics, depths, opacities]
    ours, theirs = ([x[seen] for x in side] for side in (ours, theirs))
    for name, a, b in zip(("means2d", "conics", "depths", "opacities"), ours, theirs):
        assert (a - b).abs().max() <= EXACT * b.abs().max(), name
    v = [torch.randn_like(x) / x.detach().abs().max() for x in ours]
    sum((x * c).sum() for x, c in zip(ours, v)).backward()
    sum((x * c).sum() for x, c in zip(theirs, v)).backward()
    for name in ("means", "quats", "scales", "opacities", "viewmats"):
        assert_rel_rms(got[name].grad, want[name].grad, GRADIENT, name)


def test_covariances():
    """Without a perspective to speak of, the conic is the inverse of the covariance's corner."""
    scene = scene_of(50)
    scene["viewmats"] = torch.eye(4).repeat(2, 2, 1, 1)
    distance, focal = 1e4, 2e5
    scene["viewmats"][..., 2, 3] = distance
    scene["Ks"] = torch.tensor([[focal, 0, 35], [0, focal, 22.5], [0, 0, 1]]).repeat(2, 2, 1, 1)
    conics = plain_conics(rasterization(**scene)[2]["conics"].double())
    xx, xy, yy = conics.unbind(-1)
    inverse = torch.stack([torch.stack([xx, xy], -1), torch.stack([xy, yy], -1)], -2)
    got = torch.linalg.inv(inverse) - 0.3 * torch.eye(2)
    covars, _ = gsplat._quat_scale_to_covar_preci(
        scene["quats"].double(), scene["scales"].double(), True, False
    )
    want = covars[:, None, :, :2, :2] * (focal / distance) ** 2
    assert want.abs().max() > 0.3
    assert (got - want).abs().max() < 1e-4 * want.abs().max()


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_harmonics(degree):
    means = torch.randn(2, 40, 3, dtype=torch.float64)
    coefficients = torch.randn(2, 40, 16, 3, dtype=torch.float64)
    viewmats = make(2, 3)["viewmats"].double()
    got = colors_from_harmonics(degree, coefficients, means, viewmats)
    centers = -(viewmats[..., :3, :3].mT @ viewmats[..., :3, 3:])[..., 0]
    directions = means[:, None] - centers[:, :, None]
    wide = coefficients[:, None].expand(2, 3, 40, 16, 3)
    want = (gsplat._spherical_harmonics(degree, directions, wide) + 0.5).clamp_min(0)
    assert got.std() > 0.1
    assert (got - want).abs().max() < 1e-9  # gsplat gives its constants with 15 digits


def tile_sets(meta, tiles):
    """Our pairs as a set of numbers tile * Gaussians + Gaussian, from the lists themselves."""
    bins = meta.bins
    tile = torch.repeat_interleave(torch.arange(tiles), bins.starts.diff().long())
    return tile * meta["depths"].numel() + bins.pairs


def best_alphas(meta, tile_pairs, grid, width, height):
    """The largest alpha of each (tile, Gaussian) pair over the tile's pixels, in float64."""
    tiles_x, tiles_y = grid
    tile, gaussian = tile_pairs // meta["depths"].numel(), tile_pairs % meta["depths"].numel()
    mean = meta["means2d"].reshape(-1, 2).double()[gaussian]
    a, k, e = meta["conics"].reshape(-1, 3).double()[gaussian, :, None].unbind(1)
    inside = torch.arange(TILE * TILE)
    x = (tile % tiles_x * TILE)[:, None] + inside % TILE
    y = (tile // tiles_x % tiles_y * TILE)[:, None] + inside // TILE
    dx, dy = x + 0.5 - mean[:, :1], y + 0.5 - mean[:, 1:]
    q = a * (dx + k * dy) ** 2 + e * dy * dy
    alpha = meta["opacities"].flatten().double()[gaussian, None] * torch.exp(-0.5 * q)
    return torch.where((x < width) & (y < height), alpha, 0.0).amax(1)


@pytest.mark.parametrize("size, width, height", [(0.02, 70, 45), (0.08, 97, 49), (0.3, 64, 33)])
def test_tile_lists(size, width, height):
    """Ours are a part of gsplat's, and no pixel has alpha_min of a pair that we leave out."""
    scene = scene_of(150, size=size, width=width, height=height)
    scene["scales"][..., 0] *= 4  # longish ones, or the exact test has little to do
    meta = rasterization(**scene)[2]
    grid = -(-width // TILE), -(-height // TILE)
    tiles = grid[0] * grid[1]
    radii, means2d, depths, _, _ = project(scene)
    _, isect_ids, flatten_ids = gsplat._isect_tiles(means2d, radii, depths, TILE, *grid)
    offsets = gsplat._isect_offset_encode(isect_ids, 4, *grid).flatten()
    ends = torch.cat([offsets[1:], torch.tensor([len(flatten_ids)])])
    tile = torch.repeat_interleave(torch.arange(4 * tiles), (ends - offsets).long())
    theirs = tile * depths.numel() + flatten_ids
    ours = tile_sets(meta, 4 * tiles)
    assert len(ours) == len(ours.unique()) and len(theirs) == len(theirs.unique())
    assert 200 < len(ours) < 0.95 * len(theirs)
    assert torch.isin(ours, theirs).all()
    dropped = theirs[~torch.isin(theirs, ours)]
    assert len(dropped) > 100
    assert (best_alphas(meta, dropped, grid, width, height) < ALPHA_MIN).all()
    kept = best_alphas(meta, ours, grid, width, height) >= ALPHA_MIN
    assert kept.float().mean() > 0.9, "few pairs are in our lists for nothing"


@pytest.mark.parametrize("antialiased", [False, True])
def test_pictures_and_gradients(monkeypatch, antialiased):
    """Their projection and blending from end to end, in float64."""
    monkeypatch.setitem(sys.modules, "nerfacc", nerfacc())
    scene = scene_of(120, width=40, height=33)
    got, want = leaves(scene, torch.float32), leaves(scene, torch.float64)
    kind = "antialiased" if antialiased else "classic"
    renders, alphas, _ = rasterization(**got, rasterize_mode=kind)
    projected = project(want, antialiased)
    opacities = want["opacities"][:, None].expand(2, 2, 120)
    if antialiased:
        opacities = opacities * projected[4].clamp_min(0.005)
    with torch.no_grad():
        pairs = visible_pairs(projected, opacities, 40, 33)
    colors = want["colors"][:, None].expand(2, 2, 120, 3)
    expected, alpha = gsplat.accumulate(
        projected[1], projected[3], opacities, colors, *pairs, 40, 33
    )
    assert 0.1 < alpha.mean() and alpha.max() < 0.9999
    assert (renders - expected).abs().max() < EXACT and (alphas - alpha).abs().max() < EXACT
    v = [torch.randn_like(x) for x in (renders, alphas)]
    torch.autograd.backward([renders, alphas], v)
    torch.autograd.backward([expected, alpha], [x.double() for x in v])
    for name in NAMES[:6]:
        assert_rel_rms(got[name].grad, want[name].grad, GRADIENT, name)
