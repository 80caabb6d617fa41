"""The rasterizer against its float64 oracle, with each skip on and off."""

from dataclasses import fields

import pytest
import torch
from helpers import assert_rel_rms
from helpers.raster import GRADIENT, IMAGE, NAMES, compare, drawn, leaves, make, near_a_cut

from gamba_warp.kernels.cases import case
from gamba_warp.kernels.cases.raster import LEAVES, orbit_cameras, shell
from gamba_warp.kernels.rasterize import Skip, rasterization
from gamba_warp.kernels.rasterize.harmonics import colors_from_harmonics
from gamba_warp.kernels.rasterize.reference import rasterization_reference
from gamba_warp.kernels.rasterize.tiles import Limits, Size

# Σ w z / Σ w where pixels are so faint that 1 - T has lost the digits of Σ w
DEPTH = 1e-6  # relative: rounding of the weights, of which a mean of depths sees a part
DEPTH_GRADIENT = 5e-6  # a depth minus the mean depth loses a digit


@pytest.mark.parametrize("mode", ["RGB", "D", "ED", "RGB+D", "RGB+ED"])
def test_modes(mode):
    compare(make(), mode)


def test_antialiasing_leaves_a_two_hundredth_of_what_is_tiny():
    """The factor has a floor, where it has no gradient: sqrt(det Σ) would have an infinite one."""
    scene = make(1, 1, num=5, width=21, height=18)
    scene["means"][:], scene["opacities"][:], scene["scales"][:] = 0.0, 0.9, 1e-6
    got = leaves(scene, torch.float32)
    opacities = rasterization(**got, rasterize_mode="antialiased")[2]["opacities"]
    torch.testing.assert_close(opacities, torch.full((1, 1, 5), 0.9 * 0.005))
    opacities.sum().backward()
    torch.testing.assert_close(got["opacities"].grad, torch.full((1, 5), 0.005))
    assert (got["scales"].grad == 0).all()


@pytest.mark.parametrize("channels, views, batch", [(1, 1, 1), (2, 1, 3), (5, 2, 1), (17, 1, 1)])
def test_channels_and_batches(channels, views, batch):
    compare(make(batch, views, channels=channels, width=21, height=18))


def test_colors_per_view():
    scene = make()
    scene["colors"] = torch.rand(2, 3, 60, 3)
    compare(scene)


@pytest.mark.parametrize(
    "option", [{"eps2d": 0.1}, {"eps2d": 0.0}, {"alpha_min": 0.02}, {"alpha_max": 0.7}]
)
def test_options(option):
    compare(make(), **option)


@pytest.mark.parametrize("antialiased", [False, True])
def test_without_dilation(antialiased):
    """Lines, points and specks have determinant 0: they are culled, and what is flat is not."""
    scene = make(1, 2, num=80)
    for i, scales in enumerate(((0.1, 0, 0), (0, 0, 0), (1e-13,) * 3, (0.1, 0.08, 0), (1e-9,) * 3)):
        scene["scales"][:, i::8] = torch.tensor(scales)
    scene["quats"][:, ::3] = torch.tensor([1.0, 0, 0, 0])
    meta = compare(scene, eps2d=0.0, antialiased=antialiased)
    assert meta["culled"]["not_finite"] == 2 * (10 + 10 + 10)
    got = leaves(scene, torch.float32)
    renders, alphas, _ = rasterization(**got, eps2d=0.0, render_mode="RGB+D")
    (renders.sum() + alphas.sum()).backward()
    for name in ("means", "quats", "scales", "opacities"):
        assert (got[name].grad[:, 1::8] == 0).all() and got[name].grad.isfinite().all(), name


def test_planes():
    compare(make(num=200, size=0.1), near_plane=1.5, far_plane=1.9)


def test_without_rotation():
    scene = make()
    identity = torch.tensor([1.0, 0, 0, 0]).expand(2, 60, 4).contiguous()
    images = [rasterization(**scene | {"quats": quats})[0] for quats in (identity, None)]
    assert torch.equal(*images)


def test_zero_quaternion_is_no_rotation():
    scene = make(batch=1)
    scene["quats"][:, :7] = 0.0
    compare(scene)
    scene = leaves(scene, torch.float32)
    rasterization(**scene)[0].square().sum().backward()
    assert (scene["quats"].grad[:, :7] == 0).all()


def test_harmonics(degree=2):
    scene = make(num=50)
    coefficients = 0.4 * torch.randn(2, 50, 16, 3)
    scene["colors"] = coefficients
    got = leaves(scene, torch.float32)
    renders, _, _ = rasterization(**got, sh_degree=degree)
    want = leaves(scene, torch.float64)
    flat = colors_from_harmonics(degree, want["colors"], want["means"], want["viewmats"])
    expected, _, _ = rasterization_reference(**dict(want, colors=flat))
    keep = ~near_a_cut(dict(scene, colors=flat.detach().float()), {})[..., None]
    assert ((renders - expected) * keep).abs().max() <= IMAGE * expected.max()
    v = torch.randn_like(renders) * keep
    (renders * v).sum().backward()
    (expected * v).sum().backward()
    for name in NAMES[:-1]:
        assert_rel_rms(got[name].grad, want[name].grad, GRADIENT, name)
    used = (degree + 1) ** 2
    assert (got["colors"].grad[:, :, used:] == 0).all()


@pytest.mark.parametrize("mode", ["ED", "RGB+ED"])
@pytest.mark.parametrize("alpha_min", [1 / 255, 1e-3])
def test_faint_pixels(mode, alpha_min):
    scene = make(1, 2, num=60, size=0.1)
    scene["opacities"] = alpha_min * (1.1 + 2 * torch.rand(1, 60))
    got, want = leaves(scene, torch.float32), leaves(scene, torch.float64)
    renders, alphas, _ = rasterization(**got, render_mode=mode, alpha_min=alpha_min)
    _, depth, weight = rasterization_reference(**want, alpha_min=alpha_min)
    # where nothing is in sight the depth is 0
    expected = depth / weight.clamp_min(1e-10)
    faint = (weight > 0) & (weight < 12 * alpha_min)
    keep = ~near_a_cut(scene, {"alpha_min": alpha_min})[..., None]
    assert (faint & keep).float().mean() > 0.4 and (weight == 0).any()
    error = (renders[..., -1:] - expected).abs() * keep
    assert (error / expected.clamp_min(1e-3)).max() < DEPTH
    assert ((alphas - weight).abs() * keep).max() < 1e-6  # alphas is still 1 - T
    v = torch.randn_like(expected) * (faint & keep)
    (renders[..., -1:] * v).sum().backward()
    (expected * v).sum().backward()
    for name in NAMES[:4]:
        assert_rel_rms(got[name].grad, want[name].grad, DEPTH_GRADIENT, name)
    assert got["colors"].grad is None or not got["colors"].grad.any()


@pytest.mark.usefixtures("each_device")
def test_the_background_behind_almost_opaque_pixels():
    """Its weight is T = 2e-4, of which 1 - alpha would have lost four digits."""
    scene = make(1, 1, num=7, width=21, height=18)
    scene["means"] *= 0.1
    scene["scales"][:], scene["opacities"][:] = 1e3, 0.7  # every pixel alike: no error averages out
    got, want = leaves(scene, torch.float32), leaves(scene, torch.float64)
    renders, alphas, _ = rasterization(**got)
    expected, _, alpha = rasterization_reference(**want)
    assert (1e-4 < 1 - alpha).all() and (1 - alpha < 3e-4).all()
    assert (alphas - alpha).abs().max() < 1e-7
    renders.sum().backward()
    expected.sum().backward()
    # exp has 1e-7, and alpha / (1 - alpha) of that are in the factor of each Gaussian
    assert_rel_rms(got["backgrounds"].grad, want["backgrounds"].grad, 3e-6, "backgrounds")


def test_one_gaussian_has_its_own_depth_wherever_it_is_seen():
    """The weights cancel, even where alpha has three digits left beside 1."""
    scene = make(1, 1, num=1, size=0.1)
    scene["means"][:], scene["opacities"][:] = 0.0, 0.9
    renders, alphas, meta = rasterization(**scene, render_mode="ED", alpha_min=1e-5)
    seen = alphas > 0
    assert alphas[seen].min() < 2e-5 and seen.any() and not seen.all()
    assert (renders[seen] / meta["depths"] - 1).abs().max() < 2.5e-7
    assert (renders[~seen] == 0).all()


def test_fake_results_have_the_real_shapes():
    num, views, width, height = 40, 2, 37, 21
    meta = rasterization(**make(1, views, num=num, width=width, height=height))[-1]
    names = ("means2d", "conics", "depths", "opacities")
    means2d, conics, depths, opacities = (meta[k].detach().flatten(0, 1) for k in names)
    extents = torch.full_like(means2d, 5.0)
    bins = (means2d, conics, depths, opacities, extents, width, height, 1 / 255, 127)
    checks = ("test_schema", "test_faketensor")
    torch.library.opcheck(torch.ops.gamba_warp.rasterize_bin.default, bins, test_utils=checks)
    size = Size(width=width, height=height, views=views, colors_per_view=False, skip=127)
    limits = Limits(alpha_min=1 / 255, alpha_max=0.99, t_min=1e-4)
    given = list(meta.bins), None, None, *size, *limits
    arguments = (means2d, conics, opacities, torch.rand(num, 3), *given)
    operator = torch.ops.gamba_warp.rasterize_composite.default
    torch.library.opcheck(operator, arguments, test_utils=checks)


def test_a_compiled_call_has_the_same_bits():
    scene = make(1, 1, num=40, width=37, height=21)
    names = ("means", "quats", "scales", "opacities", "colors")

    def call(*gaussians):
        rest = {k: scene[k] for k in ("viewmats", "Ks", "width", "height")}
        return rasterization(**dict(zip(names, gaussians)), **rest, render_mode="RGB+ED")[:2]

    # torch 2.6 cuts the graph at the lists, whose length is not known before, and at ``Meta``.
    whole = torch.__version__ >= "2.10"
    results = []
    for function in (call, torch.compile(call, fullgraph=whole, backend="aot_eager")):
        gaussians = [scene[name].clone().requires_grad_() for name in names]
        renders, alphas = function(*gaussians)
        grads = torch.autograd.grad((renders.square() + alphas).sum(), gaussians)
        results.append([renders, alphas, *grads])
    assert all(torch.equal(a, b) for a, b in zip(*results))


WIDTH, HEIGHT, VIEWS = 150, 139, 2
SKIPS = [field.name for field in fields(Skip)]


def render(mode="classic", **off):
    """An opaque shell, much of it hidden, empty tiles around it, no gradient on the right half."""
    scene = shell(6000, 3)
    scene["opacities"][::5] = 0.004  # touches almost nothing
    scene["opacities"].clamp_(max=0.98)
    scene["viewmats"], scene["Ks"] = orbit_cameras(VIEWS, 128)
    scene |= {"width": WIDTH, "height": HEIGHT}

    def without_right(v):
        for x in v:
            x[:, :, 64:] = 0

    return drawn(scene, needs=LEAVES, edit=without_right, rasterize_mode=mode, skip=Skip(**off))


def test_default_is_every_skip():
    assert all(getattr(Skip(), name) for name in SKIPS)
    assert rasterization.__kwdefaults__["skip"] == Skip()


@pytest.mark.parametrize("mode", ["classic", "antialiased"])
@pytest.mark.parametrize("name", [*SKIPS, "all of them"])
def test_same_with_and_without(name, mode):
    want, counts = render(mode)
    assert want["renders"].mean() > 0.1 and counts["tiles_empty"] > 5
    off = dict.fromkeys([name] if name in SKIPS else SKIPS, False)
    got, _ = render(mode, **off)
    assert got.keys() == want.keys()
    error = case.compare(got, want)
    assert error.maximum < 1e-6, error


def test_counts_tell_what_each_leaves_out():
    got, on = render()
    assert (got["means"].abs().sum(1) == 0).sum() > 50  # those that are hidden
    tiles = on["tiles"] - on["tiles_empty"]
    metas = {name: render(**{name: False})[1] for name in SKIPS}
    assert metas["tile_test"]["pairs"] == on["pairs_box"] > on["pairs"]
    assert metas["block_test"]["blocks_traversed"] > 1.5 * on["blocks_traversed"]
    assert metas["stopped"]["pairs_traversed"] == on["pairs"] > on["pairs_traversed"]
    assert metas["zero_upstream"]["tiles_skipped"] == on["tiles_empty"]
    assert on["tiles_empty"] + tiles / 5 < on["tiles_skipped"] < on["tiles"]
    assert on["blocks_traversed"] > on["blocks_used"] > on["pairs_used"] > on["gaussians_used"] > 0
    assert on["gaussians_used"] < VIEWS * 6000
    for name in SKIPS:  # what had an effect does not depend on what was looked at
        assert metas[name]["blocks_used"] == on["blocks_used"]
