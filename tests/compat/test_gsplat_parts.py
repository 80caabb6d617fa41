"""The lower calls of the gsplat interface against gsplat's own torch functions, by name.

They run on the CPU; ``accumulate``, which blends given pairs of pixels and Gaussians, asks for two
functions of nerfacc, written here.
"""

import sys
import types

import pytest
import torch
from helpers import assert_rel_rms
from helpers.raster import leaves, make, mapped

from gamba_warp.compat import gsplat as compat
from gamba_warp.kernels.rasterize.constants import ALPHA_MIN, COMPENSATION_MIN

NEEDED = "needs the package gsplat (pip install gsplat==1.5.3)"
gsplat = pytest.importorskip("gsplat.cuda._torch_impl", reason=NEEDED)


def alphas_of(means2d, conics, opacities, width, height):
    """Alphas ``[H W, N]`` before any cut; conics are gsplat's xx, xy, yy."""
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    dx, dy = (torch.stack([x, y], -1).view(-1, 1, 2) - means2d).unbind(-1)
    xx, xy, yy = conics.unbind(-1)
    return opacities * torch.exp(-0.5 * (xx * dx * dx + 2 * xy * dx * dy + yy * dy * dy))


def weights_by_pixel(means2d, conics, opacities, width, height):
    """Centres of every pixel by itself ``[H W, N, 2]`` and their weights ``[H W, N]``, in float64.

    Gaussians come front to back; conics are gsplat's xx, xy, yy. The gradient of the centres, a
    leaf, has a row for each pixel.
    """
    each = means2d.detach().double().expand(height * width, *means2d.shape).clone().requires_grad_()
    alpha = alphas_of(each, conics.double(), opacities.double(), width, height).clamp_max(0.999)
    alpha = torch.where(alpha >= ALPHA_MIN, alpha, 0.0)
    after = (1 - alpha).cumprod(1)
    return each, torch.where(after > 1e-4, after / (1 - alpha) * alpha, 0.0)


def nerfacc():
    """The two functions of nerfacc that gsplat's ``accumulate`` asks for; pairs come ray by ray."""

    def render_weight_from_alpha(alphas, ray_indices, n_rays):
        first = torch.searchsorted(ray_indices, torch.arange(n_rays))
        light = torch.log1p(-alphas)
        before = torch.cumsum(light, 0) - light
        transmittances = torch.exp(before - before[first[ray_indices]])
        return transmittances * alphas, transmittances

    def accumulate_along_rays(weights, values, ray_indices, n_rays):
        values = weights[:, None] if values is None else weights[:, None] * values
        return values.new_zeros(n_rays, values.shape[-1]).index_add(0, ray_indices, values)

    module = types.ModuleType("nerfacc")
    module.render_weight_from_alpha = render_weight_from_alpha
    module.accumulate_along_rays = accumulate_along_rays
    return module


def visible_pairs(projected, opacities, width, height):
    """Every (image, pixel, Gaussian) with alpha >= alpha_min, ray by ray and front to back."""
    _, means2d, depths, conics, _ = projected
    images, num = depths.flatten(0, 1).shape
    means2d, conics = means2d.view(images, num, 2), conics.view(images, num, 3)
    order = torch.argsort(depths.view(images, num), stable=True)
    parts = []
    for image in range(images):
        own = (x[image, order[image]] for x in (means2d, conics, opacities.view(images, num)))
        alpha = alphas_of(*own, width, height)
        pixel, rank = (alpha >= ALPHA_MIN).nonzero(as_tuple=True)
        parts.append((order[image][rank], pixel, torch.full_like(pixel, image)))
    return tuple(torch.cat(p) for p in zip(*parts))


pytestmark = pytest.mark.usefixtures("one_thread")
# float32 against float64: a few hundred roundings. The kernel's factor of antialiasing multiplies
# rows of up to 30 pixels that may be nearly parallel, 30 / sqrt(eps2d) roundings.
EXACT = 1e-5
GRADIENT = 1e-4  # as above, with factors up to 1 / (1 - alpha)
WIDTH, HEIGHT = 39, 27
GEOMETRY = ("means", "quats", "scales", "viewmats")
NUM = 63
KINDS = {
    "tiny": (1e-4, 2e-4, 5e-5),
    "speck": (1e-12, 1e-12, 1e-12),
    "needle": (0.2, 1e-5, 1e-5),
    "thread": (0.2, 1e-9, 1e-9),
    "flat": (0.1, 0.1, 1e-6),
    "line": (0.1, 0.0, 0.0),
    "point": (0.0, 0.0, 0.0),
}


def scene_of(num=61):
    scene = make(1, 2, num, width=WIDTH, height=HEIGHT, size=0.05)
    scene["opacities"] = 0.02 + 0.5 * torch.rand(1, num)  # gsplat's accumulate never stops
    del scene["backgrounds"]
    return scene


def tiny_of(kind):
    """A scene of Gaussians whose factor of antialiasing goes down to 0."""
    scene = make(1, 2, NUM, width=WIDTH, height=HEIGHT, size=0.05)
    spread = torch.logspace(-1, 1, NUM)[:, None]  # from a tenth of the sizes to ten times
    scene["scales"] = (torch.tensor(KINDS[kind]) * spread)[None]
    if kind == "flat":  # nearly or exactly from the edge
        scene["viewmats"][..., :3, :3] = torch.eye(3)
        scene["viewmats"][..., :3, 3] = torch.tensor([0.0, 0.0, 1.6])
        scene["means"][..., 0] *= 0.1 * (torch.arange(NUM) % 3)
        scene["quats"] = torch.tensor([0.5**0.5, 0.0, 0.5**0.5, 0.0]).expand(1, NUM, 4).clone()
    return scene


def twice(made):
    """Leaves in float32 for ours, and in float64 for theirs."""
    return (leaves({"Ks": torch.zeros(1), **made}, t) for t in (torch.float32, torch.float64))


def project(scene, by="quats", **options):
    """Our projection of a scene, from quats and scales or from their covariances."""
    shape = None, scene["quats"], scene["scales"]
    if by == "covars":
        wide = scene["quats"].double(), scene["scales"].double()
        shape = compat.quat_scale_to_covar_preci(*wide, triu=True)[0].float(), None, None
    cameras = scene["viewmats"], scene["Ks"], WIDTH, HEIGHT
    return compat.fully_fused_projection(scene["means"], *shape, *cameras, **options)


def project_there(scene, covars=None, **options):
    """gsplat's projection of a scene in float64."""
    if covars is None:
        shape = scene["quats"], scene["scales"]
        covars = gsplat._quat_scale_to_covar_preci(*shape, True, False)[0]
    cameras = (scene[k] for k in ("viewmats", "Ks", "width", "height"))
    return gsplat._fully_fused_projection(scene["means"], covars, *cameras, **options)


def compare(ours, theirs, got, want, names, limit=GRADIENT):
    """Random cotangents on both sides; the gradients of the leaves by name."""
    v = [torch.randn_like(x) / x.detach().abs().max().clamp_min(1e-3) for x in ours]
    torch.autograd.backward(ours, v)
    torch.autograd.backward(theirs, [x.double() for x in v])
    for name in names:
        assert got[name].grad.abs().max() > 0, name
        assert_rel_rms(got[name].grad, want[name].grad, limit, name)


@pytest.mark.parametrize("triu", [False, True])
def test_covariances_and_precisions(triu):
    made = dict(quats=torch.randn(3, 7, 4), scales=torch.rand(3, 7, 3) + 0.1)
    got, want = twice(made)
    ours = compat.quat_scale_to_covar_preci(got["quats"], got["scales"], triu=triu)
    theirs = gsplat._quat_scale_to_covar_preci(want["quats"], want["scales"], triu=triu)
    for a, b in zip(ours, theirs):
        assert a.shape == b.shape
        assert (a - b).abs().max() <= EXACT * b.abs().max()
    compare(ours, theirs, got, want, made)
    some = compat.quat_scale_to_covar_preci(made["quats"], made["scales"], False, True)
    assert some[0] is None and some[1].shape == (3, 7, 3, 3)


@pytest.mark.parametrize("degree", [0, 1, 2, 3, 4])
def test_harmonics(degree):
    made = dict(dirs=torch.randn(5, 7, 3), coeffs=torch.randn(5, 7, 25, 3))
    got, want = twice(made)
    ours = compat.spherical_harmonics(degree, got["dirs"], got["coeffs"])
    theirs = gsplat._spherical_harmonics(degree, want["dirs"], want["coeffs"])
    assert (ours - theirs).abs().max() < EXACT * 10  # up to 25 terms of size 3
    compare([ours], [theirs], got, want, ["dirs", "coeffs"][1 - bool(degree) :])
    mask = torch.arange(7).expand(5, 7) % 2 == 0
    masked = compat.spherical_harmonics(degree, got["dirs"], got["coeffs"], mask)
    assert (masked[:, 1::2] == 0).all() and torch.equal(masked[:, ::2], ours[:, ::2])


@pytest.mark.parametrize("by", ["quats", "covars"])
@pytest.mark.parametrize("compensated", [False, True])
def test_projection(by, compensated):
    scene = scene_of()
    scene["means"][..., :9, :] *= 9  # beside the image and behind the camera
    got, want = twice(scene)
    found = project(got, by, calc_compensations=compensated)
    expected = project_there(want, calc_compensations=compensated)
    seen, theirs = ((x[0] > 0).all(-1) for x in (found, expected))
    assert 0.5 < seen.float().mean() < 1
    assert not (seen & ~theirs).any()
    assert (theirs & ~seen).sum() <= 2, "culled where the rounded box alone meets the image"
    assert found[0].dtype == torch.int32 and (found[0] - expected[0])[seen].abs().max() <= 1
    ours, theirs = ([x[seen] for x in side[1:] if x is not None] for side in (found, expected))
    assert len(ours) == 3 + compensated
    for name, a, b in zip(("means2d", "depths", "conics", "compensations"), ours, theirs):
        assert (a - b).abs().max() <= EXACT * b.abs().max(), name
    compare(ours, theirs, got, want, GEOMETRY)


def test_packed_projection():
    scene = scene_of()
    scene["means"][..., :9, :] *= 9
    options = dict(radius_clip=4.0, opacities=scene["opacities"])
    dense, packed = (project(scene, packed=packed, **options) for packed in (False, True))
    at, rest = packed[:3], packed[3:]
    seen = (dense[0] > 0).all(-1)
    assert 20 < seen.sum() < 110 and (dense[0][seen] > 4).any(-1).all()
    assert torch.equal(torch.stack(at, -1), seen.nonzero())
    for a, b in zip(rest[:4], dense):
        assert torch.equal(a, b[seen])
    assert rest[4] is None


@pytest.mark.parametrize("packed", [False, True])
def test_lists_of_tiles(packed):
    images, num, tile, grid = 3, 47, 16, (3, 4)
    means2d = torch.randn(images, num, 2) * 40
    radii = torch.randint(0, 40, (images, num, 2), dtype=torch.int32)
    depths = torch.rand(images, num)
    counts, ids, rows = gsplat._isect_tiles(means2d, radii, depths, tile, *grid)
    if packed:
        flat = means2d.flatten(0, 1), radii.flatten(0, 1), depths.flatten()
        image = torch.arange(images).repeat_interleave(num)
        extra = dict(packed=True, n_images=images, image_ids=image, gaussian_ids=image)
        found = compat.isect_tiles(*flat, tile, *grid, **extra)
        counts = counts.flatten()
    else:
        found = compat.isect_tiles(means2d, radii, depths, tile, *grid)
    for a, b in zip(found, (counts, ids, rows)):
        assert a.dtype == b.dtype and torch.equal(a, b)
    offsets = compat.isect_offset_encode(found[1], images, *grid)
    assert torch.equal(offsets, gsplat._isect_offset_encode(ids, images, *grid))


def lists_of(projected, tile):
    radii, means2d, depths, _, _ = projected
    columns, lines = -(-WIDTH // tile), -(-HEIGHT // tile)
    _, ids, rows = compat.isect_tiles(means2d, radii, depths, tile, columns, lines)
    offsets = compat.isect_offset_encode(ids, means2d[..., 0, 0].numel(), columns, lines)
    return offsets.view(*means2d.shape[:-2], lines, columns), rows


def blended(monkeypatch, scene, channels):
    """Return float64 leaves of the image's parts, and gsplat's accumulate of them."""
    monkeypatch.setitem(sys.modules, "nerfacc", nerfacc())
    projected = project(scene)
    num = scene["means"].shape[-2]
    opacities = scene["opacities"][:, None].repeat(1, 2, 1)
    colors = torch.randn(1, 2, num, channels)
    parts = dict(means2d=projected[1], conics=projected[3], opacities=opacities, colors=colors)
    got, want = twice({**parts, "backgrounds": torch.rand(1, 2, channels)})
    with torch.no_grad():
        wide = tuple(x.double() for x in projected[:4])
        pairs = visible_pairs((*wide, None), want["opacities"], WIDTH, HEIGHT)
    seen = ((projected[0] > 0).all(-1)).flatten()[pairs[2] * num + pairs[0]]
    pairs = tuple(x[seen] for x in pairs)
    names = ("means2d", "conics", "opacities", "colors")
    image, alphas = gsplat.accumulate(*(want[k] for k in names), *pairs, WIDTH, HEIGHT)
    image = image + (1 - alphas) * want["backgrounds"][..., None, None, :]
    return projected, got, want, image, alphas


@pytest.mark.parametrize("tile, channels", [(16, 3), (5, 2), (20, 7), (32, 3)])
@pytest.mark.parametrize("packed", [False, True])
def test_pixels(monkeypatch, tile, channels, packed):
    """Tiles of any size, also unlike ours."""
    projected, got, want, expected, alphas = blended(monkeypatch, scene_of(), channels)
    names = ("means2d", "conics", "colors", "opacities")
    offsets, rows = lists_of(projected, tile)
    given = [got[k] for k in names]
    if packed:
        seen = (projected[0] > 0).all(-1)
        given = [x[seen] for x in given]
        rows = (seen.flatten().cumsum(0) - 1)[rows.long()].int()
    lists = WIDTH, HEIGHT, tile, offsets, rows
    found, alpha = compat.rasterize_to_pixels(*given, *lists, got["backgrounds"], packed=packed)
    assert 0.1 < alphas.mean() and alphas.max() < 0.9999
    assert (found - expected).abs().max() < 3 * EXACT  # colours of size 3
    assert (alpha - alphas).abs().max() < EXACT
    compare([found, alpha], [expected, alphas], got, want, (*names, "backgrounds"))


@pytest.mark.parametrize("tile", [16, 5])
def test_masked_tiles(tile):
    scene = scene_of()
    projected = project(scene)
    offsets, rows = lists_of(projected, tile)
    masks = torch.rand(offsets.shape) < 0.5
    colors, opacities = torch.rand(1, 2, 61, 3), scene["opacities"][:, None].repeat(1, 2, 1)
    given = projected[1], projected[3], colors, opacities, WIDTH, HEIGHT, tile, offsets, rows
    whole, masked = (compat.rasterize_to_pixels(*given, masks=m)[0] for m in (None, masks))
    wide = masks.repeat_interleave(tile, 2).repeat_interleave(tile, 3)[..., :HEIGHT, :WIDTH]
    assert torch.equal(masked, whole * wide[..., None]) and (whole > 0).any()


@pytest.mark.parametrize("tile", [16, 20])
def test_absolute_gradients(tile):
    """Against the gradient of every pixel by itself, in float64."""
    width, height, num = 21, 18, 13
    torch.manual_seed(5)
    means2d = torch.rand(1, num, 2) * torch.tensor([width, height])
    conics = torch.tensor([0.05, 0.02, 0.09]) * (0.5 + torch.rand(1, num, 1))
    opacities, colors = 0.9 + 0.15 * torch.rand(1, num), torch.randn(1, num, 2)  # some are clamped
    radii = torch.full((1, num, 2), 40, dtype=torch.int32)
    depths = torch.arange(num).float()[None]
    grid = -(-width // tile), -(-height // tile)
    _, ids, rows = compat.isect_tiles(means2d, radii, depths, tile, *grid)
    offsets = compat.isect_offset_encode(ids, 1, *grid)
    v = [torch.randn(1, height, width, n) for n in (2, 1)]
    means2d.requires_grad_()
    given = means2d, conics, colors, opacities, width, height, tile, offsets, rows
    torch.autograd.backward(compat.rasterize_to_pixels(*given, absgrad=True), v)

    each, weights = weights_by_pixel(means2d[0], conics[0], opacities[0], width, height)
    assert weights.max() > 0.9989, "some are clamped"
    upstream = (weights @ colors[0].double(), weights.sum(1, keepdim=True))
    torch.autograd.backward(upstream, [x.double().flatten(0, 2) for x in v])
    assert_rel_rms(means2d.grad[0], each.grad.sum(0), GRADIENT, "means2d")
    assert_rel_rms(means2d.absgrad[0], each.grad.abs().sum(0), GRADIENT, "absgrad")
    assert means2d.absgrad.sum() > 1.2 * means2d.grad.abs().sum(), "the signs matter here"


def test_refusals():
    scene = scene_of(3)
    given = [scene["means"], None, scene["quats"], scene["scales"], scene["viewmats"], scene["Ks"]]
    call = compat.fully_fused_projection
    for name, value in (("camera_model", "fisheye"), ("sparse_grad", True)):
        with pytest.raises(ValueError, match=f"^{name} (must|is supported only)"):
            call(*given, WIDTH, HEIGHT, **{name: value})
    with pytest.raises(ValueError, match="covars must have shape"):
        call(scene["means"], torch.zeros(1, 3, 3, 3), *given[2:], WIDTH, HEIGHT)
    points = torch.zeros(1, 1, 3), torch.zeros(1, 1, 3, 3), scene["Ks"][0]
    with pytest.raises(ValueError, match="camera_model is .* only as 'pinhole', got 'ortho'"):
        compat.proj(*points, 4, 4, "ortho")
    parts = torch.zeros(1, 3, 2), torch.ones(1, 3, 3), torch.zeros(1, 3, 3), torch.zeros(1, 3)
    lists = torch.zeros(1, 1, 1, dtype=torch.int32), torch.tensor([3], dtype=torch.int32)
    with pytest.raises(ValueError, match="flatten_ids goes from 3 to 3"):
        compat.rasterize_to_pixels(*parts, 4, 4, 16, *lists)


def faint(kind, by="quats"):
    """Return leaves and projections of both, and the visible Gaussians."""
    got, want = twice(tiny_of(kind))
    covars = None
    if by == "covars":  # the same rounded covariances
        wide = want["quats"], want["scales"]
        covars = compat.quat_scale_to_covar_preci(*wide, True, False)[0].float().double()
    found = project(got, by, calc_compensations=True)
    expected = project_there(want, covars, calc_compensations=True)
    seen = (found[0] > 0).all(-1)
    assert seen.float().mean() > 0.5 and not (seen & ~(expected[0] > 0).all(-1)).any()
    return got, want, found, expected, seen


@pytest.mark.parametrize("by", ["quats", "covars"])
@pytest.mark.parametrize("kind", KINDS)
def test_factor_is_that_of_gsplat(kind, by):
    got, _, found, expected, seen = faint(kind, by)
    ours, theirs = found[4][seen], expected[4].detach()[seen]
    # theirs is the root of a difference, of which float64 leaves sqrt(1e-16) times the pixels
    limit = EXACT if by == "quats" else 1e-6
    assert (ours - theirs).abs().max() <= limit
    assert (theirs < COMPENSATION_MIN).sum() > 10 and (ours >= 0).all()
    ours.sum().backward()
    for name in GEOMETRY:
        assert got[name].grad.isfinite().all(), name


@pytest.mark.parametrize("kind", ["tiny", "needle", "flat"])
def test_gradients_of_small_factors_are_those_of_gsplat(kind):
    got, want, found, expected, seen = faint(kind)
    small = seen & (found[4] < COMPENSATION_MIN) & (found[4] > 1e-6)
    assert small.sum() > 10
    v = torch.randn(int(small.sum()))
    found[4][small].backward(v)
    expected[4][small].backward(v.double())
    for name in GEOMETRY:
        assert want[name].grad.abs().max() > 0, name
        assert_rel_rms(got[name].grad, want[name].grad, GRADIENT, name)


@pytest.mark.parametrize("by", ["quats", "covars"])
def test_images_cull_by_the_true_factor(by):
    """Opaque needles with a factor below 1 / 255 are not drawn."""
    scene = tiny_of("needle")
    scene["opacities"][:] = 0.99
    got = leaves(scene, torch.float32)
    shape = dict(quats=got["quats"], scales=got["scales"])
    if by == "covars":
        covars = compat.quat_scale_to_covar_preci(got["quats"], got["scales"])[0]
        shape = dict(quats=None, scales=None, covars=covars)
    image, alphas, meta = compat.rasterization(
        means=got["means"], opacities=got["opacities"], colors=got["colors"], width=WIDTH,
        viewmats=got["viewmats"], Ks=got["Ks"], height=HEIGHT, packed=False,
        rasterize_mode="antialiased", **shape,
    )  # fmt: skip
    wide = mapped(scene, torch.Tensor.double)
    # the same rounded covariances
    covars = covars.detach().double() if by == "covars" else None
    radii, _, _, _, factor = project_there(wide, covars, calc_compensations=True)
    shown = 0.99 * factor
    drawn = (meta["radii"] > 0).all(-1)
    inside = (radii > 0).all(-1)
    lost = shown < ALPHA_MIN * (1 - 1e-4)
    band = inside & ~lost & (factor < COMPENSATION_MIN)
    assert not drawn[lost].any() and (inside & lost).sum() > 10
    assert (drawn & band).sum() >= 3, "some lie between the two ends"
    assert ((meta["opacities"] - shown).abs()[drawn] < 1e-5).all()
    cut = (2 * (shown / ALPHA_MIN).log()).sqrt()  # of the box around alpha >= 1 / 255, rounded up
    limit = torch.minimum(radii, (radii / 3.33 * cut[..., None]).ceil() + 1)
    assert (meta["radii"] <= limit)[drawn & (factor < 0.02)].all()
    torch.autograd.backward([image, alphas], [torch.randn_like(x) for x in (image, alphas)])
    for name in (*GEOMETRY, "opacities"):
        assert got[name].grad.isfinite().all() and got[name].grad.abs().max() > 0, name


def test_factor_of_what_is_transparent():
    """An opacity of 0 is culled, and has the factor 0 and not 0 / 0."""
    scene = tiny_of("needle")
    opacities = torch.where(torch.arange(NUM) % 2 == 0, 0.0, 0.99)[None]
    found = project(scene, calc_compensations=True, opacities=opacities)
    assert (found[4][..., ::2] == 0).all() and (found[4] > ALPHA_MIN).any()
