"""The Gamba block, its outputs and gradients, against its equations in float64."""

import math

import pytest
import torch
from helpers import assert_rel_rms
from helpers.mamba import TRANSITIONS, layer_in_float64
from helpers.model import perturbed

from gamba_warp.model.config import GambaConfig
from gamba_warp.model.parts.block import GambaBlock
from gamba_warp.model.parts.mamba import Mamba
from gamba_warp.model.parts.prefix import prefix_states


def _config(**changes) -> GambaConfig:
    small = {"width": 24, "state_size": 5, "dt_rank": 3, "depth": 2, "encoder": "none"}
    return GambaConfig(**(small | changes))


def _block_in_float64(block: GambaBlock, given: dict[str, torch.Tensor]) -> torch.Tensor:
    """Prepend the projected condition, compute the layer, drop the prefix again.

    Args:
        block: for its kinds of norm and of discretization.
        given: tokens, the condition and the block's parameters by name.
    """
    layer = {n.removeprefix("mamba."): x for n, x in given.items() if n.startswith("mamba.")}
    layer |= {"conv1d.weight": layer["conv_weight"][:, None], "conv1d.bias": layer["conv_bias"]}
    whole = [given["tokens"]]
    for name in ("image", "camera"):
        if name in given:
            weight, bias = given[f"project_{name}.weight"], given[f"project_{name}.bias"]
            whole.insert(0, given[name] @ weight.T + bias)
    x = torch.cat(whole, 1)
    if isinstance(block.norm, torch.nn.LayerNorm):
        x = x - x.mean(-1, keepdim=True)
    x = x / (x.square().mean(-1, keepdim=True) + 1e-5).sqrt() * given["norm.weight"]
    x = layer_in_float64(layer, x + given.get("norm.bias", 0), block.mamba.discretization)
    return given["tokens"] + x[:, -given["tokens"].shape[1] :]


def _run(block: GambaBlock, tokens, camera, image) -> torch.Tensor:
    """Run the block after its own prefix."""
    return block(tokens, *prefix_states([block], camera, image))[0]


@pytest.mark.parametrize(
    "changes, camera, image",
    [
        *(({"norm": n, "discretization": d}, 7, 11) for n in ("layer", "rms") for d in TRANSITIONS),
        *(({}, *channels) for channels in ((7, 0), (0, 11), (0, 0))),
    ],
    ids=str,
)
def test_the_block_and_its_gradients_are_those_of_float64(changes, camera, image):
    """Also with parts of the condition."""
    block = perturbed(GambaBlock(_config(**changes), camera, image))
    given = {"tokens": torch.randn(3, 9, 24)}
    given |= {"camera": torch.randn(3, 1, camera)} if camera else {}
    given |= {"image": torch.randn(3, 4, image)} if image else {}
    leaves = {name: x.requires_grad_() for name, x in given.items()}
    leaves |= dict(block.named_parameters())
    wide = {name: x.detach().double().requires_grad_() for name, x in leaves.items()}
    got = _run(block, given["tokens"], given.get("camera"), given.get("image"))
    want = _block_in_float64(block, wide)
    assert_rel_rms(got, want, 2e-6, "block")  # float32 against float64
    cotangent = torch.randn_like(got)
    grads = torch.autograd.grad(got, [*leaves.values()], cotangent)
    wanted = torch.autograd.grad(want, [*wide.values()], cotangent.double())
    for name, a, b in zip(leaves, grads, wanted):
        assert_rel_rms(a, b, 1e-5, name)  # sums over up to 42 tokens


def test_prefix_reaches_the_first_token_and_nothing_flows_back():
    block = perturbed(GambaBlock(_config(), 7, 11))
    tokens, camera, image = torch.randn(1, 8, 24), torch.randn(1, 1, 7), torch.randn(1, 4, 11)
    base = _run(block, tokens, camera, image)
    assert not torch.allclose(base[:, 0], _run(block, tokens, camera + 1, image)[:, 0])
    assert not torch.allclose(base[:, 0], _run(block, tokens, camera, image + 1)[:, 0])
    later = tokens.clone()
    later[:, 5] += 1
    changed = _run(block, later, camera, image)
    assert torch.equal(base[:, :5], changed[:, :5])
    assert not torch.allclose(base[:, 5:], changed[:, 5:])


def test_start_values_are_those_of_mamba():
    config = _config(width=64, depth=9)
    mamba = Mamba(config)
    assert torch.allclose(mamba.A_log.exp(), torch.arange(1, 6.0).expand(128, 5))
    assert torch.equal(mamba.D, torch.ones(128))
    step = torch.nn.functional.softplus(mamba.dt_proj.bias)
    assert step.min() >= 0.99e-3 and step.max() <= 0.101
    log = step.log()  # log-uniform: its mean is the middle of the range
    assert abs(log.mean().item() - math.log(1e-2)) < 0.5
    # Linear's uniform start within ±1/sqrt(fan_in), over sqrt(depth).
    assert abs(mamba.out_proj.weight.abs().max().item() - 128**-0.5 / 3) < 1e-3
    for name in ("A_log", "D", "conv_bias"):
        assert getattr(mamba, name)._no_weight_decay


def test_bfloat16_autocast_stays_near_float32():
    block = perturbed(GambaBlock(_config(), 7, 11))
    tokens, camera, image = torch.randn(2, 19, 24), torch.randn(2, 1, 7), torch.randn(2, 4, 11)
    want = _run(block, tokens, camera, image)
    with torch.autocast("cpu", torch.bfloat16):
        got = _run(block, tokens, camera, image)
    assert got.dtype == torch.float32  # the residual stream is not rounded
    # bfloat16 keeps 8 bits; the branch passes through six roundings of 0.2 to 0.4 %.
    assert_rel_rms(got - tokens, want - tokens, 2e-2, "branch")
