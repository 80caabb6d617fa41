"""Decoder ``triplane`` (paper, answer A3): sampling, decoding, the branch of the planes."""

import pytest
import torch
from helpers import assert_rel_rms
from helpers.model import FIELDS, inputs, micro

from gamba_warp.model.checkpoint import outline
from gamba_warp.model.config import GambaConfig
from gamba_warp.model.gamba import Gamba
from gamba_warp.model.parts.block import run_blocks
from gamba_warp.model.parts.triplane import TriplaneDecoder, query_planes

PLANES = {"decoder": "triplane", "triplane_size": 3, "triplane_features": 5}


def looked_up(planes: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
    """Sample point by point: ``planes [3, C, n, n]`` and ``points [N, 3]`` to ``[N, 3C]``."""
    side, found = planes.shape[-1], []
    for point in points.tolist():
        x, y, z = (min(max((p + 1) * side / 2 - 0.5, 0.0), side - 1.0) for p in point)
        parts = []
        for plane, (across, down) in zip(planes, ((x, y), (x, z), (y, z))):
            value = torch.zeros(plane.shape[0], dtype=planes.dtype)
            for row in range(side):
                for column in range(side):
                    fraction = max(0.0, 1 - abs(row - down)) * max(0.0, 1 - abs(column - across))
                    value += fraction * plane[:, row, column]
            parts.append(value)
        found.append(torch.cat(parts))
    return torch.stack(found)


def test_points_are_looked_up_between_four_cells():
    planes = torch.randn(2, 3, 4, 5, 5, dtype=torch.float64)
    points = 2.4 * torch.rand(2, 40, 3, dtype=torch.float64) - 1.2  # some of them beyond the edge
    corners = torch.cartesian_prod(*[torch.tensor([-1.0, 0.8, 1.0], dtype=torch.float64)] * 3)
    points = torch.cat([points, corners.expand(2, -1, -1)], 1)
    got = query_planes(planes, points)
    for image in range(2):
        torch.testing.assert_close(got[image], looked_up(planes[image], points[image]))
    # The corner itself has the outermost cell's features, and so have points beyond it.
    torch.testing.assert_close(got[0, 40, :4], planes[0, 0, :, 0, 0])
    far = query_planes(planes, torch.full((2, 1, 3), 7.0, dtype=torch.float64))
    torch.testing.assert_close(far[1, 0, 8:], planes[1, 2, :, 4, 4])


def test_gradients_of_the_look_up():
    planes = torch.randn(2, 3, 2, 3, 3, dtype=torch.float64, requires_grad=True)
    # Away from the cells' centres, where the slope jumps: those are at -2/3, 0 and 2/3.
    points = torch.tensor([[-0.9, -0.3, 0.2], [0.5, 0.95, -0.5], [0.3, -1.3, 0.4]]).double()
    points = torch.stack([points, points.flip(1)]).requires_grad_()
    assert torch.autograd.gradcheck(query_planes, (planes, points))


def decoded(**changes) -> tuple[TriplaneDecoder, torch.Tensor, torch.Tensor]:
    decoder = TriplaneDecoder(micro(**(PLANES | changes)))
    torch.nn.init.normal_(decoder.plane_color.weight, std=0.5)
    return decoder, torch.randn(2, 33, 16), torch.randn(2, 3, 5, 3, 3)


@pytest.mark.parametrize("changes", [{}, {"position_weights": "unit", "position_range": 0.4}])
def test_colours_are_an_mlp_of_what_the_positions_find(changes):
    decoder, tokens, planes = decoded(**changes)
    made = decoder(tokens, planes)
    p = {name: value.double() for name, value in decoder.state_dict().items()}
    for image in range(2):
        points = made.means[image].detach().double() / decoder.config.position_range
        hidden = looked_up(planes[image].double(), points)
        for layer in (0, 2):
            hidden = hidden @ p[f"plane_mlp.{layer}.weight"].T + p[f"plane_mlp.{layer}.bias"]
            hidden = hidden / (1 + torch.exp(-hidden))
        logits = hidden @ p["plane_color.weight"].T + p["plane_color.bias"]
        # Float32 against float64.
        assert_rel_rms(made.colors[image], 1 / (1 + torch.exp(-logits)), 2e-6, "colours")


def test_other_attributes_are_those_of_the_paper_s_decoder():
    model = Gamba(micro(encoder="none", **PLANES))
    plain = Gamba(micro(encoder="none"))
    shared = {n: v for n, v in model.state_dict().items() if n in plain.state_dict()}
    missing = plain.load_state_dict(shared, strict=False).missing_keys
    assert missing == ["decoder.color.weight", "decoder.color.bias"]
    batch = inputs(2)
    for name in FIELDS[:3]:
        assert torch.equal(getattr(model(*batch), name), getattr(plain(*batch), name)), name


def test_order_of_the_tokens_is_that_of_the_gaussians():
    decoder, tokens, planes = decoded()
    order = torch.randperm(33)
    made, other = decoder(tokens, planes), decoder(tokens[:, order], planes)
    for name in FIELDS:
        # Products of the same rows at other places.
        got, want = getattr(made, name)[:, order], getattr(other, name)
        torch.testing.assert_close(got, want, rtol=1e-5, atol=1e-6)


def test_colours_move_the_planes_and_no_position():
    decoder, tokens, planes = decoded()
    (decoder(tokens, planes.requires_grad_()).colors * torch.randn(2, 33, 3)).sum().backward()
    assert planes.grad.abs().max() > 0
    assert decoder.position.weight.grad is None and decoder.mlp[0].weight.grad is None


def test_float32_under_autocast():
    decoder, tokens, planes = decoded()
    want = decoder(tokens, planes)
    with torch.autocast("cpu", torch.bfloat16):
        made = decoder(tokens, planes.bfloat16())
    for name in FIELDS:
        assert getattr(made, name).dtype == torch.float32
    # bfloat16 keeps 8 bits, through the planes and two layers.
    assert_rel_rms(made.colors, want.colors, 2e-2, "colours")


def test_cells_are_tokens_row_by_row_behind_the_prefix():
    model = Gamba(micro(**PLANES), "random")
    images, cameras = inputs(2)
    condition = model.condition(images, cameras)
    assert len(condition) == 4
    branch = model.planes
    planes = branch(2, condition[2:])
    assert planes.shape == (2, 3, 5, 3, 3)
    tokens = run_blocks(branch.blocks, branch.embedding.expand(2, -1, -1), condition[2:])
    tokens = branch.features(branch.norm(tokens))
    assert torch.equal(planes[1, 2, :, 1, 0], tokens[1, 2 * 9 + 3])
    other = branch(2, model.condition(1 - images, cameras)[2:])
    assert (other - planes).abs().amax((2, 3, 4)).min() > 1e-6
    want, got = model(images, cameras), model(images, cameras, condition)
    assert all(torch.equal(getattr(got, name), getattr(want, name)) for name in FIELDS)


def test_recomputation_and_dropped_background_change_no_colour():
    model = Gamba(micro(encoder="none", **PLANES))
    images, cameras = inputs(1)
    cotangent, grads = torch.randn(1, 36, 3), []
    for model.checkpointing in (False, True):
        model.zero_grad()
        (model(images, cameras).colors * cotangent).sum().backward()
        grads.append(model.planes.embedding.grad.clone())
    assert torch.equal(*grads) and grads[0].abs().max() > 0
    images[:] = 1
    images[0, 5, 5] = 0
    with torch.no_grad():
        made = model(images, cameras, background_margin=0)
        planes = model.planes(1, model.condition(images, cameras)[2:])
    assert made.num == 4 and made.colors.isfinite().all() and planes.isfinite().all()


def test_the_blocks_are_doubled():
    configs = [GambaConfig(encoder="none", dt_rank=32, decoder=d) for d in ("bins", "triplane")]
    assert configs[1].num_gaussians == 16384
    counts = [sum(p.numel() for p in outline(c).parameters()) for c in configs]
    assert 1.75 < counts[1] / counts[0] < 1.85  # E, of 8.4 M parameters, is there once
