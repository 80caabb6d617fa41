"""The model and a training step on a fake GPU: no operation may synchronise with the host."""

from dataclasses import replace

import pytest
import torch
from helpers.kernels import Watch
from ptx import dry_run
from torch._subclasses.fake_tensor import unset_fake_temporarily

from gamba_warp.cameras import Cameras
from gamba_warp.kernels.rasterize.cuda import capacity
from gamba_warp.model.config import PRESETS
from gamba_warp.model.gamba import Gamba
from gamba_warp.model.parts.patches import find_foreground
from gamba_warp.train import optim
from gamba_warp.train.data.samples import Batch
from gamba_warp.train.step import Gradients, Objective, forward, update


@pytest.fixture
def on_paper(monkeypatch):
    """Fake tensors on a missing GPU, in a capture with a capacity for the rasterizer."""
    if not dry_run.can_dry_run():
        pytest.skip(f"torch {torch.__version__} needs a GPU for it")
    with dry_run.dry_run() as launches, monkeypatch.context() as patched:
        patched.setattr(capacity, "is_capturing", lambda device: True)
        patched.setattr(capacity, "graph_capacity", lambda key, count: 1 << 20)
        yield launches


def cameras(*lead, size):
    return Cameras(torch.empty(*lead, 4, 4), torch.empty(*lead, 3, 3), size, size)


WEIGHTS = {"rgb": 1.0, "mask": 1.0, "lpips": 0.3, "ssim": 0.2, "novel": 3.0}
TERMS = {
    "paper": [WEIGHTS, WEIGHTS | {"rdist": 0.1}],
    "rays": [WEIGHTS | {"depth": 0.5, "mask_l1": 0.5, "translucency": 0.1}],
}
# Operators that compute, forward and backward, without those of LPIPS: a bound on the launches.
MOST = {"paper": 850, "rays": 900}


def batch_of(config, objects, views, size):
    """Empty tensors of a batch; the foreground of ``rays`` has the shapes of a disc's."""
    side, channels = config.image_size, config.input_channels
    foreground = surfaces = None
    if config.decoder == "rays":
        with unset_fake_temporarily(), torch.device("cpu"):
            y, x = torch.meshgrid(*2 * [torch.linspace(-1, 1, side)], indexing="ij")
            disc = (x**2 + y**2 < 0.5).float().expand(objects, -1, -1)
            found = find_foreground(disc, config).padded(config.ray_cells**2)
            shapes = {k: v for k, v in vars(found).items() if isinstance(v, torch.Tensor)}
        made = {k: torch.empty(v.shape, dtype=v.dtype) for k, v in shapes.items()}
        foreground = replace(found, **made)
        surfaces = torch.empty(objects, 2, side, side)
    return Batch(
        [*"abcdefgh"[:objects]],
        torch.empty(objects, side, side, channels),
        cameras(objects, size=side),
        torch.empty(objects, views, size, size, 4),
        cameras(objects, views, size=size),
        torch.empty(objects, 1, 3),
        surfaces,
        foreground,
    )


@pytest.mark.parametrize("preset, weights", [(p, w) for p, each in TERMS.items() for w in each])
def test_a_training_step_waits_for_nothing(on_paper, monkeypatch, preset, weights):
    """Network, rendering, losses, gradients, clipping, the skipping of a bad step, and EMA."""
    config = replace(PRESETS[preset], depth=1 if preset == "paper" else 8)
    with torch.device("cuda"):
        model, other = Gamba(config, "random"), Gamba(config, "random")
        with monkeypatch.context() as patched:  # a copy of fake tensors has a mode of its own
            patched.setattr(optim.copy, "deepcopy", lambda *_: other)
            ema = optim.Ema(model, 0.99)
        batch = batch_of(config, 8, 4, 64)
        optimizer = optim.build_optimizer(model)
        parameters = [p for group in optimizer.param_groups for p in group["params"]]
        for group in optimizer.param_groups:
            group["lr"] = 1e-3  # torch has no fake of fused AdamW with a tensor
        given = {k: w if k == "novel" else torch.empty(()) for k, w in weights.items()}
        fraction = torch.empty(())
    objective = Objective(given, lambda got, want: (got - want).abs().mean((-3, -2, -1)), 24)
    with Watch() as watch:
        result = forward(model, batch, objective)
        dry_run.run_backward([result.loss])
        computed = watch.computed
        for p in parameters:
            p.grad = torch.empty_like(p)
        norm = torch.nn.utils.clip_grad_norm_(parameters, 1.0)
        found = Gradients(result.loss.detach(), norm, batch, result)
        update(optimizer, ema, fraction, found, model)
    assert watch.found == []
    assert computed <= MOST[preset], computed
    names = [launch.kernel.func.__name__ for launch in on_paper]
    for name in ("scan_forward", "scan_backward", "composite", "composite_vjp"):
        assert name in names
    assert "gamba_warp::rasterize_bin" in watch.names


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
