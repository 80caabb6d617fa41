"""Decoder ``rays``: computed tokens, positions of Gaussians, and initialization."""

import numpy as np
import pytest
import torch
from helpers.model import BOXES, NOTHING, assert_each_alone, cut_outs, micro
from helpers.refusals import refused
from torch.nn.functional import max_pool2d

from gamba_warp.cameras import Cameras, intrinsics, orbit
from gamba_warp.eval.views.baselines import billboard
from gamba_warp.eval.views.compare import GroundTruth
from gamba_warp.image_metrics import mask_iou, psnr, ssim
from gamba_warp.model.config import GambaConfig
from gamba_warp.model.gamba import Gamba
from gamba_warp.model.parts.patches import find_foreground
from gamba_warp.model.parts.rays import RayDecoder
from gamba_warp.model.predict import model_input, reconstruct
from gamba_warp.render import render


def rays(**changes) -> GambaConfig:
    """A micro configuration with 2 x 2 cells a patch and 3 layers, without an encoder."""
    wanted = {"decoder": "rays", "encoder": "none", "ray_cells": 2, "ray_layers": 3}
    return micro(**(wanted | {"ray_features": 5} | changes))


def trained(config: GambaConfig) -> Gamba:
    """Model with a head that has an effect, unlike that of an untrained one."""
    torch.manual_seed(4)
    model = Gamba(config, "random" if config.encoder != "none" else None)
    torch.nn.init.normal_(model.decoder.head.weight, std=0.5)
    return model


@pytest.mark.parametrize("segment", [4096, 7])
def test_a_batch_of_different_sizes_is_each_image_alone(monkeypatch, segment):
    """Also if the batch's row of tokens is cut inside images."""
    monkeypatch.setattr("gamba_warp.model.parts.block.SEGMENT", segment)
    model, (rgba, cameras) = trained(rays()), cut_outs([*BOXES, NOTHING])
    cells = 9, 1, 24, 0
    with torch.set_grad_enabled(segment > 7):
        together = assert_each_alone(model, rgba, cameras, cells)
    assert together.num == 24 * 3  # the largest has 24 of the 36 cells
    for opacities, count in zip(together.opacities, cells):
        assert opacities[3 * count :].eq(0).all()


@pytest.mark.parametrize("encoder", ["none", "gamba_test_vit"])
def test_gradients_of_a_batch_are_those_of_its_images(encoder):
    """Of four images in one row of tokens, one of them empty."""
    model = trained(rays(encoder=encoder))
    rgba, cameras = cut_outs([*BOXES, NOTHING])
    weights = {name: p for name, p in model.named_parameters() if p.requires_grad}

    def gradients(rgba, cameras):
        made = model(rgba, cameras)
        seen = (made.opacities > 0)[..., None]
        others = (made.means, made.scales, made.colors)
        values = [made.opacities, *(value * seen for value in others)]
        loss = sum(value.square().sum() for value in values)
        found = torch.autograd.grad(loss, list(weights.values()), allow_unused=True)
        return [torch.zeros(()) if g is None else g for g in found]

    alone = [gradients(rgba[i : i + 1], cameras[[i]]) for i in range(4)]
    for name, got, *wanted in zip(weights, gradients(rgba, cameras), *alone):
        torch.testing.assert_close(got, sum(wanted), rtol=1e-4, atol=1e-5, msg=name)


@pytest.mark.parametrize("cells", [1, 2, 4])
def test_the_stem_sees_the_own_rows_and_columns_as_the_whole(cells):
    """The object's patches, an empty image, and one that touches three sides."""
    torch.manual_seed(6)
    model = Gamba(rays(ray_cells=cells, image_size=40))
    decoder = model.decoder
    boxes = [(slice(21, 22), slice(17, 18)), NOTHING, (slice(9, 40), slice(0, 40))]
    rgba = torch.rand(3, 40, 40, 4)
    for image, (rows, columns) in zip(rgba, boxes):
        image[..., 3] = 0
        image[rows, columns, 3] = 1
    pixels = torch.rand(3, model.config.pixel_channels, 40, 40)
    seen = find_foreground(rgba[..., 3], model.config)
    image, row, column = seen.cell
    got = decoder._stem(pixels, seen)
    want = decoder.stem(pixels).permute(0, 2, 3, 1)[image, row, column]
    assert seen.counts[1] == 0 and sum(seen.counts) == len(got)
    torch.testing.assert_close(got, want, rtol=1e-5, atol=1e-6)
    weights = list(decoder.stem.parameters())
    grads = (torch.autograd.grad(made.square().sum(), weights) for made in (got, want))
    for ours, theirs in zip(*grads):
        torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-5)
    assert seen.boxes == [(5, 4, 9, 8), (0, 0, 4, 4), (2, 0, 10, 10)]


@pytest.mark.parametrize("additive, orders", [(True, 4), (False, 4), (True, 2)])
def test_tokens_of_patches_are_those_of_the_whole_in_their_order(additive, orders):
    model = Gamba(rays(additive_image_tokens=additive, num_orders=orders))
    tokens, (rgba, cameras) = model.tokens, cut_outs()
    whole = tokens(rgba, cameras)
    seen = find_foreground(rgba[..., 3], model.config)
    got = tokens.of_patches(tokens.pixels(rgba, cameras), seen)
    image, row, column = seen.patch
    inside = torch.zeros(len(rgba), 9, dtype=torch.bool)
    inside[image, 3 * row + column] = True
    assert (seen.cu_seqlens.diff() == orders * inside.sum(1)).all()
    torch.testing.assert_close(got, whole[inside[:, tokens.orders]])
    for place, index, patch in zip(seen.positions, image, 3 * row + column):
        for order in range(orders):
            number = 9 * order + tokens.orders.view(orders, 9)[order].tolist().index(patch)
            torch.testing.assert_close(got[place[order]], whole[index, number])


def test_a_image_without_background_keeps_every_token():
    seen = find_foreground(torch.ones(2, 12, 12), rays())
    assert seen.tokens.tolist() == [*range(36)] * 2 and seen.cu_seqlens.tolist() == [0, 36, 72]


@pytest.mark.parametrize("rotation", [False, True])
def test_gaussians_follow_the_formulas(rotation):
    """Known answer: every output of the head is set by hand; one Gaussian is recomputed."""
    config = rays(predict_rotation=rotation)
    model, (rgba, cameras) = Gamba(config), cut_outs()
    numbers = [0.3, -0.2, 0.5, 0.1, 0.7, 0.2, -0.4, 0.6, 0.3, -0.1, 0.25]
    numbers += [0.1, 0.2, -0.3, 0.4] if rotation else []
    decoder = model.decoder
    with torch.no_grad():
        decoder.head.weight.zero_()
        decoder.head.bias.copy_(torch.tensor(numbers).repeat(3))
    made = model(rgba, cameras)
    place = (3 * 1 + 1) * 3 + 2  # image 0: the middle one of 3 x 3 cells, the last layer
    square = rgba[0, 6:8, 2:4].double().numpy()
    alpha = square[..., 3].mean()
    color = (square[..., :3] * square[..., 3:]).mean((0, 1)) / alpha
    K, view = cameras.Ks[0].double().numpy(), cameras.viewmats[0].double().numpy()
    distance = np.linalg.norm(view[:3, 3])
    ray = np.array([(3 - K[0, 2]) / K[0, 0], (7 - K[1, 2]) / K[1, 1], 1.0])
    point = ray * (distance + 0.5 * np.tanh(np.arctanh(0.7) + 0.3))
    point = point + 0.3 * np.tanh([-0.2, 0.5, 0.1])
    want = {
        "means": view[:3, :3].T @ (point - view[:3, 3]),
        "scales": 2 * distance / K[1, 1] * np.exp(np.log(0.6) + np.array([0.2, -0.4, 0.6])),
        "opacities": 1 / (1 + np.exp(5.4 - 10 * (alpha - 1) - 0.7)),
        "colors": 1 / (1 + (1 / color - 1) * np.exp(-2 * np.array([0.3, -0.1, 0.25]))),
    }
    for name, value in want.items():
        got = getattr(made, name)[0, place].detach().double().numpy()
        np.testing.assert_allclose(got, value, rtol=2e-5, err_msg=name)
    if rotation:
        got = made.quats[0, place].tolist()
        assert got == pytest.approx([1.1, 0.2, -0.3, 0.4], abs=1e-6)
    else:
        assert made.quats is None


def test_wild_sizes_and_almost_empty_cells_have_limits():
    model, (rgba, cameras) = Gamba(rays()), cut_outs([(slice(4, 6), slice(4, 6))])
    rgba[0, 4:6, 6:8] = torch.tensor([0.6, 0.6, 0.6, 5e-4])  # the cell beside, of the same patch
    decoder = model.decoder
    with torch.no_grad():
        decoder.head.weight.zero_()
        decoder.head.bias.view(3, -1)[:, 5:8] = torch.tensor([50.0, -50.0, 0.0])
        made = model(rgba, cameras)
    footprint = 2 * cameras.viewmats[0, :3, 3].norm() / cameras.Ks[0, 1, 1]
    want = footprint * torch.tensor([3.0, -4.0]).exp()
    torch.testing.assert_close(made.scales[0, :, :2], want.expand(made.num, 2))
    # Under an alpha of 0.001 a colour fades to black.
    faint = made.colors[0].view(2, 3, 3)[1]
    torch.testing.assert_close(faint, torch.full((3, 3), 0.3), rtol=1e-4, atol=0)


def disc(size: int = 48) -> tuple[torch.Tensor, Cameras]:
    """Coloured disc with a soft boundary, as a flat image seen by five cameras around it."""
    x = torch.linspace(-1, 1, size)
    radius = (x[:, None] ** 2 + x**2).sqrt()
    alpha = ((0.7 - radius) * size / 2 + 0.5).clamp(0, 1)
    color = torch.stack([(7 * x).sin().expand(size, size), (5 * x).cos()[:, None] + 0 * x, radius])
    rgba = torch.cat([0.5 + 0.3 * color.clamp(-1, 1), alpha[None]]).permute(1, 2, 0)
    viewmats = orbit(torch.tensor([0.0, 30.0, -50.0, 140.0, 215.0]), 0.0)
    return rgba, Cameras(viewmats, intrinsics(size, size).expand(5, 3, 3), size, size)


def test_at_the_start_the_image_is_the_billboard():
    """The flat image is the truth: only the blur of one Gaussian at the edges differs."""
    rgba, cameras = disc()
    gt = GroundTruth("disc", rgba.expand(5, -1, -1, -1), cameras, [*range(5)])
    flat, alpha = billboard(gt)
    config = rays(image_size=48, ray_cells=4, width=8)
    with torch.no_grad():
        made = Gamba(config)(rgba[None], cameras[[0]])
    shown = render(made, Cameras(cameras.viewmats[None], cameras.Ks[None], 48, 48), torch.ones(3))
    rgb = shown.rgb[0].clamp(0, 1)
    # The smallest Gaussian blurs the boundary, which is a tenth of this small disc.
    assert psnr(rgb, flat).min() > 27 and ssim(rgb, flat).min() > 0.94
    assert mask_iou(shown.alpha[0, ..., 0] > 0.5, alpha > 0.5).min() > 0.93


def test_the_hidden_layers_are_seen_by_the_rasterizer_from_the_start():
    """Below an opacity of 1/255 a Gaussian is culled and would never learn."""
    model, (rgba, cameras) = Gamba(rays()), cut_outs()
    rgba[..., 3] = (rgba[..., 3] > 0).float()
    made = model(rgba, cameras)
    opacities = made.opacities.unflatten(1, (-1, 4, 3))[2]
    assert opacities[..., 1:].max() > 1.05 / 255 and opacities[..., 1:].max() < 0.006


def test_an_opaque_back_is_as_opaque_as_its_cell_whatever_the_head_says():
    model, (rgba, cameras) = trained(rays(ray_back="opaque")), cut_outs(BOXES[2:])
    rgba[..., 3] = rgba[..., 3].ceil()
    front, middle, back = model(rgba, cameras).opacities[0].unflatten(0, (-1, 3)).unbind(-1)
    full = back > 0.01
    torch.testing.assert_close(back[full], torch.full_like(back[full], 2.0).sigmoid())
    # The box has 12 x 8 pixels, and a cell 2 x 2.
    assert full.sum() == 24 and front[full].std() > 0.01 and middle[full].std() > 1e-4
    refused("ray_back opaque needs two ray_layers", rays, ray_back="opaque", ray_layers=1)


def test_an_empty_image_has_no_gaussians_and_may_stand_in_a_batch():
    model, (rgba, cameras) = Gamba(rays()), cut_outs()
    empty = torch.zeros_like(rgba[:1])
    made = model(empty, cameras[[0]])
    assert made.num == 0
    views = Cameras(cameras.viewmats[:1, None], cameras.Ks[:1, None], 12, 12)
    assert render(made, views, torch.ones(3)).rgb.eq(1).all()
    made = model(torch.cat([empty, rgba[:1]]), cameras[:2])
    assert made.opacities[0].eq(0).all() and made.opacities[1].max() > 0.1
    sum(value.sum() for value in (made.means, made.colors, made.scales)).backward()
    assert all(p.grad is None or p.grad.isfinite().all() for p in model.parameters())


@pytest.mark.parametrize(
    "changes",
    [
        {"patch_size": 6, "ray_cells": 3, "ray_layers": 1},
        {"patch_size": 2, "ray_cells": 1, "ray_layers": 5},
        {"encoder": "gamba_test_vit"},
        {"ray_cells": 4, "ray_coarse": 2, "ray_hidden": 7},
        {"ray_cells": 2, "ray_coarse": 1},
        {"prepend": False, "norm": "rms", "discretization": "zoh"},
    ],
)
def test_other_shapes_and_recompute(changes):
    model, (rgba, cameras) = trained(rays(**changes)), cut_outs()
    config, grads = model.config, []
    for model.checkpointing in (False, True):
        made = model(rgba, cameras)
        cells = max_pool2d(rgba[..., 3], config.patch_size // config.ray_cells) > 0
        assert made.num == cells.sum((1, 2)).max() * config.ray_layers
        made.means.square().sum().backward()
        grads.append(model.decoder.up.weight.grad.clone())
        model.zero_grad()
    torch.testing.assert_close(*grads)


def test_the_margin_lets_the_network_see_more_patches():
    model, (rgba, cameras) = trained(rays()), cut_outs([BOXES[1]])
    near, wide = model(rgba, cameras), model(rgba, cameras, background_margin=1)
    assert near.num == wide.num == 3 and (near.means - wide.means).abs().max() > 1e-3


def test_sizes_that_do_not_fit_are_refused():
    refused("patch_size 4 is not a multiple of ray_cells 3", rays, ray_cells=3)
    refused("ray_cells 4 is not a multiple of ray_coarse 3", rays, ray_cells=4, ray_coarse=3)
    with pytest.raises(ValueError, match=r"images is \(1, 12, 12, 3\), expected"):
        Gamba(rays())(torch.rand(1, 12, 12, 3), cut_outs()[1][[0]])


def test_reconstruct_gives_the_alpha_to_the_model():
    rgba = disc(40)[0].numpy()
    small = model_input(rgba, rays())
    assert small.shape == (1, 12, 12, 4) and small[0, 0, 0, 3] == 0 and small[0, 6, 6, 3] == 1
    # No colour of transparent pixels bleeds in: inside, a grey disc stays grey.
    grey = np.where(rgba[..., 3:] > 0, [0.4, 0.4, 0.4, 1.0], [0.9, 0.0, 0.0, 0.0]).astype("f4")
    small = model_input(grey, rays())[0]
    torch.testing.assert_close(small[small[..., 3] > 0.01][:, :3].mean(0), torch.full((3,), 0.4))
    assert reconstruct(Gamba(rays()).eval(), rgba).num > 12


def test_features_between_coarse_cells_are_interpolated():
    weights = RayDecoder(rays(ray_cells=4, ray_coarse=2)).upsampling
    assert weights.shape == (16, 4)
    torch.testing.assert_close(weights.sum(1), torch.ones(16))
    # The corner of a patch has its own coarse cell alone, the middle a fraction of all four.
    torch.testing.assert_close(weights[0], torch.tensor([1.0, 0, 0, 0]))
    torch.testing.assert_close(weights[5], torch.tensor([9.0, 3, 3, 1]) / 16)
