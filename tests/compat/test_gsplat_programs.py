"""Calls as public programs make them, against our formulas in float64."""

import numpy as np
import pytest
import torch
from helpers import assert_rel_rms
from helpers.raster import GRADIENT, PICTURE, leaves, make, near_a_cut, weights_by_pixel

from gamba_warp.compat import VERSIONS, causal_conv1d, gsplat, mamba_ssm
from gamba_warp.kernels.rasterize.harmonics.formula import colors_by_formula
from gamba_warp.kernels.rasterize.reference import render_view

pytestmark = pytest.mark.usefixtures("one_thread")
WIDTH, HEIGHT = 37, 29
GEOMETRY = ("means", "quats", "scales", "opacities", "viewmats")


def scene_of(num=60):
    """One object in one view: ``means [N, 3]``, ``viewmats [1, 4, 4]``, and so on."""
    made = make(1, 1, num, WIDTH, HEIGHT)
    return {k: made[k][0] for k in (*GEOMETRY, "colors", "Ks")}


def view_of(scene, **options):
    """The oracle's colour, depth and alpha, with gsplat's clamp."""
    given = {k: v for k, v in scene.items() if k not in ("viewmats", "Ks", "coefficients")}
    camera = dict(viewmat=scene["viewmats"][0], K=scene["Ks"][0], width=WIDTH, height=HEIGHT)
    return render_view(**given, **camera, alpha_max=0.999, **options)


def compare(found, expected, got, want, keep, names):
    """Pictures, and gradients by name under random cotangents; only of the pixels in ``keep``."""
    v = []
    for a, b in zip(found, expected):
        assert a.shape[:-1] == (1, HEIGHT, WIDTH)
        assert ((a[0] - b) * keep).abs().max() <= PICTURE * max(1.0, b.abs().max().item())
        v.append(torch.randn_like(b) * keep)
    torch.autograd.backward(found, [x[None].float() for x in v])
    torch.autograd.backward(expected, v)
    for name in names:
        assert_rel_rms(got[name].grad, want[name].grad, GRADIENT, name)
    return v


def cut_free(scene, **options):
    """Pixels ``[H, W, 1]`` in which rounding decides nothing."""
    wide = {k: v[None] for k, v in scene.items()} | dict(width=WIDTH, height=HEIGHT)
    flip = near_a_cut(wide, {"alpha_max": 0.999, **options})[0, 0]
    assert flip.float().mean() < 0.05
    return ~flip[..., None]


def test_sharp():
    """apple/ml-sharp, ``GSplatRenderer``: no dilation; sizes of numpy; reads ``meta["conics"]``."""
    scene = scene_of()
    scene["scales"][::7, 2] = 0  # flat
    scene["scales"][::9] = torch.tensor([0.1, 0, 0])  # lines, which have no footprint
    got, want = leaves(scene, torch.float32), leaves(scene, torch.float64)
    renders, alphas, meta = gsplat.rasterization(
        **got, width=np.int64(WIDTH), height=torch.tensor(HEIGHT), render_mode="RGB+D",
        rasterize_mode="classic", absgrad=False, packed=False, eps2d=0.0,
    )  # fmt: skip
    color, depth, alpha = view_of(want, eps2d=0.0)
    keep = cut_free(scene, eps2d=0.0)
    expected = [torch.cat([color, depth], -1), alpha]
    compare([renders, alphas], expected, got, want, keep, (*GEOMETRY, "colors"))
    assert (meta["radii"][0, ::9] == 0).all() and meta["conics"].isfinite().all()
    assert type(meta["width"]) is int and type(meta["height"]) is int
    # lines are culled before their determinant is divided by
    assert all((got[name].grad[::9] == 0).all() for name in ("means", "quats", "scales"))


@pytest.mark.parametrize("packed", [True, False])
def test_sam_3d_objects(packed):
    """facebookresearch/sam-3d-objects: harmonics of degree 0, one background ``[3]``, packed."""
    scene = scene_of()
    shs, ground = torch.randn(60, 1, 3), torch.rand(3)
    got, want = leaves(scene, torch.float32), leaves(scene, torch.float64)
    (a, ground_a), (b, ground_b) = (
        (shs.detach().to(t).requires_grad_(), ground.detach().to(t).requires_grad_())
        for t in (torch.float32, torch.float64)
    )
    got["colors"] = a
    renders, alphas, _ = gsplat.rasterization(
        **got, sh_degree=0, width=WIDTH, height=HEIGHT, backgrounds=ground_a, packed=packed
    )
    want["colors"] = (0.28209479177387814 * b[:, 0] + 0.5).clamp_min(0)
    color, _, alpha = view_of(want)
    got["ground"], want["ground"] = ground_a, ground_b
    want["shs"], got["shs"] = b, a
    expected = [color + (1 - alpha) * ground_b, alpha]
    names = (*GEOMETRY, "shs", "ground")
    compare([renders, alphas], expected, got, want, cut_free(scene), names)


def test_backgrounds_of_any_shape():
    scene = make(2, 3, 30, WIDTH, HEIGHT)
    for ground in (torch.rand(3), torch.rand(3, 3)):
        scene["backgrounds"] = ground.expand(2, 3, 3)
        want = gsplat.rasterization(**scene)[0]
        assert torch.equal(gsplat.rasterization(**scene | {"backgrounds": ground})[0], want)


def test_splatfacto():
    """nerfstudio's splatfacto: expected depth, harmonics, and absolute gradients by pixel."""
    scene = scene_of()
    coefficients = torch.randn(60, 16, 3)
    got, want = leaves(scene, torch.float32), leaves(scene, torch.float64)
    got["colors"], want["sh"] = coefficients.requires_grad_(), coefficients.detach().double()
    want["sh"].requires_grad_()
    renders, alphas, meta = gsplat.rasterization(
        **got, width=WIDTH, height=HEIGHT, packed=False, near_plane=0.01, far_plane=1e10,
        render_mode="RGB+ED", sh_degree=3, sparse_grad=False, absgrad=True,
        rasterize_mode="classic",
    )  # fmt: skip
    meta["means2d"].retain_grad()
    shown = {k: v for k, v in want.items() if k != "sh"}
    centers = torch.linalg.inv(want["viewmats"])[None, :, :3, 3]
    colors = colors_by_formula(3, want["sh"][None], want["means"][None], centers)[0, 0]
    color, depth, alpha = view_of(shown | {"colors": colors})
    # an expected depth is divided by alpha, which has lost digits where a pixel is faint
    keep = cut_free(scene) & (alpha.detach() > 0.2)
    expected = [torch.cat([color, depth / alpha.clamp_min(1e-10)], -1), alpha]
    got["sh"] = got["colors"]
    v, v_alpha = compare([renders, alphas], expected, got, want, keep, (*GEOMETRY, "sh"))

    order = meta["depths"][0].argsort()
    order = order[(meta["radii"][0, order] > 0).all(-1)]
    parts = [meta[k][0, order].detach() for k in ("means2d", "conics", "opacities")]
    each, weights = weights_by_pixel(*parts, WIDTH, HEIGHT)
    channels = torch.cat([colors.detach()[order], meta["depths"][0, order, None].detach()], 1)
    blended, total = weights @ channels, weights.sum(1, keepdim=True)
    pixels = torch.cat([blended[:, :3], blended[:, 3:] / total.clamp_min(1e-10)], 1)
    torch.autograd.backward([pixels, total], [x.flatten(0, 1) for x in (v, v_alpha)])
    assert_rel_rms(meta["means2d"].grad[0, order], each.grad.sum(0), GRADIENT, "means2d")
    assert_rel_rms(meta["means2d"].absgrad[0, order], each.grad.abs().sum(0), GRADIENT, "absgrad")


@pytest.mark.parametrize("packed", [False, True])
def test_simple_trainer(packed):
    """gsplat's simple_trainer: Adam of the Gaussians that a step has seen."""
    scene = scene_of()
    scene["means"][:9] *= 30
    params = {name: torch.nn.Parameter(scene[name].clone()) for name in ("means", "colors")}
    lr, eps, betas = 0.01, 1e-8, (0.9, 0.999)
    optimizers = [
        gsplat.SelectiveAdam([{"params": x, "lr": lr, "name": name}], eps=eps, betas=betas)
        for name, x in params.items()
    ]
    want = {name: (x.detach().double(), 0.0, 0.0) for name, x in params.items()}
    for _ in range(2):
        given = {**scene, **params}
        renders, _, info = gsplat.rasterization(
            **given, width=WIDTH, height=HEIGHT, packed=packed, backgrounds=torch.rand(1, 3)
        )
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
    with pytest.raises(ValueError, match="^valid has 59 rows, allowed is 60"):
        x.grad = torch.ones_like(x)
        optimizers[-1].step(seen[1:])


def test_names_of_older_versions():
    from gamba_warp.compat.gsplat.cuda_legacy._torch_impl import quat_to_rotmat
    from gamba_warp.compat.gsplat.cuda_legacy._wrapper import num_sh_bases
    from gamba_warp.compat.gsplat.optimizers.selective_adam import SelectiveAdam

    assert SelectiveAdam is gsplat.SelectiveAdam
    assert [num_sh_bases(degree) for degree in range(6)] == [1, 4, 9, 16, 25, 25]
    quarter = quat_to_rotmat(torch.tensor([[2.0, 0, 0, 2.0]]))  # about z
    assert torch.allclose(quarter, torch.tensor([[[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]]), atol=1e-6)
    packages = dict(gsplat=gsplat, mamba_ssm=mamba_ssm, causal_conv1d=causal_conv1d)
    assert {name: package.__version__ for name, package in packages.items()} == VERSIONS


@pytest.mark.parametrize("value", [0, True, 3.0, "7", torch.tensor(2.5), 2**15 + 1])
def test_sizes_are_integers(value):
    with pytest.raises(ValueError, match="^height is .*allowed are integers from 1 to 32768"):
        gsplat.rasterization(**scene_of(), width=np.int32(4), height=value)
