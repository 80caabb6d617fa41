"""TF32 only affects the network: rays, projections and SSIM make no products that it would round.

Without a GPU: every matrix product is recorded, with the precision that it would have on one.
"""

from dataclasses import replace

import pytest
import torch
from helpers import micro
from torch.utils._python_dispatch import TorchDispatchMode

from gamba_warp import devices
from gamba_warp.cameras import exact_product, plucker_rays, relative_to_reference
from gamba_warp.data.dataset import ObjectViews
from gamba_warp.devices import float32_products
from gamba_warp.model.parts.decoder import GaussianDecoder
from gamba_warp.model.posing import posed_input, relative_cameras
from gamba_warp.train.objective.losses import depth_loss

PRODUCTS = ("mm", "bmm", "addmm", "baddbmm", "matmul", "linear", "addmv", "mv", "convolution")


class Products(TorchDispatchMode):
    """Records the matrix products of float32 that a GPU would round, by name."""

    def __init__(self):
        super().__init__()
        self.rounded = []

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        name = function.overloadpacket.__name__
        floats = any(isinstance(a, torch.Tensor) and a.dtype == torch.float32 for a in args)
        if name in PRODUCTS and floats and torch.get_float32_matmul_precision() != "highest":
            self.rounded.append(name)
        return function(*args, **(kwargs or {}))


@pytest.fixture(autouse=True)
def high():
    devices._onednn_is_better()  # its trial, once per process, is a product
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("high")  # as in training
    yield
    torch.set_float32_matmul_precision(before)


@pytest.fixture
def cameras():
    views = micro.views_around(5, 17, 13)
    return type(views)(views.viewmats.clone(), views.Ks.clone(), views.width, views.height)


def test_products_are_noted():
    """A layer of a network, forward and backward, would fail the other tests."""
    layer = torch.nn.Linear(3, 4)
    with Products() as seen:
        layer(torch.randn(2, 3)).sum().backward()
        forward = len(seen.rounded)
        with float32_products():
            torch.randn(3, 3) @ torch.randn(3, 3)
    assert forward >= 2 and len(seen.rounded) == forward


def cloud_of(seed):
    """A cloud as a batch of one, of which only the means have a gradient."""
    cloud = micro.cloud(seed).map(lambda value: value[None])
    return replace(cloud, means=torch.nn.Parameter(cloud.means))


def test_rays_poses_and_depths_make_no_products(cameras):
    config, cloud = micro.options(".", ".").model_config(), cloud_of(1)
    images = torch.rand(5, cameras.height, cameras.width, 4)
    with Products() as seen:
        plucker_rays(cameras.viewmats, cameras.Ks, cameras.width, cameras.height)
        relative_to_reference(cameras.viewmats, cameras.viewmats[0])
        relative_cameras(cameras, 2.0)
        posed_input(ObjectViews("a", "a", images, cameras, None, {}), config)
        depth_loss(cloud, 2, cameras[:1], torch.rand(1, 2, 13, 17)).sum().backward()
    assert not seen.rounded and torch.get_float32_matmul_precision() == "high"
    assert cloud.means.grad.abs().max() > 0


def test_a_whole_step_rounds_in_the_network_alone(cameras, tmp_path, monkeypatch):
    """Without a network only projection, rendering, SSIM and the radial mask run, and backward."""
    from gamba_warp.train.batches import Batch
    from gamba_warp.train.step import Objective, compute_gradients, health

    cloud = cloud_of(2)
    inputs, targets = torch.rand(1, 8, 8, 3), torch.rand(1, 5, 13, 17, 4)
    batch = Batch(["a"], inputs, cameras[:1], targets, cameras[None], torch.ones(1, 1, 3))
    weights = {"rgb": 1.0, "mask": 1.0, "ssim": 0.2, "lpips": 0.0, "rdist": 0.1}
    optimizer = torch.optim.SGD([cloud.means], lr=0.1)
    with Products() as seen:
        made = compute_gradients(lambda *_: cloud, optimizer, [batch], Objective(weights))
        health(made.result, batch)
    assert not seen.rounded and made.norm > 0


def test_the_product_is_the_product():
    rows, matrix = torch.randn(4, 1, 7, 3, dtype=torch.float64), torch.randn(2, 3, 5).double()
    rows.requires_grad_()
    matrix.requires_grad_()
    got, want = exact_product(rows, matrix), rows @ matrix
    torch.testing.assert_close(got, want)  # float64's own rounding
    cotangent = torch.randn_like(want)
    for a, b in zip(*(torch.autograd.grad(v, (rows, matrix), cotangent) for v in (got, want))):
        torch.testing.assert_close(a, b)


@pytest.mark.parametrize("weights", ["unit", "softmax"])
def test_the_decoder_places_gaussians_with_all_digits(weights):
    """The layers belong to the network; the sum over the bins for a centre is geometry."""
    config = micro.options(".", ".").model_config()
    decoder = GaussianDecoder(replace(config, position_weights=weights))
    hidden = torch.randn(2, 5, config.decoder_width or config.width, requires_grad=True)
    with Products() as seen:
        sum(x.sum() for x in decoder.shapes(hidden).values() if x is not None).backward()
    assert seen.rounded and not {"mv", "addmv", "bmm", "matmul"} & set(seen.rounded)
