"""The Gamba block against a float64 step-by-step reference written from the equations."""

import math

import pytest
import torch
from helpers import assert_rel_rms
from helpers.model import perturbed

from gamba_warp.model.config import GambaConfig
from gamba_warp.model.parts.block import GambaBlock, Mamba, prefix_states


def _config(**changes) -> GambaConfig:
    small = {"width": 24, "state_size": 5, "dt_rank": 3, "depth": 2, "encoder": "none"}
    return GambaConfig(**(small | changes))


def _transition(x: torch.Tensor, A: torch.Tensor, discretization: str):
    """Ā and B̄ / δB as functions of x = δA."""
    if discretization == "bilinear":
        return (1 + x / 2) / (1 - x / 2), 1 / (1 - x / 2)
    return x.exp(), (x.exp() - 1) / x if discretization == "zoh" else torch.ones_like(x)


def _mamba_reference(mamba: Mamba, tokens: torch.Tensor) -> torch.Tensor:
    """One sequence ``[L, width]``, token by token."""
    p = {name: value.double() for name, value in mamba.state_dict().items()}
    inner, taps = p["conv_weight"].shape
    rank, states = p["dt_proj.weight"].shape[1], p["A_log"].shape[1]
    A = -p["A_log"].exp()
    h = torch.zeros(inner, states, dtype=torch.float64)
    past = [torch.zeros(inner, dtype=torch.float64)] * (taps - 1)
    outputs = []
    for token in tokens:
        x, z = (p["in_proj.weight"] @ token).split(inner)
        past = [*past, x][-taps:]
        x = p["conv_bias"] + sum(past[k] * p["conv_weight"][:, k] for k in range(taps))
        x = x / (1 + torch.exp(-x))
        low, B, C = (p["x_proj.weight"] @ x).split([rank, states, states])
        delta = torch.log1p(torch.exp(p["dt_proj.weight"] @ low + p["dt_proj.bias"]))[:, None]
        decay, gain = _transition(delta * A, A, mamba.discretization)
        h = decay * h + gain * delta * B * x[:, None]
        y = h @ C + p["D"] * x
        outputs.append(p["out_proj.weight"] @ (y * z / (1 + torch.exp(-z))))
    return torch.stack(outputs)


def _block_reference(block: GambaBlock, tokens, camera, image) -> torch.Tensor:
    """Prepend the projected condition, runs the reference, drops the prefix again."""
    p = {name: value.double() for name, value in block.state_dict().items()}
    prefix = []
    for name, condition in (("project_camera", camera), ("project_image", image)):
        if condition is not None:
            prefix.append(condition.double() @ p[f"{name}.weight"].T + p[f"{name}.bias"])
    outputs = []
    for b, sequence in enumerate(tokens.double()):
        whole = torch.cat([*(part[b] for part in prefix), sequence])
        if isinstance(block.norm, torch.nn.LayerNorm):
            whole = whole - whole.mean(-1, keepdim=True)
        whole = whole / (whole.square().mean(-1, keepdim=True) + 1e-5).sqrt() * p["norm.weight"]
        if "norm.bias" in p:
            whole = whole + p["norm.bias"]
        outputs.append(sequence + _mamba_reference(block.mamba, whole)[-len(sequence) :])
    return torch.stack(outputs)


def _run(block: GambaBlock, tokens, camera, image) -> torch.Tensor:
    """Run the block after its own prefix."""
    return block(tokens, *prefix_states([block], camera, image))[0]


@pytest.mark.parametrize("discretization", ["mamba", "zoh", "bilinear"])
@pytest.mark.parametrize("norm", ["layer", "rms"])
def test_block_equals_reference(norm, discretization):
    block = perturbed(GambaBlock(_config(norm=norm, discretization=discretization), 7, 11))
    tokens, camera, image = torch.randn(3, 9, 24), torch.randn(3, 1, 7), torch.randn(3, 4, 11)
    want = _block_reference(block, tokens, camera, image)
    # Float32 against float64.
    assert_rel_rms(_run(block, tokens, camera, image), want, 2e-6, "block")


@pytest.mark.parametrize("camera_channels, image_channels", [(7, 0), (0, 11), (0, 0)])
def test_block_with_parts_of_the_condition(camera_channels, image_channels):
    block = perturbed(GambaBlock(_config(), camera_channels, image_channels))
    tokens = torch.randn(1, 6, 24)
    camera = torch.randn(1, 1, 7) if camera_channels else None
    image = torch.randn(1, 4, 11) if image_channels else None
    want = _block_reference(block, tokens, camera, image)
    # Float32 against float64.
    assert_rel_rms(_run(block, tokens, camera, image), want, 2e-6, "block")


def test_gradients_equal_those_of_the_reference_by_differences():
    block = perturbed(GambaBlock(_config(), 7, 11))
    inputs = {
        "tokens": torch.randn(2, 5, 24, requires_grad=True),
        "camera": torch.randn(2, 1, 7, requires_grad=True),
        "image": torch.randn(2, 3, 11, requires_grad=True),
    }
    cotangent = torch.randn(2, 5, 24)
    (_run(block, **inputs) * cotangent).sum().backward()
    leaves = inputs | dict(block.named_parameters())
    for name, leaf in leaves.items():
        direction = torch.randn_like(leaf)
        got = (leaf.grad.double() * direction).sum().item()
        # The reference casts to float64 itself, so it is moved by a step that float32 can hold.
        values = []
        with torch.no_grad():
            start = leaf.clone()
            for sign in (1, -1):
                leaf.copy_(start + sign * 1e-2 * direction)
                moved = (_block_reference(block, **inputs) * cotangent).sum().item()
                values.append(moved)
            leaf.copy_(start)
        want = (values[0] - values[1]) / 2e-2
        # Third-order term of a central difference with this step.
        scale = leaf.grad.norm().item() * direction.norm().item() / leaf.numel() ** 0.5
        assert abs(got - want) < 5e-3 * abs(want) + 5e-3 * scale, f"{name}: {got} != {want}"


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
