"""Compares the rasterizer on a CPU with OpenSplat's, alternating, forward and with gradients.

    git clone https://github.com/pierotofy/OpenSplat
    python docs/examples/beside_opensplat.py OpenSplat

OpenSplat's operator for CPUs is one file of C++ over torch, ``rasterizer/gsplat-cpu``. It is
compiled here with -O3 -march=native against the installed torch (a C++ compiler and ninja are
needed) and called as OpenSplat calls it: its projection under autograd, its blending as a function
with its backward. The blending uses one thread; torch's operators of its projection use all. It
does not cull Gaussians behind the camera, so all scenes lie in front. The figures of
docs/large-scenes.md are the output of this script.
"""

from __future__ import annotations

import argparse
import math
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.utils.cpp_extension import load_inline

from gamba_warp.kernels.bench.cases.raster_scene import orbit_cameras, shell
from gamba_warp.kernels.rasterize import rasterization

# Gaussians, and their size over that of the benchmark's scene: the more, the smaller.
SCENES = ((16384, 1.0), (16384, 2.0), (262144, 0.25), (1048576, 0.125))
SIZES = ((512, 512), (1920, 1080))
NEAR, FAR = 0.01, 100.0  # of the depths that OpenSplat sorts by

# Lists of Gaussians of each pixel stay C++ objects between forward and backward.
BINDING = """
#include <algorithm>
#include <numeric>
#include "gsplat_cpu.cpp"
using Lists = std::vector<int32_t>;
auto project(torch::Tensor means, torch::Tensor scales, torch::Tensor quats, torch::Tensor view,
             torch::Tensor projection, double fx, double fy, int64_t width, int64_t height) {
    return project_gaussians_forward_tensor_cpu(
        means.size(0), means, scales, 1.0f, quats, view, projection, fx, fy, width / 2.0f,
        height / 2.0f, height, width, 0.01f);
}
auto blend(int64_t width, int64_t height, std::vector<torch::Tensor> x) {
    auto [rgb, T, lists] = rasterize_forward_tensor_cpu(
        width, height, x[0], x[1], x[2], x[3], x[4], x[5], x[6]);
    return std::make_tuple(rgb, T, reinterpret_cast<int64_t>(lists));
}
auto blend_backward(int64_t width, int64_t height, std::vector<torch::Tensor> x, int64_t lists,
                    torch::Tensor d_rgb, torch::Tensor d_alpha) {
    return rasterize_backward_tensor_cpu(
        height, width, x[0], x[1], x[2], x[3], x[4], x[5], x[6], x[7],
        reinterpret_cast<Lists *>(lists), d_rgb, d_alpha);
}
void release(int64_t lists) { delete[] reinterpret_cast<Lists *>(lists); }
"""


def build(checkout: Path) -> Any:
    """Compile OpenSplat's operator against this torch. Raises SystemExit without its source."""
    folder = checkout / "rasterizer" / "gsplat-cpu"
    if not (folder / "gsplat_cpu.cpp").is_file():
        raise SystemExit(f"error: {checkout} is no checkout of OpenSplat: no {folder}")
    return load_inline(
        "opensplat_cpu",
        BINDING,
        functions=["project", "blend", "blend_backward", "release"],
        extra_cflags=["-O3", "-march=native"],
        extra_include_paths=[str(folder.resolve())],
    )


class Blend(torch.autograd.Function):
    """OpenSplat's blending with its own backward."""

    @staticmethod
    def forward(ctx: Any, peer: Any, width: int, height: int, *x: Tensor) -> tuple[Tensor, Tensor]:
        rgb, T, lists = peer.blend(width, height, x)
        ctx.save_for_backward(*x, T)
        ctx.peer, ctx.size, ctx.lists = peer, (width, height), lists
        return rgb, 1 - T

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, d_rgb: Tensor, d_alpha: Tensor) -> tuple:
        saved = list(ctx.saved_tensors)
        gradients = ctx.peer.blend_backward(
            *ctx.size, saved, ctx.lists, d_rgb.contiguous(), d_alpha.contiguous()
        )
        ctx.peer.release(ctx.lists)
        return None, None, None, *gradients, None, None, None


def opensplat(peer: Any, g: dict[str, Tensor], viewmat: Tensor, K: Tensor, width: int, height: int):
    """Picture ``[H, W, 3]`` and alphas ``[H, W]`` of OpenSplat's operator."""
    fx, fy = float(K[0, 0]), float(K[1, 1])
    projection = torch.zeros(4, 4)
    projection[0, 0], projection[1, 1] = 2 * fx / width, 2 * fy / height
    projection[2, 2], projection[2, 3] = (FAR + NEAR) / (FAR - NEAR), -FAR * NEAR / (FAR - NEAR)
    projection[3, 2] = 1
    centres, _, conics, covs, depths = peer.project(
        g["means"], g["scales"], g["quats"], viewmat, projection @ viewmat, fx, fy, width, height
    )
    opacities = g["opacities"][:, None]
    x = centres, conics, g["colors"], opacities, torch.zeros(3), covs.detach(), depths.detach()
    x = [tensor.contiguous() for tensor in x]
    if torch.is_grad_enabled():
        return Blend.apply(peer, width, height, *x)
    rgb, T, lists = peer.blend(width, height, x)
    peer.release(lists)
    return rgb, 1 - T


def ours(g: dict[str, Tensor], viewmat: Tensor, K: Tensor, width: int, height: int):
    """Picture ``[H, W, 3]`` and alphas ``[H, W]`` of our rasterizer."""
    options = {"viewmats": viewmat[None], "Ks": K[None], "width": width, "height": height}
    rgb, alphas, _ = rasterization(**g, **options)
    return rgb[0], alphas[0, ..., 0]


def milliseconds(run: Callable, g: dict[str, Tensor], view: tuple, gradients: bool) -> float:
    """Time one call, optionally with gradients of all leaves."""
    with torch.set_grad_enabled(gradients):
        leaves = {name: x.clone().requires_grad_(gradients) for name, x in g.items()}
        start = time.perf_counter()
        rgb, alphas = run(leaves, *view)
        if gradients:
            torch.autograd.backward([rgb, alphas], [torch.ones_like(rgb), torch.ones_like(alphas)])
        return 1e3 * (time.perf_counter() - start)


def main() -> None:
    """Read the options from the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("checkout", type=Path, help="a checkout of OpenSplat")
    parser.add_argument("--turns", type=int, default=5)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--most", type=int, default=1 << 20, help="Gaussians of a scene at most")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    peer = build(options.checkout)
    runs = {"ours": ours, "OpenSplat": lambda g, *view: opensplat(peer, g, *view)}
    for (width, height), (count, scale) in ((s, c) for s in SIZES for c in SCENES):
        if count > options.most or (width > height and count < 1 << 18):
            continue
        viewmats, Ks = orbit_cameras(1, height)
        Ks[:, 0, 2] = width / 2
        g, view = shell(count, scale), (viewmats[0], Ks[0], width, height)
        with torch.no_grad():
            pictures = [run(g, *view)[0] for run in runs.values()]
        psnr = -10 * math.log10(float((pictures[0] - pictures[1]).square().mean()))
        print(f"{count:,} Gaussians of size {scale}, {width} x {height}, PSNR {psnr:.1f} dB")
        for gradients in (False, True):
            times: dict[str, list[float]] = {name: [] for name in runs}
            for turn in range(-1, options.turns):
                for name, run in runs.items():
                    spent = milliseconds(run, g, view, gradients)
                    if turn >= 0:  # the first call of all warms up
                        times[name].append(spent)
            mine, other = (statistics.median(t) for t in times.values())
            what = "with gradients" if gradients else "forward"
            print(
                f"  {what:<15} ours {mine:8.1f} ms, OpenSplat {other:8.1f}, {other / mine:5.1f} x"
            )


if __name__ == "__main__":
    main()
