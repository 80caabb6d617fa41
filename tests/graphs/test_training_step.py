"""The model and a training step on a fake GPU: no operation may synchronise with the host."""

from dataclasses import replace

import pytest
import torch
from helpers.kernels import Watch
from ptx import dry_run

from gamba_warp.cameras import Cameras
from gamba_warp.kernels.rasterize.cuda import capacity
from gamba_warp.model.config import PRESETS
from gamba_warp.model.gamba import Gamba
from gamba_warp.train.data.samples import Batch
from gamba_warp.train.step import Objective, forward


@pytest.fixture
def on_paper(monkeypatch):
    """Fake tensors on a missing GPU, where the rasterizer's capacity is known."""
    if not dry_run.can_dry_run():
        pytest.skip(f"torch {torch.__version__} needs a GPU for it")
    room = capacity.Capacity(0, 1 << 20)
    monkeypatch.setattr(capacity, "find", lambda key, device: room)
    with dry_run.dry_run() as launches:
        yield launches


def cameras(*lead, size):
    return Cameras(torch.empty(*lead, 4, 4), torch.empty(*lead, 3, 3), size, size)


@pytest.mark.parametrize("radial", [0.0, 0.1])
def test_a_graph_can_hold_a_training_step(on_paper, radial):
    """Network, rendering, losses, gradients, clipping and AdamW."""
    objects, views, size = 2, 3, 64
    config = replace(PRESETS["paper"], depth=1)
    with torch.device("cuda"):
        model = Gamba(config, "random")
        side = config.image_size
        batch = Batch(
            [*"ab"],
            torch.empty(objects, side, side, 3),
            cameras(objects, size=side),
            torch.empty(objects, views, size, size, 4),
            cameras(objects, views, size=size),
            torch.empty(objects, 1, 3),
        )
        parameters = [p for p in model.parameters() if p.requires_grad]
        rate = torch.full((), 1e-3)
        optimizer = torch.optim.AdamW(parameters, lr=rate, foreach=True, capturable=True)
    weights = {"rgb": 1.0, "mask": 1.0, "ssim": 0.2, "rdist": radial}
    with Watch() as watch:
        result = forward(model, batch, Objective(weights))
        dry_run.run_backward([result.loss])
        for p in parameters:
            p.grad = torch.empty_like(p)
        torch.nn.utils.clip_grad_norm_(parameters, 1.0)
        optimizer.step()
    assert watch.found == []
    names = [launch.kernel.func.__name__ for launch in on_paper]
    for name in ("scan_forward", "scan_backward", "composite", "composite_vjp", "_note"):
        assert name in names
    assert {"aten::_foreach_addcdiv_.Scalar", "gamba_warp::rasterize_bin"} <= watch.names


def autocast(monkeypatch):
    """Autocast for a fake GPU; otherwise it disables itself."""
    with monkeypatch.context() as patched:
        patched.setattr(torch.cuda, "is_available", lambda: True)
        patched.setattr(torch.cuda, "is_bf16_supported", lambda *_: True)
        return torch.autocast("cuda", torch.bfloat16)


def test_a_graph_can_hold_the_model(monkeypatch, on_paper):
    """No operator of the forward pass synchronises with the GPU, including our own."""
    config = replace(PRESETS["paper"], depth=2)
    with torch.device("cuda"):
        model = Gamba(config, "random").eval()
        cameras = Cameras(torch.empty(1, 4, 4), torch.empty(1, 3, 3), 512, 512)
        image = torch.empty(1, 512, 512, 3)
    with torch.no_grad(), autocast(monkeypatch), Watch() as watch:
        gaussians = model(image, cameras)
    assert watch.found == [] and "aten::_to_copy" in watch.names  # autocast is on
    assert gaussians.means.device.type == "cuda" and gaussians.num == 16384
    names = [launch.kernel.func.__name__ for launch in on_paper]
    # the states of the prefix, then two blocks, each scan cut into pieces
    assert [names.count(n) for n in ("conv_forward", "scan_forward", "carry")] == [3, 6, 3]


@pytest.mark.parametrize(
    "wait",
    [
        lambda x: x.new_tensor([1.0, 2.0]),
        lambda x: x.sum().item(),
        lambda x: torch.linalg.inv(x),
        lambda x: x.nonzero(),
        lambda x: x.cpu(),
    ],
    ids=["from numbers", "item", "inverse", "nonzero", "to the host"],
)
def test_the_watch_sees_what_waits(on_paper, wait):
    x = torch.empty(3, 3, device="cuda")
    with Watch() as watch:
        try:
            wait(x)
        except torch._subclasses.fake_tensor.DynamicOutputShapeException:
            watch.found.append("no shape without the values")
    assert watch.found
