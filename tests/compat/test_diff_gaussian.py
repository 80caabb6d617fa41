"""``diff_gaussian_rasterization`` and ``simple_knn``: values, forks, refusals, programs."""

import inspect
import math

import pytest
import torch
from helpers import assert_rel_rms
from helpers import first_splatting as first
from helpers.children import ran
from helpers.first_splatting import CASES, draw, draw_first, scene_of, settings_of
from helpers.forked import python

from gamba_warp.compat import diff_gaussian_rasterization as drop_in
from gamba_warp.compat.diff_gaussian_rasterization import GaussianRasterizer
from gamba_warp.compat.simple_knn._C import distCUDA2

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture
def fork():
    """Choose a fork for one test."""
    yield drop_in.use_fork
    drop_in.use_fork("graphdeco")


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("seed", [0, 1])
def test_images_and_gradients(name, seed):
    torch.manual_seed(seed)
    first.compare(name)


@pytest.mark.parametrize(
    "name, layers", [("ingra14m", ["depth"]), ("ashawkey", ["depth", "alpha"])]
)
def test_results_of_forks(fork, name, layers):
    """Depth and alpha, with their gradients; of bfloat16 and of the other form of opacities too."""
    fork(name)
    first.compare("colours", layers)
    settings, scene = settings_of(), scene_of()
    color, _, *others = draw(scene, settings)
    assert len(others) == len(layers)
    flat = {**scene, "opacities": scene["opacities"][:, 0]}
    assert torch.equal(draw(flat, settings)[0], color)
    half = {key: value.bfloat16().requires_grad_() for key, value in scene.items()}
    draw(half, settings)[0].sum().backward()
    assert all(value.grad.dtype == torch.bfloat16 for value in half.values())


@pytest.mark.parametrize("degree", [0, 2])
def test_gradients_of_the_pose(fork, degree):
    """Compare with rendering in float64, the camera moved by exp(rho, theta); differences too."""
    fork("monogs")
    settings, scene = settings_of(degree), scene_of(60, shs=9)
    scene["means3D"] *= 0.2  # beside the image and past the clamp gradients are not derivatives
    scene["opacities"] *= 0.98
    rho, theta, twist = (torch.zeros(n, requires_grad=True) for n in (3, 3, 6))
    color, _, depth, alpha, _ = draw({**scene, "rho": rho, "theta": theta}, settings)
    want, _ = draw_first(scene, first.moved_by(settings, twist.double()))
    clear = ~want["close"]
    v, v_depth = (torch.randn(n, first.HEIGHT, first.WIDTH) * clear for n in (3, 1))
    torch.autograd.backward([color, depth], [v, v_depth])

    def loss(results):
        return (results["color"] * v).sum() + (results["depth"] * v_depth).sum()

    loss(want).backward()
    got = torch.cat([rho.grad, theta.grad])
    assert_rel_rms(got, twist.grad, first.GRADIENT, "pose")
    steps = 1e-6 * torch.eye(6, dtype=torch.float64)
    moved = [[first.moved_by(settings, s * x) for s in (1, -1)] for x in steps]
    ends = [[loss(draw_first(scene, x)[0]) for x in pair] for pair in moved]
    slopes = torch.stack([(after - before) / 2e-6 for after, before in ends])
    assert_rel_rms(got, slopes, first.GRADIENT, "differences")
    assert not alpha.requires_grad


def test_pixels_in_which_a_gaussian_is_seen(fork):
    fork("monogs")
    settings, scene = settings_of()._replace(projmatrix_raw=torch.eye(4)), scene_of()
    touched, want = draw(scene, settings)[4], draw_first(scene, settings)[0]["touched"]
    assert touched.dtype == torch.int32 and not touched.requires_grad
    # where alpha or T lies on a threshold, a pixel may be on the other side
    assert (touched - want).abs().sum() <= 2 and want.sum() > 1000 and (want == 0).sum() > 20


def test_absolute_gradients_for_densification(fork):
    """The sums of what each pixel's colour gives the centres."""
    fork("ingra14m")
    settings, scene = settings_of(), scene_of()
    scene |= dict(means2D_densify=torch.zeros(150, 3))
    leaves = {key: value.requires_grad_() for key, value in scene.items()}
    color, *_ = draw(leaves, settings)
    del scene["means2D_densify"]
    pixels = first.HEIGHT * first.WIDTH
    want, expected = draw_first({**scene, "means2D": torch.zeros(pixels, 150, 3)}, settings)
    v = torch.randn_like(color) * ~want["close"]
    color.backward(v)
    want["color"].backward(v.double())
    each = expected["means2D"].grad
    assert_rel_rms(leaves["means2D"].grad, each.sum(0), first.GRADIENT, "means2D")
    found = leaves["means2D_densify"].grad
    assert_rel_rms(found, each.abs().sum(0), first.GRADIENT, "means2D_densify")


@pytest.mark.parametrize("covars", [False, True])
def test_radii_alone(covars):
    settings, scene = settings_of(scale_modifier=1.7), scene_of()
    if covars:
        scene = first.with_covariances(scene, 1.0)
    names = {"means3D", "scales", "rotations", "cov3D_precomp"} & {*scene}
    radii = GaussianRasterizer(settings).visible_filter(**{name: scene[name] for name in names})
    assert torch.equal(radii, draw(scene, settings)[1]) and radii.dtype == torch.int32
    with pytest.raises(ValueError, match="scales and rotations, or cov3D_precomp"):
        GaussianRasterizer(settings).visible_filter(scene["means3D"])


def test_cameras_may_have_leading_dimensions_of_1():
    """As SplaTAM, Dynamic3DGaussians and SuGaR make them."""
    settings, scene = settings_of(2), scene_of(40, shs=9)
    names = "viewmatrix", "projmatrix", "campos"
    more = settings._replace(**{name: getattr(settings, name)[None] for name in names})
    assert torch.equal(draw(scene, more)[0], draw(scene, settings)[0])
    views = [GaussianRasterizer(x).markVisible(scene["means3D"]) for x in (more, settings)]
    assert torch.equal(*views)
    twice = settings._replace(viewmatrix=settings.viewmatrix.expand(2, 4, 4))
    with pytest.raises(ValueError, match="viewmatrix must have shape .4, 4..*, got .2, 4, 4."):
        draw(scene, twice)


def test_another_number_of_results_names_the_switch(fork):
    settings, scene = settings_of(), scene_of(9)
    line = "3 results are expected, the fork 'graphdeco' has 2: .*--fork"
    with pytest.raises(ValueError, match=line):
        _, _, _ = draw(scene, settings)
    with pytest.raises(ValueError, match="2 results are expected, the fork 'graphdeco' has 3"):
        _, _ = draw(scene, settings._replace(antialiasing=False))
    fork("ashawkey")
    _, _, _, _ = draw(scene, settings)
    (_, *others), every = draw(scene, settings), list(draw(scene, settings))
    assert len(others) == 3 and len(every) == 4 and draw(scene, settings)[1] is not None
    with pytest.raises(ValueError, match="fork must be one of 'graphdeco', .*got 'lgm'"):
        fork("lgm")


def test_no_gaussians_and_gaussians_that_are_not_finite():
    settings, scene = settings_of(), scene_of(40)
    none = {key: value[:0].requires_grad_() for key, value in scene.items()}
    color, radii = draw(none, settings)
    assert torch.equal(color, settings.bg[:, None, None].expand_as(color)) and len(radii) == 0
    color.sum().backward()
    bad = {key: value.clone() for key, value in scene.items()}
    bad["means3D"][0, 1], bad["colors"][1, 0], bad["scales"][2, 2] = torch.nan, torch.inf, torch.nan
    got, radii = draw(bad, settings)
    kept = {key: value[3:] for key, value in scene.items()}
    assert torch.equal(got, draw(kept, settings)[0]) and not radii[:3].any()


def test_values_of_means2D_are_not_used():
    settings, scene = settings_of(), scene_of(40)
    want = draw(scene, settings)[0]
    scene["means2D"] = torch.full((40, 3), torch.nan)
    assert torch.equal(draw(scene, settings)[0], want)


def test_the_function_takes_empty_tensors():
    """As programs call it that have their own module."""
    settings, scene = settings_of(), scene_of(40)
    x, empty = scene, torch.Tensor([])
    given = x["means3D"], x["means2D"], empty, x["colors"], x["opacities"], x["scales"]
    got = drop_in.rasterize_gaussians(*given, x["rotations"], empty, settings)
    assert torch.equal(got[0], draw(scene, settings)[0])


def test_visible_positions():
    settings = settings_of()
    points = torch.randn(200, 3)
    depths = points @ settings.viewmatrix[:3, 2] + settings.viewmatrix[3, 2]
    visible = GaussianRasterizer(settings).markVisible(points)
    assert torch.equal(visible, depths > 0.2) and 0 < visible.sum() < 200


REFUSED = {
    "means3D must have shape": dict(means3D=torch.zeros(40, 2)),
    "means2D must have shape": dict(means2D=torch.zeros(39, 3)),
    "opacities must have shape": dict(opacities=torch.zeros(40, 2)),
    "scales must have shape": dict(scales=torch.zeros(40)),
    "rotations must have dtype": dict(rotations=torch.zeros(40, 4, dtype=torch.float64)),
    "rotations must be a tensor, got list": dict(rotations=[1.0]),
    "colors_precomp must have shape": dict(colors=torch.zeros(39, 3)),
    "shs must have shape": dict(colors=torch.zeros(40, 3, 3), settings=dict(degree=1)),
    "scales and rotations, or cov3D_precomp": dict(cov3D_precomp=torch.zeros(40, 6)),
    "scales and rotations, or": dict(scales=None),
    "shs, colors_precomp: exactly one": dict(shs=torch.zeros(40, 1, 3)),
    "sh_degree must be one of .*got 4": dict(settings=dict(sh_degree=4)),
    "image_width must be .*got 0": dict(settings=dict(image_width=0)),
    "bg must have shape": dict(settings=dict(bg=torch.zeros(4))),
    "campos must be a tensor, got tuple": dict(settings=dict(campos=(0, 0, 0))),
    "viewmatrix must have shape": dict(settings=dict(viewmatrix=torch.eye(3))),
    "projmatrix is not viewmatrix": dict(settings=dict(projmatrix=torch.eye(4))),
    "projmatrix is not": dict(settings=dict(tanfovx=0.4)),
    "tanfovx and tanfovy must be > 0": dict(settings=dict(tanfovy=0.0)),
    "theta must have shape": dict(theta=torch.zeros(4)),
    "means2D_densify must have shape": dict(means2D_densify=torch.zeros(39, 3)),
}


@pytest.mark.parametrize("line", REFUSED)
def test_bad_input_is_named(line):
    changes = dict(REFUSED[line])
    settings = settings_of(**changes.pop("settings", {}))
    with pytest.raises((TypeError, ValueError), match=line) as caught:
        draw({**scene_of(40), **changes}, settings)
    assert "\n" not in str(caught.value)


def test_options_of_other_rasterizers_are_refused():
    given = settings_of()._asdict()
    for name in ("kernel_size", "subpixel_offset"):
        with pytest.raises(TypeError, match=f"{name} is an option of another rasterizer"):
            drop_in.GaussianRasterizationSettings(**given, **{name: 0.1})
    for name in ("sh_objs", "features"):  # Gaussian grouping, feature splatting
        with pytest.raises(TypeError, match=f"^{name} is an argument of another rasterizer and is"):
            draw({**scene_of(9), name: torch.zeros(9, 16)}, settings_of())
    fields = inspect.signature(drop_in._Settings).parameters
    assert list(fields)[:12] == list(given)[:12] and settings_of()._replace(debug=True).debug


def test_distances_to_neighbours():
    points = torch.randn(60, 3)
    points[:4] = points[0]  # at one place
    square = torch.cdist(points.double(), points.double()).square().fill_diagonal_(math.inf)
    want = square.topk(3, largest=False).values.mean(1)
    got = distCUDA2(points)
    assert got.dtype == torch.float32 and got[0] == 0
    assert_rel_rms(got, want, 1e-6, "distances")
    assert distCUDA2(points[:3]).isinf().all() and distCUDA2(points[:0]).shape == (0,)
    with pytest.raises(ValueError, match="points must have shape"):
        distCUDA2(torch.zeros(3))
    with pytest.raises(ValueError, match="not finite"):
        distCUDA2(torch.full((5, 3), torch.nan))


PROGRAM = """
import importlib.metadata
import torch
from diff_gaussian_rasterization import GaussianRasterizationSettings, GaussianRasterizer
from simple_knn._C import distCUDA2
try:
    from diff_gaussian_rasterization import SparseGaussianAdam
except ImportError:
    print("without it")
view, one = torch.eye(4), torch.ones(1, 3)
view[3, 2] = 2.0
flat = torch.tensor([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 1], [0, 0, 0, 0]])
settings = GaussianRasterizationSettings(
    image_height=8, image_width=8, tanfovx=1.0, tanfovy=1.0, bg=torch.zeros(3), scale_modifier=1.0,
    viewmatrix=view, projmatrix=view @ flat, sh_degree=0, campos=torch.zeros(3),
    prefiltered=False, debug=False,
)
image, radii, depth, alpha = GaussianRasterizer(raster_settings=settings)(
    means3D=0 * one, means2D=0 * one, shs=None, colors_precomp=one, opacities=one[:, :1],
    scales=one, rotations=torch.tensor([[1.0, 0, 0, 0]]), cov3D_precomp=None,
)
print(image.shape, float(depth.max() / alpha.max()), importlib.metadata.version("simple-knn"))
"""


def test_a_program_takes_the_names_and_a_fork(tmp_path):
    path = tmp_path / "client.py"
    path.write_text(PROGRAM)
    done = ran(python(), "-m", "gamba_warp.compat", "--fork", "ashawkey", path)
    assert not done.returncode, done.stderr
    lines = done.stdout.splitlines()
    assert "without it" in lines and lines[-1] == "torch.Size([3, 8, 8]) 2.0 0.0.0"
