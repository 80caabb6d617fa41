"""The factor of antialiasing down to 0 against gsplat's own torch functions in float64."""

import importlib.util

import pytest
import torch
from helpers import assert_rel_rms
from helpers.raster import leaves, make

from gamba_warp.compat import gsplat as compat
from gamba_warp.kernels.rasterize.constants import ALPHA_MIN, COMPENSATION_MIN

if importlib.util.find_spec("gsplat") is None:
    pytest.skip("needs the package gsplat (pip install gsplat==1.5.3)", allow_module_level=True)
from gsplat.cuda import _torch_impl as gsplat

WIDTH, HEIGHT = 39, 27
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
# float32 against float64: where the kernel takes the factor it multiplies rows of up to 30 pixels
# that may be nearly parallel, 30 / sqrt(eps2d) roundings
EXACT = 1e-5
GRADIENT = 1e-4


@pytest.fixture(autouse=True)
def one_thread():
    """Small operations: on a busy machine threads would only wait."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


def scene_of(kind):
    scene = make(1, 2, NUM, width=WIDTH, height=HEIGHT, size=0.05)
    spread = torch.logspace(-1, 1, NUM)[:, None]  # from a tenth of the sizes to ten times
    scene["scales"] = (torch.tensor(KINDS[kind]) * spread)[None]
    if kind == "flat":  # nearly or exactly from the edge
        scene["viewmats"][..., :3, :3] = torch.eye(3)
        scene["viewmats"][..., :3, 3] = torch.tensor([0.0, 0.0, 1.6])
        scene["means"][..., 0] *= 0.1 * (torch.arange(NUM) % 3)
        scene["quats"] = torch.tensor([0.5**0.5, 0.0, 0.5**0.5, 0.0]).expand(1, NUM, 4).clone()
    return scene


def both(kind, by="quats"):
    """Ours and theirs: leaves, and what the projections return."""
    scene = scene_of(kind)
    got, want = leaves(scene, torch.float32), leaves(scene, torch.float64)
    shape = None, got["quats"], got["scales"]
    if by == "covars":
        entries = compat.quat_scale_to_covar_preci(
            got["quats"].double(), got["scales"].double(), triu=True
        )[0]
        shape = entries.float(), None, None
    found = compat.fully_fused_projection(
        got["means"], *shape, got["viewmats"], got["Ks"], WIDTH, HEIGHT, calc_compensations=True
    )
    if by == "covars":  # the same rounded covariances
        rows = [0, 1, 2, 1, 3, 4, 2, 4, 5]
        covars = shape[0].detach().double()[..., rows].unflatten(-1, (3, 3))
    else:
        covars = gsplat._quat_scale_to_covar_preci(want["quats"], want["scales"], True, False)[0]
    expected = gsplat._fully_fused_projection(
        want["means"], covars, want["viewmats"], want["Ks"], WIDTH, HEIGHT, calc_compensations=True
    )
    seen = (found[0] > 0).all(-1)
    assert seen.float().mean() > 0.5 and not (seen & ~(expected[0] > 0).all(-1)).any()
    return got, want, found, expected, seen


@pytest.mark.parametrize("by", ["quats", "covars"])
@pytest.mark.parametrize("kind", KINDS)
def test_factor_is_that_of_gsplat(kind, by):
    got, _, found, expected, seen = both(kind, by)
    ours, theirs = found[4][seen], expected[4].detach()[seen]
    # theirs is the root of a difference, of which float64 leaves sqrt(1e-16) times the pixels
    limit = EXACT if by == "quats" else 1e-6
    assert (ours - theirs).abs().max() <= limit
    assert (theirs < COMPENSATION_MIN).sum() > 10 and (ours >= 0).all()
    ours.sum().backward()
    for name in ("means", "quats", "scales", "viewmats"):
        assert got[name].grad.isfinite().all(), name


@pytest.mark.parametrize("kind", ["tiny", "needle", "flat"])
def test_gradients_of_small_factors_are_those_of_gsplat(kind):
    got, want, found, expected, seen = both(kind)
    faint = seen & (found[4] < COMPENSATION_MIN) & (found[4] > 1e-6)
    assert faint.sum() > 10
    v = torch.randn(int(faint.sum()))
    found[4][faint].backward(v)
    expected[4][faint].backward(v.double())
    for name in ("means", "quats", "scales", "viewmats"):
        assert want[name].grad.abs().max() > 0, name
        assert_rel_rms(got[name].grad, want[name].grad, GRADIENT, name)


@pytest.mark.parametrize("by", ["quats", "covars"])
def test_pictures_cull_by_the_true_factor(by):
    """Of opaque needles, those whose factor is below 1 / 255 are not drawn."""
    scene = scene_of("needle")
    scene["opacities"][:] = 0.99
    got = leaves(scene, torch.float32)
    shape = dict(quats=got["quats"], scales=got["scales"])
    if by == "covars":
        covars = compat.quat_scale_to_covar_preci(got["quats"], got["scales"])[0]
        shape = dict(quats=None, scales=None, covars=covars)
    picture, alphas, meta = compat.rasterization(
        means=got["means"], opacities=got["opacities"], colors=got["colors"], width=WIDTH,
        viewmats=got["viewmats"], Ks=got["Ks"], height=HEIGHT, packed=False,
        rasterize_mode="antialiased", **shape,
    )  # fmt: skip
    wide = {k: scene[k].double() for k in ("means", "quats", "scales", "viewmats", "Ks")}
    if by == "quats":
        covars = gsplat._quat_scale_to_covar_preci(wide["quats"], wide["scales"], True, False)[0]
    else:  # the same rounded covariances
        covars = covars.detach().double()
    radii, _, _, _, factor = gsplat._fully_fused_projection(
        wide["means"], covars, wide["viewmats"], wide["Ks"], WIDTH, HEIGHT, calc_compensations=True
    )
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
    torch.autograd.backward([picture, alphas], [torch.randn_like(x) for x in (picture, alphas)])
    for name in ("means", "quats", "scales", "opacities", "viewmats"):
        assert got[name].grad.isfinite().all() and got[name].grad.abs().max() > 0, name


def test_factor_of_what_is_transparent():
    """An opacity of 0 is culled, and has the factor 0 and not 0 / 0."""
    scene = scene_of("needle")
    given = [scene[k] for k in ("means", "quats", "scales", "viewmats", "Ks")]
    opacities = torch.where(torch.arange(NUM) % 2 == 0, 0.0, 0.99)[None]
    found = compat.fully_fused_projection(
        given[0], None, *given[1:], WIDTH, HEIGHT, calc_compensations=True, opacities=opacities
    )
    assert (found[4][..., ::2] == 0).all() and (found[4] > ALPHA_MIN).any()
