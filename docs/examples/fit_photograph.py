"""Fits Gaussians to a photograph with gsplat's strategies over our rasterizer.

    pip install '.[gsplat]'      # in the checkout
    python docs/examples/fit_photograph.py --out astronaut.png

The script only uses gsplat's interface: with ``gsplat`` instead of ``gamba_warp.compat.gsplat`` in
the two imports, and tensors on a GPU, it runs on gsplat's CUDA code.
"""

from __future__ import annotations

import argparse
import math

import imageio.v3 as imageio
import skimage
import torch
from torch import Tensor

from gamba_warp.compat.gsplat import rasterization
from gamba_warp.compat.gsplat.strategy import DefaultStrategy, MCMCStrategy

RATES = dict(means=2e-3, scales=1e-2, quats=5e-3, opacities=2e-2, colors=1e-2)


def photograph(name: str, size: int) -> Tensor:
    """An image of ``skimage.data``, ``[H, W, 3]`` in [0, 1], its longer side ``size`` pixels."""
    image = torch.from_numpy(getattr(skimage.data, name)()).permute(2, 0, 1)[None] / 255
    height, width = image.shape[2:]
    scale = size / max(height, width)
    shape = (round(height * scale), round(width * scale))
    return torch.nn.functional.interpolate(image, shape, mode="area")[0].permute(1, 2, 0)


def start(count: int) -> dict[str, torch.nn.Parameter]:
    """Gaussians at random in the plane z = 0, before activation, by gsplat's names."""
    spread = torch.rand(count, 3) * 2 - 1
    values = dict(
        means=spread * torch.tensor([1.0, 1.0, 0.05]),
        scales=torch.full((count, 3), math.log(1.2 / math.sqrt(count))),
        quats=torch.randn(count, 4),
        opacities=torch.zeros(count),
        colors=torch.zeros(count, 3),
    )
    return {name: torch.nn.Parameter(value) for name, value in values.items()}


def draw(params: dict[str, torch.nn.Parameter], width: int, height: int, absgrad: bool):
    """Render from z = -2, where the longer side covers -1 to 1; also return gsplat's info."""
    focal = float(max(width, height))
    viewmat = torch.eye(4)
    viewmat[2, 3] = 2.0
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    renders, _, info = rasterization(
        params["means"],
        params["quats"],
        params["scales"].exp(),
        params["opacities"].sigmoid(),
        params["colors"].sigmoid(),
        viewmat[None],
        K[None],
        width,
        height,
        packed=False,
        absgrad=absgrad,
    )
    return renders[0], info


def strategy_of(name: str, steps: int, most: int):
    """A strategy of gsplat's with a schedule for ``steps`` steps, and its state."""
    times = dict(refine_start_iter=steps // 10, refine_stop_iter=steps * 3 // 4)
    times["refine_every"] = max(1, steps // 20)
    if name == "mcmc":
        strategy = MCMCStrategy(cap_max=most, noise_lr=1e2, **times)
        return strategy, strategy.initialize_state()
    strategy = DefaultStrategy(absgrad=True, grow_grad2d=1e-2, reset_every=10 * steps, **times)
    return strategy, strategy.initialize_state(scene_scale=1.0)


def fit(target: Tensor, name: str = "mcmc", steps: int = 400, count: int = 400, most: int = 1200):
    """Fit and print; return the image ``[H, W, 3]``, its PSNR and the number of Gaussians."""
    torch.manual_seed(0)
    height, width, _ = target.shape
    params = start(count)
    optimizers = {k: torch.optim.Adam([v], lr=RATES[k], eps=1e-15) for k, v in params.items()}
    strategy, state = strategy_of(name, steps, most)
    strategy.check_sanity(params, optimizers)
    for step in range(steps):
        image, info = draw(params, width, height, name != "mcmc")
        strategy.step_pre_backward(params, optimizers, state, step, info)
        loss = (image - target).abs().mean()
        if name == "mcmc":  # unneeded Gaussians fade and are relocated
            loss = loss + 1e-3 * params["opacities"].sigmoid().mean()
        loss.backward()
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        more = {"lr": RATES["means"]} if name == "mcmc" else {"packed": False}
        strategy.step_post_backward(params, optimizers, state, step, info, **more)
    with torch.no_grad():
        image = draw(params, width, height, False)[0].clamp(0, 1)
    psnr = -10 * math.log10((image - target).square().mean())
    print(f"{name}: {len(params['means'])} Gaussians, {steps} steps, PSNR {psnr:.2f} dB")
    return image, psnr, len(params["means"])


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--image", default="astronaut", help="a name in skimage.data")
    parser.add_argument("--size", type=int, default=128, help="pixels of the longer side")
    parser.add_argument("--strategy", choices=["mcmc", "default"], default="mcmc")
    parser.add_argument("--steps", type=int, default=400)
    parser.add_argument("--out", default="photograph.png", help="target and fit side by side")
    options = parser.parse_args()
    target = photograph(options.image, options.size)
    image = fit(target, options.strategy, options.steps)[0]
    both = torch.cat([target, image], 1)
    imageio.imwrite(options.out, (both * 255).round().byte().numpy())
