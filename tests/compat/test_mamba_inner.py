"""All of a Mamba block behind its first projection, against torch in float64."""

import pytest
import torch
import torch.nn.functional as F
from helpers import assert_rel_rms

from gamba_warp.compat.mamba_ssm import mamba_inner_fn, mamba_inner_ref

WIDTH, CHANNELS, STATES, RANK, LENGTH, BATCH = 7, 10, 3, 4, 21, 2


def make(constant_B, constant_C, taps=4):
    """The arguments by mamba-ssm's names, in its order."""
    rows = RANK + STATES * ((not constant_B) + (not constant_C))
    return {
        "xz": torch.randn(BATCH, 2 * CHANNELS, LENGTH),
        "conv1d_weight": torch.randn(CHANNELS, 1, taps),
        "conv1d_bias": torch.randn(CHANNELS),
        "x_proj_weight": torch.randn(rows, CHANNELS) / CHANNELS**0.5,
        "delta_proj_weight": torch.randn(CHANNELS, RANK) / RANK**0.5,
        "out_proj_weight": torch.randn(WIDTH, CHANNELS),
        "out_proj_bias": torch.randn(WIDTH),
        "A": -torch.rand(CHANNELS, STATES),
        "B": torch.randn(CHANNELS, STATES) if constant_B else None,
        "C": torch.randn(CHANNELS, STATES) if constant_C else None,
        "D": torch.randn(CHANNELS),
        "delta_bias": torch.randn(CHANNELS),
        "B_proj_bias": None if constant_B else torch.randn(STATES),
        "C_proj_bias": None if constant_C else torch.randn(STATES),
    }


def norm(x, weight, eps=1e-6):
    """RMS norm, or x itself without a weight."""
    return x if weight is None else x * weight / (x.square().mean(-1, keepdim=True) + eps).sqrt()


def in_float64(given, norms):
    """The block token by token."""
    g = {name: x if x is None else x.double() for name, x in given.items()}
    n = {name: x.double() for name, x in norms.items()}
    x, z = g["xz"].chunk(2, 1)
    padded = F.pad(x, (g["conv1d_weight"].shape[2] - 1, 0))
    x = F.silu(F.conv1d(padded, g["conv1d_weight"], g["conv1d_bias"], groups=CHANNELS))
    state, rows = x.new_zeros(BATCH * CHANNELS, 1, STATES), []
    for t in range(LENGTH):
        low = x[..., t] @ g["x_proj_weight"].T
        delta = norm(low[:, :RANK] @ g["delta_proj_weight"].T, n.get("dt_rms_weight"))
        B, C = g["B"], g["C"]
        if B is None:
            B = norm(low[:, RANK : RANK + STATES] + g["B_proj_bias"], n.get("b_rms_weight"))
        if C is None:
            C = norm(low[:, -STATES:] + g["C_proj_bias"], n.get("c_rms_weight"))
        # Constant matrices are those of a channel: each channel is an element of the batch.
        B, C = (m[None] if m.shape[0] == CHANNELS else m[:, None] for m in (B, C))
        B, C = (m.expand(BATCH, CHANNELS, -1).flatten(0, 1) for m in (B, C))
        step = F.softplus(delta + g["delta_bias"])
        A = g["A"].repeat(BATCH, 1)
        state = torch.exp(step.view(-1, 1, 1) * A[:, None]) * state
        state = state + (step * x[..., t]).view(-1, 1, 1) * B[:, None]
        y = (state * C[:, None]).sum(-1).view(BATCH, CHANNELS) + g["D"] * x[..., t]
        rows.append(y * F.silu(z[..., t]))
    return torch.stack(rows, 1) @ g["out_proj_weight"].T + g["out_proj_bias"]


@pytest.mark.parametrize("taps", [3, 4])
@pytest.mark.parametrize("constant_B", [False, True])
@pytest.mark.parametrize("constant_C", [False, True])
@pytest.mark.parametrize("norms", [False, True])
def test_matches_torch(constant_B, constant_C, norms, taps):
    given = make(constant_B, constant_C, taps)
    weights = {"dt_rms_weight": torch.rand(CHANNELS)} if norms else {}
    if norms and not constant_B:
        weights["b_rms_weight"] = torch.rand(STATES)
    if norms and not constant_C:
        weights["c_rms_weight"] = torch.rand(STATES)
    for x in (*given.values(), *weights.values()):
        if x is not None:
            x.requires_grad_()
    out = mamba_inner_fn(*given.values(), **weights, checkpoint_lvl=0)
    want = in_float64(given, weights)
    # Float32 through four products: the largest gradients add some hundred terms.
    assert_rel_rms(out, want, 2e-6, "out")
    if not norms:
        assert torch.equal(mamba_inner_ref(*given.values()), out)
    leaves = {k: x for k, x in (given | weights).items() if x is not None}
    cotangent = torch.randn_like(out)
    got = torch.autograd.grad(out, leaves.values(), cotangent)
    want = torch.autograd.grad(want, leaves.values(), cotangent.double())
    for name, a, b in zip(leaves, got, want):
        assert_rel_rms(a, b, 5e-6, name)


@pytest.mark.parametrize(
    "change, error, text",
    [
        ({"A": torch.ones(10, 3, dtype=torch.complex64)}, TypeError, "A has dtype torch.complex64"),
        ({"checkpoint_lvl": 2}, ValueError, "checkpoint_lvl is 2, allowed"),
        ({"x_proj_weight": torch.ones(9, 10)}, ValueError, "x_proj_weight has 9 rows, must"),
        ({"conv1d_weight": torch.ones(10, 4)}, ValueError, "conv1d_weight has shape .10, 4., al"),
        ({"B": torch.ones(10, 3)}, ValueError, "B_proj_bias is given; it has no use"),
    ],
)  # fmt: skip
def test_refuses(change, error, text):
    with pytest.raises(error, match=f"^{text}"):
        mamba_inner_fn(**make(False, False) | change)
