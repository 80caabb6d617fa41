"""gsplat's own strategies on our ``rasterization``, on the CPU; their formula of relocation."""

import importlib.util
import math
import runpy
from pathlib import Path
from unittest.mock import Mock

import pytest
import torch

from gamba_warp.compat.gsplat import rasterization
from gamba_warp.compat.gsplat.relocation import compute_relocation, torch_strategies

ROOT = Path(__file__).resolve().parents[2]
pytestmark = pytest.mark.usefixtures("one_thread")
NEEDS_GSPLAT = pytest.mark.skipif(
    importlib.util.find_spec("gsplat") is None,
    reason="needs the package gsplat (pip install gsplat==1.5.3)",
)
BINOMS = torch.tensor([[math.comb(n, k) for k in range(51)] for n in range(51)]).float()


def test_relocation():
    """Equation 9 in integer arithmetic, and a single Gaussian, which does not change."""
    opacities = torch.tensor([0.3, 0.9, 0.99, 0.005, 0.6])
    scales, ratios = torch.rand(5, 3) + 0.1, torch.tensor([1, 2, 51, 7, 99])
    new, sizes = compute_relocation(opacities, scales, ratios, BINOMS)
    assert ratios.tolist() == [1, 2, 51, 7, 51]
    assert new[0] == pytest.approx(0.3) and torch.allclose(sizes[0], scales[0])
    for i, n in enumerate(ratios.tolist()):
        old = opacities[i].item()
        one = 1 - (1 - old) ** (1 / n)
        total = math.fsum(
            math.comb(j - 1, k) * (-1) ** k / math.sqrt(k + 1) * one ** (k + 1)
            for j in range(1, n + 1)
            for k in range(j)
        )
        assert new[i].item() == pytest.approx(one, rel=1e-6)
        # float32 in and out
        assert torch.allclose(sizes[i], scales[i] * old / total, rtol=1e-6)


def test_relocation_to_a_smallest_opacity():
    """The scales follow from the opacity that is kept."""
    opacities, scales, ratios = torch.tensor([0.1, 0.9]), torch.ones(2, 3), torch.tensor([8, 2])
    new, sizes = compute_relocation(opacities, scales, ratios, BINOMS, min_opacity=0.05)
    assert new[0] == pytest.approx(0.05) and new[1] == pytest.approx(1 - 0.1**0.5)
    free = 1 - 0.95**8  # has the new opacity without a bound
    want = compute_relocation(torch.tensor([free, 0.9]), scales, ratios, BINOMS)
    assert torch.allclose(sizes[0], want[1][0] * 0.1 / free) and torch.equal(sizes[1], want[1][1])


def fitted(strategy, state, rendering, steps=31, size=(29, 23), **more):
    """Fits a smooth image; returns the numbers of Gaussians and the losses, step by step."""
    torch.manual_seed(2)
    width, height = size
    x, y = torch.meshgrid(torch.arange(width), torch.arange(height), indexing="xy")
    target = torch.stack([x / width, y / height, ((x // 6 + y // 6) % 2).float()], -1)
    viewmat = torch.eye(4)
    viewmat[2, 3] = 3.0
    K = torch.tensor([[30.0, 0, width / 2], [0, 30.0, height / 2], [0, 0, 1]])
    values = dict(
        means=torch.rand(250, 3) * 2 - 1, scales=torch.full((250, 3), -2.5),
        quats=torch.randn(250, 4), opacities=torch.randn(250), colors=torch.randn(250, 3),
    )  # fmt: skip
    params = {name: torch.nn.Parameter(value) for name, value in values.items()}
    with torch.no_grad():
        params["opacities"][:20] = -8  # dead ones
    optimizers = {k: torch.optim.Adam([v], lr=0.02) for k, v in params.items()}
    strategy.check_sanity(params, optimizers)
    counts, losses = [], []
    for step in range(steps):
        shown = [params[name].sigmoid() for name in ("opacities", "colors")]
        gaussians = params["means"], params["quats"], params["scales"].exp(), *shown
        image = viewmat[None], K[None], width, height
        renders, _, info = rasterization(*gaussians, *image, **rendering)
        strategy.step_pre_backward(params, optimizers, state, step, info)
        loss = (renders[0] - target).square().mean()
        loss.backward()
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        strategy.step_post_backward(params, optimizers, state, step, info, **more)
        counts.append(len(params["means"]))
        losses.append(loss.item())
    assert all(torch.isfinite(p).all() for p in params.values())
    return counts, losses, params


TIMES = dict(refine_start_iter=3, refine_stop_iter=25, refine_every=5)


@NEEDS_GSPLAT
@pytest.mark.parametrize("packed, absgrad", [(False, False), (True, False), (True, True)])
def test_default_strategy(packed, absgrad):
    from gamba_warp.compat.gsplat import DefaultStrategy

    growth = {"absgrad": absgrad, "grow_grad2d": 2e-3, "refine_scale2d_stop_iter": 20}
    strategy = DefaultStrategy(**growth, **TIMES)
    state = strategy.initialize_state(scene_scale=1.0)
    counts, losses, _ = fitted(strategy, state, dict(packed=packed, absgrad=absgrad), packed=packed)
    changes = torch.tensor(counts).diff()
    assert counts[4] == 250 and (changes < 0).any() | (changes > 0).any()
    assert max(counts) > 260, "some were split or duplicated"
    assert losses[-1] < 0.5 * losses[0]


@NEEDS_GSPLAT
def test_mcmc_strategy(monkeypatch):
    from gsplat.strategy import mcmc, ops

    from gamba_warp.compat.gsplat import MCMCStrategy

    relocate = Mock(wraps=mcmc.relocate)
    monkeypatch.setattr(mcmc, "relocate", relocate)
    theirs = ops.compute_relocation
    strategy = MCMCStrategy(cap_max=300, noise_lr=1.0, **TIMES)
    state = strategy.initialize_state()
    counts, losses, params = fitted(strategy, state, dict(packed=False), lr=0.02)
    assert counts[0] == 250 and counts[5] == 262 and counts[-1] == 300
    assert relocate.call_args_list[0].kwargs["mask"].sum() >= 20
    assert (params["opacities"].sigmoid() > 0.004).all(), "the dead ones live elsewhere now"
    assert losses[-1] < 0.5 * losses[0]
    assert ops.compute_relocation is theirs, "what was replaced is put back"


@NEEDS_GSPLAT
def test_torch_strategies_come_back_after_an_error():
    from gsplat.strategy import ops

    before = ops.compute_relocation, ops.quat_scale_to_covar_preci
    with pytest.raises(KeyError), torch_strategies():
        assert ops.compute_relocation is compute_relocation
        raise KeyError
    assert before == (ops.compute_relocation, ops.quat_scale_to_covar_preci)


@NEEDS_GSPLAT
@pytest.mark.parametrize("name", ["mcmc", "default"])
def test_example(name, capsys):
    """docs/examples/fit_photograph.py, small."""
    example = runpy.run_path(str(ROOT / "docs/examples/fit_photograph.py"))
    target = example["photograph"]("astronaut", 24)
    assert target.shape == (24, 24, 3)
    image, psnr, count = example["fit"](target, name, steps=60, count=150, most=200)
    assert count != 150
    assert image.shape == target.shape and psnr > 15  # a grey image has 11
    assert f"{name}: {count} Gaussians, 60 steps, PSNR {psnr:.2f} dB" in capsys.readouterr().out
