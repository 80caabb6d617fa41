"""``rasterization`` with gsplat's signature: images, ``meta``, options, refusals."""

import inspect

import numpy as np
import pytest
import torch
from helpers import assert_rel_rms
from helpers.raster import leaves, make, mapped

from gamba_warp.compat import gsplat
from gamba_warp.compat.gsplat import rasterization, rasterize_to_pixels
from gamba_warp.compat.gsplat.rendering import MUST_BE_DEFAULT
from gamba_warp.kernels import rasterization as ours

GRADIENT = 1e-5  # the same kernels; sums by views may come in another order
pytestmark = pytest.mark.usefixtures("one_thread")
ASKED = ("means", "quats", "scales", "opacities", "colors", "viewmats", "backgrounds")


def scene_of(lead=(2,), num=37, views=3):
    """A scene of other leading dimensions; ``make`` has one."""
    batch = torch.Size(lead).numel()
    scene = make(batch, views, num, width=37, height=23, size=0.05)
    return mapped(scene, lambda v: v.reshape(*lead, *v.shape[1:]))


def asking(scene):
    return leaves(scene, torch.float32)


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("mode", ["RGB", "D", "ED", "RGB+D", "RGB+ED"])
@pytest.mark.parametrize("lead, kind", [((), "classic"), ((2,), "antialiased")])
def test_images_and_gradients(packed, mode, lead, kind):
    """Ours with gsplat's clamp of alpha, which the gsplat tests of ours hold to gsplat's code."""
    scene = scene_of(lead)
    if mode in ("D", "ED"):
        scene["backgrounds"] = None
    got, want = asking(scene), asking(scene)
    options = dict(render_mode=mode, rasterize_mode=kind)
    renders, alphas, _ = rasterization(**got, packed=packed, **options)
    expected, alpha, _ = ours(**want, alpha_max=0.999, **options)
    assert renders.shape == expected.shape
    # expected depths are divided by alpha, which has lost digits where a pixel is faint
    solid = alpha[..., 0] > 0.05 if mode.endswith("ED") else alpha[..., 0] >= 0
    assert (renders - expected)[solid].abs().max() < 1e-5 and torch.equal(alphas, alpha)
    v = torch.randn_like(renders) * solid[..., None]
    torch.autograd.backward([renders, alphas], [v, v[..., :1]])
    torch.autograd.backward([expected, alpha], [v, v[..., :1]])
    limit = GRADIENT if not mode.endswith("ED") else 1e-4  # the division, as above
    for name in ASKED if "RGB" in mode else set(ASKED) - {"colors", "backgrounds"}:
        assert_rel_rms(got[name].grad, want[name].grad, limit, name)


def test_the_background_behind_almost_opaque_pixels():
    """Its weight is T, of which 1 - alpha would have lost four digits; also of given lists."""
    scene = make(1, 1, num=7, width=21, height=18)
    scene["scales"][:], scene["opacities"][:] = 1e3, 0.7  # every pixel alike: no error averages out
    got, want, again = asking(scene), asking(scene), asking(scene)["backgrounds"]
    renders, alphas, meta = rasterization(**got, packed=False)
    assert alphas.min() > 0.9997
    lists = 21, 18, 16, meta["isect_offsets"], meta["flatten_ids"]
    splats = (meta[name].detach() for name in ("means2d", "conics"))
    colors = scene["colors"][:, None]
    other = rasterize_to_pixels(*splats, colors, meta["opacities"].detach(), *lists, again)[0]
    for image in (renders, other, ours(**want, alpha_max=0.999)[0]):
        image.sum().backward()
    for found in (got["backgrounds"], again):
        assert_rel_rms(found.grad, want["backgrounds"].grad, 1e-6, "backgrounds")


@pytest.mark.parametrize("per_view", [False, True])
@pytest.mark.parametrize("degree", [0, 3, 4])
def test_harmonics(per_view, degree):
    scene = scene_of()
    shape = (2, 3, 37, 25, 3) if per_view else (2, 37, 25, 3)
    scene["colors"] = torch.randn(shape)
    got = asking(scene)
    renders = rasterization(**got, sh_degree=degree)[0]
    v = torch.randn_like(renders)
    renders.backward(v)
    for view in range(3 if degree < 4 else 0):
        one = {k: scene[k][:, [view]] for k in ("viewmats", "Ks", "backgrounds")}
        one["colors"] = (scene["colors"][:, view] if per_view else scene["colors"])[..., :16, :]
        image = ours(**{**scene, **one}, sh_degree=degree, alpha_max=0.999)[0]
        assert (image[:, 0] - renders[:, view]).abs().max() < 1e-5
    assert (got["colors"].grad[..., : (degree + 1) ** 2, :] != 0).any()
    assert (got["colors"].grad[..., (degree + 1) ** 2 :, :] == 0).all()
    assert (got["viewmats"].grad != 0).any()


@pytest.mark.parametrize("kind, eps2d", [("classic", 0.3), ("classic", 0.0), ("antialiased", 0.3)])
def test_covariances(kind, eps2d):
    """Covariances are projected by other code, in float64."""
    scene = scene_of()
    scene["means"][:, :5] *= 9
    scene["means"][:, 5] = float("nan")
    scene["scales"][:, 6] = 0  # a point, which has no footprint without eps2d
    got, want = asking(scene), asking(scene)
    covars = gsplat.quat_scale_to_covar_preci(got["quats"], got["scales"], True, False)[0]
    given = {**got, "quats": None, "scales": None, "covars": covars}
    options = dict(rasterize_mode=kind, packed=False, eps2d=eps2d)
    renders, _, meta = rasterization(**given, **options)
    expected, _, theirs = rasterization(**want, **options)
    assert eps2d or not (theirs["radii"][..., 6, :].any() or meta["radii"][..., 6, :].any())
    assert (renders - expected).abs().max() < 1e-4 and torch.isfinite(renders).all()
    assert (meta["radii"] - theirs["radii"]).abs().max() <= 1
    v = torch.randn_like(renders)
    renders.backward(v)
    expected.backward(v)
    for name in ("means", "quats", "scales", "opacities", "viewmats"):
        assert_rel_rms(got[name].grad, want[name].grad, 1e-4, name)


@pytest.mark.parametrize("lead", [(), (2, 1)])
@pytest.mark.parametrize("packed", [False, True])
def test_meta(lead, packed):
    scene = scene_of(lead)
    scene["means"][..., :9, :] *= 9
    scene["colors"].requires_grad_()
    scene["means"].requires_grad_()
    renders, _, meta = rasterization(**scene, packed=packed, absgrad=True)
    batch, num = torch.Size(lead).numel(), 37
    assert meta["n_cameras"] == 3 and meta["n_batches"] == batch
    assert (meta["width"], meta["height"], meta["tile_size"]) == (37, 23, 16)
    assert (meta["tile_width"], meta["tile_height"]) == (3, 2)
    assert meta["isect_offsets"].shape == (*lead, 3, 2, 3)
    rows = meta["radii"].shape[:-1]
    seen = (meta["radii"] > 0).all(-1)
    if packed:
        assert seen.all() and 0 < len(seen) < batch * 3 * num
        for name in ("batch_ids", "camera_ids", "gaussian_ids"):
            assert meta[name].dtype == torch.int64 and meta[name].shape == rows
        at = (meta["batch_ids"] * 3 + meta["camera_ids"]) * num + meta["gaussian_ids"]
        assert (at.diff() > 0).all()
        colors = scene["colors"].reshape(batch * num, 3)
        colors = colors[meta["batch_ids"] * num + meta["gaussian_ids"]]
    else:
        assert rows == (*lead, 3, num) and 0 < seen.float().mean() < 1
        assert meta["gaussian_ids"] is None
        colors = scene["colors"].unsqueeze(-3).expand(*rows, 3)
    for name, size in dict(means2d=(2,), conics=(3,), depths=(), opacities=()).items():
        assert meta[name].shape == (*rows, *size), name
    assert meta["radii"].dtype == meta["flatten_ids"].dtype == torch.int32
    assert meta["tiles_per_gauss"].shape == rows
    assert meta["tiles_per_gauss"].sum() == len(meta["flatten_ids"]) == len(meta["isect_ids"])
    assert (meta["isect_ids"].diff() >= 0).all()
    parts = meta["means2d"], meta["conics"], colors, meta["opacities"], 37, 23, 16
    lists = meta["isect_offsets"], meta["flatten_ids"]
    again, _ = rasterize_to_pixels(*parts, *lists, scene["backgrounds"], packed=packed)
    assert (again - renders).abs().max() < 1e-5
    meta["means2d"].retain_grad()
    renders.backward(torch.randn_like(renders))
    grad, absolute = meta["means2d"].grad, meta["means2d"].absgrad
    assert (grad[seen] != 0).any(-1).float().mean() > 0.5 and (grad[~seen] == 0).all()
    assert (absolute >= grad.abs() - 1e-4 * grad.abs().max()).all()
    assert absolute.sum() > 1.2 * grad.abs().sum()


def test_packing_changes_no_gradient():
    scene = scene_of()
    found = []
    for packed in (False, True):
        got = asking(scene)
        renders, _, meta = rasterization(**got, packed=packed, absgrad=True)
        meta["means2d"].retain_grad()
        torch.manual_seed(1)
        renders.backward(torch.randn_like(renders))
        values = meta["means2d"].grad, meta["means2d"].absgrad
        seen = (meta["radii"] > 0).all(-1)
        found.append([*(v[seen] for v in values), *(got[k].grad for k in ASKED)])
    for name, a, b in zip(("means2d", "absgrad", *ASKED), *found):
        assert torch.equal(a, b), name


@pytest.mark.parametrize("packed", [False, True])
def test_simple_trainer(packed):
    """gsplat's simple_trainer: Adam of the Gaussians that a step has seen."""
    scene = scene_of((), num=60, views=1)
    del scene["backgrounds"]
    scene["means"][:9] *= 30
    params = {name: torch.nn.Parameter(scene[name].clone()) for name in ("means", "colors")}
    lr, eps, betas = 0.01, 1e-8, (0.9, 0.999)
    groups = ({"params": x, "lr": lr, "name": name} for name, x in params.items())
    optimizers = [gsplat.SelectiveAdam([group], eps=eps, betas=betas) for group in groups]
    want = {name: (x.detach().double(), 0.0, 0.0) for name, x in params.items()}
    for _ in range(2):
        given = {**scene, **params}
        renders, _, info = rasterization(**given, packed=packed, backgrounds=torch.rand(1, 3))
        renders.square().mean().backward()
        if packed:
            seen = torch.zeros(60, dtype=torch.bool)
            seen.scatter_(0, info["gaussian_ids"], 1)
        else:
            seen = (info["radii"] > 0).all(-1).any(0)
        assert 5 < (~seen).sum() < 30
        for name, x in params.items():
            value, mean, square = want[name]
            rows, grad = seen[:, None], x.grad.double()
            mean = torch.where(rows, betas[0] * mean + (1 - betas[0]) * grad, mean)
            square = torch.where(rows, betas[1] * square + (1 - betas[1]) * grad**2, square)
            value = value - torch.where(rows, lr * mean / (square.sqrt() + eps), 0.0)
            want[name] = value, mean, square
        for optimizer in optimizers:
            optimizer.step(seen)
            optimizer.zero_grad(set_to_none=True)
    for name, x in params.items():
        assert (x[~seen] == scene[name][~seen]).all()
        # steps of lr, of which float32 keeps seven digits, on values of size 1
        assert (x - want[name][0]).abs().max() < 1e-5, name
    with pytest.raises(ValueError, match="^valid must have 60 rows, got 59"):
        x.grad = torch.ones_like(x)
        optimizers[-1].step(seen[1:])


def test_depth_without_colors():
    scene = scene_of()
    scene.update(colors=None, backgrounds=None)
    depth = rasterization(**scene, render_mode="ED")[0]
    scene["colors"] = torch.rand(2, 37, 3)
    assert torch.equal(depth[..., 0], rasterization(**scene, render_mode="RGB+ED")[0][..., 3])
    scene["colors"] = None
    with pytest.raises(TypeError, match="^colors must be a tensor.*, got NoneType"):
        rasterization(**scene)


def test_no_gaussians():
    scene = scene_of(num=0)
    for packed in (False, True):
        renders, alphas, meta = rasterization(**scene, packed=packed)
        expected = scene["backgrounds"][:, :, None, None].expand_as(renders)
        assert torch.equal(renders, expected) and (alphas == 0).all()
        assert meta["flatten_ids"].numel() == 0


def test_backgrounds_of_any_shape():
    scene = scene_of()
    for shape in ((3,), (3, 3)):
        ground = torch.rand(shape, requires_grad=True)
        results = []
        for given in (ground, ground.expand(2, 3, 3)):
            ground.grad = None
            renders = rasterization(**scene | {"backgrounds": given})[0]
            renders.square().sum().backward()
            results.append([renders, ground.grad])
        assert all(map(torch.equal, *results))


def test_sizes_are_integers():
    meta = rasterization(**scene_of() | {"width": np.int64(37), "height": torch.tensor(23)})[2]
    assert type(meta["width"]) is int and type(meta["height"]) is int
    for value in (0, True, 3.0, "7", torch.tensor(2.5), 2**15 + 1):
        with pytest.raises(ValueError, match="^height must be an integer from 1 to 32768"):
            rasterization(**scene_of() | {"height": value})


DEFAULTS = {k: p.default for k, p in inspect.signature(rasterization).parameters.items()}
OTHER = {None: torch.zeros(2, 3, 6), False: True, True: False, "pinhole": "fisheye"}
OPTIONS = {name: OTHER[DEFAULTS[name]] for name in MUST_BE_DEFAULT} | dict(
    rolling_shutter=gsplat.RollingShutterType.ROLLING_TOP_TO_BOTTOM, render_mode="d",
    rasterize_mode="fast", sh_degree=5, near_plane=0.0, width=0, opacities=torch.zeros(2, 36),
    backgrounds=torch.zeros(2, 3, 4), Ks=torch.zeros(2, 2, 3, 3),
)  # fmt: skip


@pytest.mark.parametrize("name", OPTIONS)
def test_refusals(name):
    """Errors of one line that begin with the argument and list the allowed values."""
    with pytest.raises(ValueError, match=rf"^{name} (must|is supported only) ") as error:
        rasterization(**{**scene_of(), name: OPTIONS[name]})
    assert len(str(error.value).splitlines()) == 1


def test_signature():
    """Order, names and defaults are those of the installed gsplat."""
    theirs = pytest.importorskip("gsplat").rasterization
    theirs = inspect.signature(theirs).parameters
    mine = inspect.signature(rasterization).parameters
    assert [*mine][: len(theirs)] == [*theirs]
    for name, parameter in theirs.items():  # gsplat's enum is not ours
        plain = (getattr(x, "name", x) for x in (DEFAULTS[name], parameter.default))
        assert len({*plain}) == 1, name
    assert all(p.kind == p.KEYWORD_ONLY for p in [*mine.values()][len(theirs) :])
