"""The rasterizer of the first 3D Gaussian splatting code, in float64 torch, from its formulas.

Kerbl et al. 2023, section 6 and appendix A, with the conventions of the published code: every pixel
sees the Gaussians of its tile of 16 x 16 pixels, in order of depth. Gradients are autograd's, but
where the published code has its own: detached values stand for these.

``compare`` holds the drop-in to it, for a case by name.
"""

import math

import torch
from torch import Tensor

from gamba_warp.compat.diff_gaussian_rasterization import (
    GaussianRasterizationSettings,
    GaussianRasterizer,
)
from gamba_warp.kernels.rasterize.harmonics.formula import colors_by_formula
from helpers import assert_rel_rms
from helpers.gaussians import rotations

IMAGE, GRADIENT = 1e-6, 1e-5
WIDTH, HEIGHT = 37, 53
NEAR, DILATION, ALPHA_MAX, ALPHA_MIN, STOP, TILE = 0.2, 0.3, 0.99, 1 / 255, 1e-4, 16


def covariances(scales: Tensor, modifier: float, quats: Tensor) -> Tensor:
    """``[N, 3, 3]``; quaternions are not made unit ones, and the modifier has no slope."""
    sizes = scales + (scales * (modifier - 1)).detach()
    root = rotations(quats, unit=False) * sizes[:, None]
    return root @ root.mT


def whole(six: Tensor) -> Tensor:
    """Covariances ``[N, 3, 3]`` from xx, xy, xz, yy, yz, zz."""
    return six[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].unflatten(-1, (3, 3))


class Factor(torch.autograd.Function):
    """sqrt(det / det of the dilated covariance), with the published code's slope.

    That is the slope for entries that are dilated already, dilated once more.
    """

    @staticmethod
    def forward(ctx, xx, xy, yy):
        ratio = (xx * yy - xy * xy) / ((xx + DILATION) * (yy + DILATION) - xy * xy)
        ctx.save_for_backward(xx, xy, yy, ratio)
        return ratio.clamp_min(2.5e-5).sqrt()

    @staticmethod
    def backward(ctx, v):
        xx, xy, yy, ratio = ctx.saved_tensors
        with torch.enable_grad():
            given = [x.detach().requires_grad_() for x in (xx + DILATION, xy, yy + DILATION)]
            a, b, c = given
            later = (a * c - b * b) / ((a + DILATION) * (c + DILATION) - b * b)
            slopes = torch.autograd.grad(later.sum(), given)
        v = torch.where(ratio <= 2.5e-5, 0.0, v / (2 * ratio.clamp_min(2.5e-5).sqrt()))
        return tuple(v * slope for slope in slopes)


def render(means, means2d, opacities, colors, covars, settings, antialiasing=False):
    """``color [C, H, W]``, ``depth``, ``inverse`` and ``alpha [H, W]``; ``radii, touched [N]``.

    Args:
        means: ``[N, 3]``, float64 as all.
        means2d: ``[N, 3]`` zeros, or ``[H * W, N, 3]`` for each pixel, which are added in units of
            half the image.
        opacities: ``[N]``.
        colors: ``[N, C]``.
        covars: ``[N, 3, 3]``.
        settings: the drop-in's.
        antialiasing: scale the opacities.
    """
    height, width = settings.image_height, settings.image_width
    view, full = settings.viewmatrix.double(), settings.projmatrix.double()
    tan = torch.tensor([settings.tanfovx, settings.tanfovy], dtype=torch.float64)
    size = torch.tensor([width, height], dtype=torch.float64)
    t = means @ view[:3, :3] + view[3, :3]
    depth = t[:, 2].detach()
    seen = depth > NEAR
    t = torch.where(seen[:, None], t, torch.tensor([0.0, 0.0, 1.0]).double())
    clip = means @ full[:3] + full[3]
    clip = torch.where(seen[:, None], clip, torch.ones(4).double())
    centers = ((clip[:, :2] / clip[:, 3:] + 1) * size - 1) / 2

    focal, z = size / (2 * tan), t[:, 2]
    slopes = t[:, :2] / z[:, None]
    bound = 1.3 * tan
    outside = (slopes < -bound) | (slopes > bound)
    held = (slopes.clamp(-bound, bound) * z[:, None]).detach()
    x, y = torch.where(outside, held, t[:, :2]).unbind(-1)
    nothing = torch.zeros_like(z)
    rows = (
        [focal[0] / z, nothing, -focal[0] * x / z**2],
        [nothing, focal[1] / z, -focal[1] * y / z**2],
    )
    J = torch.stack([torch.stack(row, -1) for row in rows], -2)
    M = J @ view[:3, :3].T
    plane = M @ covars @ M.mT
    xx, xy, yy = plane[:, 0, 0], plane[:, 0, 1], plane[:, 1, 1]
    shown = opacities * Factor.apply(xx, xy, yy) if antialiasing else opacities
    xx, yy = xx + DILATION, yy + DILATION
    det = xx * yy - xy * xy

    with torch.no_grad():
        middle = (xx + yy) / 2
        most = middle + (middle * middle - det).clamp_min(0.1).sqrt()
        radii = (3 * most.sqrt()).ceil()
        grid = -(-size // TILE)
        begin = ((centers - radii[:, None]) / TILE).trunc().clamp_min(0).minimum(grid)
        end = (centers + radii[:, None] + TILE - 1) / TILE
        end = end.trunc().clamp_min(0).minimum(grid)
        seen = seen & ((end - begin).prod(-1) > 0)
        radii = torch.where(seen, radii, 0.0)

    order = depth.argsort(stable=True)
    order = order[seen[order]]
    py, px = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    pixels = torch.stack([px, py], -1).reshape(-1, 2)
    moved = centers + means2d[..., :2] * size / 2
    dx, dy = (moved[..., order, :] - pixels[:, None]).unbind(-1)
    a, b, c = (part[order] / det[order] for part in (yy, -xy, xx))
    free = shown[order] * torch.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)
    alpha = free + (free.clamp_max(ALPHA_MAX) - free).detach()  # the gradient passes the clamp
    tiles = (pixels // TILE)[:, None]
    inside = ((tiles >= begin[order]) & (tiles < end[order])).all(-1)
    alpha = torch.where(inside & (alpha >= ALPHA_MIN), alpha, 0.0)
    # a pixel stops before the Gaussian that would bring it below STOP; those behind do nothing
    after = torch.cumprod(1 - alpha, 1)
    alpha = torch.where((after >= STOP).cummin(1).values, alpha, 0.0)
    after = torch.cumprod(1 - alpha, 1)
    before = torch.cat([torch.ones_like(after[:, :1]), after[:, :-1]], 1)
    weight = before * alpha
    rest = after[:, -1:] if len(order) else torch.ones(len(pixels), 1).double()
    found = {
        "color": weight @ colors[order] + rest * settings.bg.double(),
        "depth": weight @ z[order, None],
        "inverse": weight @ (1 / z[order, None]),
        "alpha": weight.sum(1, keepdim=True),
    }
    shaped = {name: x.T.reshape(-1, height, width) for name, x in found.items()}
    # how near the values lie to the thresholds of a pixel, where float32 may take the other side
    with torch.no_grad():
        near = ((free / ALPHA_MIN - 1).abs() < 1e-4) | ((after / STOP - 1).abs() < 1e-3)
        close = (near & inside).any(1).view(height, width)
        touched = torch.zeros_like(radii)
        touched[order] = ((alpha > 0) & (after > 0.5)).sum(0).double()
    return dict(**shaped, radii=radii, touched=touched, close=close, exact=3 * most.sqrt())


def perspective_of(tan, shift=(0.0, 0.0)):
    """A projection as the 3DGS code makes it."""
    perspective = torch.zeros(4, 4, dtype=torch.float64)
    perspective[0, 0], perspective[1, 1] = 1 / tan[0], 1 / tan[1]
    perspective[0, 2], perspective[1, 2] = shift
    perspective[2, 2], perspective[2, 3], perspective[3, 2] = 1.0001, -0.01, 1
    return perspective


def settings_of(degree=0, shift=(0.0, 0.0), **changes):
    """A rotated camera at a distance of 2, with matrices made as the 3DGS code makes them."""
    view = torch.eye(4, dtype=torch.float64)
    view[:3, :3] = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64))[0]
    view[:3, :3] *= torch.linalg.det(view[:3, :3]).sign()
    view[:3, 3] = torch.tensor([0.1, -0.2, 2.0])
    tan = math.tan(0.4), math.tan(0.5)
    made = dict(
        image_height=HEIGHT, image_width=WIDTH, tanfovx=tan[0], tanfovy=tan[1],
        bg=torch.rand(3), scale_modifier=1.0, viewmatrix=view.T.float(),
        projmatrix=(perspective_of(tan, shift) @ view).T.float(), sh_degree=degree,
        campos=torch.linalg.inv(view)[:3, 3].float(), prefiltered=False, debug=False,
    )  # fmt: skip
    return GaussianRasterizationSettings(**{**made, **changes})


def moved_by(settings, twist):
    """The settings in float64 with the camera moved by exp(rho, theta), ``twist`` being both."""
    x, y, z = twist[3:]
    zero = torch.zeros_like(x)
    rows = [zero, -z, y, twist[0]], [z, zero, -x, twist[1]], [-y, x, zero, twist[2]], [zero] * 4
    generator = torch.stack([torch.stack(row) for row in rows])
    view = torch.linalg.matrix_exp(generator) @ settings.viewmatrix.double().T
    perspective = perspective_of((settings.tanfovx, settings.tanfovy))
    center = torch.linalg.inv(view)[:3, 3]
    return settings._replace(viewmatrix=view.T, projmatrix=(perspective @ view).T, campos=center)


def scene_of(num=150, shs=None):
    """Gaussians around the camera's axis, beside the image, near the camera and behind it."""
    means = torch.randn(num, 3) * torch.tensor([0.7, 0.7, 1.0])
    scales = torch.exp(torch.randn(num, 3) - 2.5)
    scales[:10] *= 10
    scales[10:20] *= 1e-3
    opacities = torch.rand(num, 1)
    opacities[20:50] = 0.9999
    opacities[50:60] = 0.003
    colors = torch.rand(num, 3) if shs is None else torch.randn(num, shs, 3)
    rotations = torch.nn.functional.normalize(torch.randn(num, 4), dim=-1)
    rotations[60:70] *= 1.1  # not of length 1, which nobody makes so
    names = "means3D", "means2D", "opacities", "colors", "scales", "rotations"
    return dict(zip(names, (means, torch.zeros(num, 3), opacities, colors, scales, rotations)))


def draw(scene, settings):
    """Results of the drop-in, under the original's names of arguments."""
    others = {name: x for name, x in scene.items() if name != "colors"}
    name = "colors_precomp" if scene["colors"].dim() == 2 else "shs"
    return GaussianRasterizer(settings)(**others, **{name: scene["colors"]})


def draw_first(scene, settings):
    """Results of the reference, and the leaves."""
    x = {name: value.detach().double().requires_grad_() for name, value in scene.items()}
    colors, campos = x["colors"], settings.campos.double()
    if colors.dim() == 3:
        given = colors[None], x["means3D"][None], campos[None, None]
        colors = colors_by_formula(settings.sh_degree, *given)[0, 0]
    if "cov3D_precomp" in x:
        covars = whole(x["cov3D_precomp"])
    else:
        covars = covariances(x["scales"], settings.scale_modifier, x["rotations"])
    given = x["means3D"], x["means2D"], x["opacities"][:, 0], colors, covars, settings
    return render(*given, bool(settings.antialiasing)), x


def with_covariances(scene, modifier):
    scene = dict(scene)
    covars = covariances(scene.pop("scales"), modifier, scene.pop("rotations"))
    scene["cov3D_precomp"] = covars[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    return scene


CASES = {
    "colours": {},
    "harmonics": dict(shs=16, settings=dict(degree=3)),
    "harmonics of degree 1": dict(shs=9, settings=dict(degree=1)),
    "covariances": dict(covars=True),
    "antialiased": dict(settings=dict(antialiasing=True)),
    "antialiased covariances": dict(covars=True, settings=dict(antialiasing=True)),
    "scaled": dict(settings=dict(scale_modifier=1.7, antialiasing=False)),
    "off centre": dict(settings=dict(shift=(0.3, -0.2))),
}


def compare(name: str, layers=("inverse",)) -> None:
    """Fail unless images, gradients and radii of a case are the reference's; also any layers."""
    case = CASES[name]
    settings = settings_of(**case.get("settings", {}))
    scene = scene_of(shs=case.get("shs"))
    if case.get("covars"):
        scene = with_covariances(scene, 1.0)
    leaves = {key: value.requires_grad_() for key, value in scene.items()}
    color, radii, *others = draw(leaves, settings)
    want, expected = draw_first(scene, settings)
    clear = ~want["close"]
    assert clear.float().mean() > 0.97 and len(others) in (0, len(layers))
    assert color.shape == (3, HEIGHT, WIDTH) and radii.dtype == torch.int32
    found = {"color": color, **dict(zip(layers, others))}
    for kind, image in found.items():
        assert_rel_rms(image[:, clear], want[kind][:, clear], IMAGE, kind)
    v = [torch.randn_like(image) * clear for image in found.values()]
    torch.autograd.backward([*found.values()], v)
    torch.autograd.backward([want[kind] for kind in found], [x.double() for x in v])
    for key in leaves:
        assert_rel_rms(leaves[key].grad, expected[key].grad, GRADIENT, key)
    # a radius may be rounded to the other side of an integer
    even = (want["exact"] - want["exact"].round()).abs() > 1e-4
    assert torch.equal(radii[even].double(), want["radii"][even]) and even.float().mean() > 0.97
    assert (radii == 0).any() and (radii > 0)[scene["opacities"][:, 0] < 1 / 255].any()
