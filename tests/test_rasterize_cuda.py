"""The CUDA kernels without a GPU: small shapes on CPU blocks, and compiled ahead of time."""

import pytest
import torch
import warp as wp
from helpers import assert_rel_rms, resources
from test_rasterize import leaves, make

from gamba_warp.kernels.rasterize import composite_cpu, composite_cuda, ops, rasterization

SAME = 2e-6  # the two sum in another order


def run(scene, v_renders, v_alphas, mode):
    tensors = leaves(scene, torch.float32)
    renders, alphas, meta = rasterization(**tensors, render_mode=mode)
    ((renders * v_renders).sum() + (alphas * v_alphas).sum()).backward()
    grads = {k: v.grad for k, v in tensors.items() if getattr(v, "grad", None) is not None}
    counts = {k: meta[k] for k in ("pairs_walked", "tiles_skipped")}
    return {"renders": renders, "alphas": alphas, **grads}, counts


@pytest.fixture
def on_blocks(monkeypatch):
    """The CUDA compositor in place of the CPU's, with real blocks."""
    monkeypatch.setattr(wp.config, "enable_cpu_blocks", True)

    def switch():
        monkeypatch.setattr(ops, "_compositor", lambda device: composite_cuda)

    return switch


@pytest.mark.parametrize("channels, mode", [(3, "RGB"), (3, "RGB+ED"), (6, "RGB"), (1, "ED")])
def test_block_kernels_equal_lane_kernels(on_blocks, channels, mode):
    scene = make(1, 2, num=70, width=37, height=21, channels=channels, size=0.15)
    scene["opacities"][:, ::2] = 0.9999  # some pixels stop early, some alphas are clamped
    size = channels + ("+" in mode) if mode != "ED" else 1
    v_renders, v_alphas = torch.randn(1, 2, 21, 37, size), torch.randn(1, 2, 21, 37, 1)
    v_renders[:, :, :16, :16] = v_alphas[:, :, :16, :16] = 0  # a tile without gradient
    lanes, lane_counts = run(scene, v_renders, v_alphas, mode)
    on_blocks()
    blocks, block_counts = run(scene, v_renders, v_alphas, mode)
    assert lanes["alphas"].mean() > 0.3 and lanes.keys() == blocks.keys()
    for name, value in lanes.items():
        assert_rel_rms(blocks[name], value, SAME, name)
    assert block_counts == lane_counts and lane_counts["tiles_skipped"] >= 2


def test_sums_need_blocks(monkeypatch):
    """Without CPU blocks gradients are wrong, so the test above does see the reduction."""
    assert not wp.config.enable_cpu_blocks
    scene = make(1, 1, num=30, width=16, height=16)
    v_renders, v_alphas = torch.randn(1, 1, 16, 16, 3), torch.randn(1, 1, 16, 16, 1)
    right, _ = run(scene, v_renders, v_alphas, "RGB")
    monkeypatch.setattr(ops, "_compositor", lambda device: composite_cuda)
    wrong, _ = run(scene, v_renders, v_alphas, "RGB")
    assert not torch.allclose(wrong["opacities"], right["opacities"], rtol=0.1)


def test_devices_have_their_compositor():
    assert ops._compositor(torch.device("cpu")) is composite_cpu
    assert ops._compositor(torch.device("cuda")) is composite_cuda


# Registers per thread that leave at least 16 (one-warp) or 4 (256-thread) blocks on a processor.
@pytest.mark.parametrize(
    "name, registers",
    [("composite_cuda", 128), ("project", 80), ("project_vjp", 128), ("bin", 64), ("reduce", 64)],
)
def test_compiles_ahead_of_time(tmp_path, name, registers):
    module = f"gamba_warp.kernels.rasterize.{name}"
    __import__(module)
    files = wp.compile_aot_module(module, device=None, arch=[80, 90], module_dir=tmp_path)
    cubins = sorted(tmp_path.glob("*.cubin"))
    assert len(files) == len(cubins) == 2
    for cubin in cubins:
        used, stack = resources(cubin.read_bytes())
        assert 0 < used <= registers and stack == 0, (
            f"{cubin.name}: {used} registers, {stack} stack"
        )


@pytest.mark.gpu
def test_on_a_gpu():
    scene = make(2, 3, num=300, width=75, height=53)
    v_renders, v_alphas = torch.randn(2, 3, 53, 75, 4), torch.randn(2, 3, 53, 75, 1)
    want, _ = run(scene, v_renders, v_alphas, "RGB+D")
    scene = {k: v.cuda() if isinstance(v, torch.Tensor) else v for k, v in scene.items()}
    results = [run(scene, v_renders.cuda(), v_alphas.cuda(), "RGB+D")[0] for _ in range(2)]
    for name, value in want.items():
        # the exponential is an approximation there; a few pixels cross the cut at alpha_min
        assert_rel_rms(results[0][name].cpu(), value, 1e-3, name)
        assert torch.equal(results[0][name], results[1][name]), name
