"""Arguments that the functions and layers of mamba-ssm and causal-conv1d refuse by their names."""

import pytest
import torch
from helpers.mamba import block_inputs

from gamba_warp.compat.causal_conv1d import causal_conv1d_update
from gamba_warp.compat.mamba_ssm import Mamba, mamba_inner_fn, selective_state_update
from gamba_warp.compat.mamba_ssm.models.mixer_seq_simple import create_block
from gamba_warp.compat.mamba_ssm.ops.triton.layer_norm import layer_norm_fn

one = torch.ones
STATE = {"state": one(3, 7, 5), "x": one(3, 7), "dt": one(3, 7), "A": -one(7, 5)}
STATE |= {"B": one(3, 5), "C": one(3, 5), "D": one(7)}
# Of each function valid arguments, and changes of them with the beginnings of the errors.
REFUSED = {
    causal_conv1d_update: (
        {"x": one(3, 5), "conv_state": one(3, 5, 4), "weight": one(5, 4)},
        ({"x": one(3, 5).double()}, TypeError, "x must have dtype.*got torch.float64"),
        ({"activation": "gelu"}, ValueError, "activation must be.*got 'gelu'"),
        ({"conv_state": one(3, 5, 2)}, ValueError, "conv_state must have shape .* S >= 3"),
        ({"weight": one(4, 4)}, ValueError, r"weight must have shape \[5, W.*, got \[4, 4\]"),
        ({"cache_seqlens": one(3)}, TypeError, "cache_seqlens must have dtype .*torch.float32"),
    ),
    selective_state_update: (
        STATE,
        ({"A": one(7, 5).cfloat()}, TypeError, "A must have dtype .*got torch.complex64"),
        ({"dt": one(3, 7).double()}, TypeError, "dt must have dtype.*got torch.float64"),
        ({"C": None}, TypeError, "C must be a tensor.*, got NoneType"),
        ({"B": one(3, 2, 5)}, ValueError, r"B must have shape \[3, 5\] or.*, got \[3, 2, 5\]"),
        ({"D": one(5)}, ValueError, r"D must have shape \[7\].*, got \[5\]$"),
    ),
    mamba_inner_fn: (
        block_inputs(),
        ({"A": one(10, 3).cfloat()}, TypeError, "A has dtype torch.complex64"),
        ({"checkpoint_lvl": 2}, ValueError, "checkpoint_lvl must be.*got 2"),
        ({"x_proj_weight": one(9, 10)}, ValueError, "x_proj_weight has 9 rows, must"),
        ({"conv1d_weight": one(10, 4)}, ValueError, "conv1d_weight must have shape .*10"),
        ({"B": one(10, 3)}, ValueError, "B_proj_bias is given, must be None"),
    ),
    layer_norm_fn: (
        {"x": one(2, 5, 11), "weight": one(11), "bias": None},
        ({"x": [1.0]}, TypeError, "x must be a tensor.*, got list"),
        ({"weight": one(3)}, ValueError, r"weight must have shape \[11\].*, got \[3\]"),
        ({"residual": one(5, 11)}, ValueError, r"residual must have shape \[2, 5"),
        ({"x1": 1e-5}, TypeError, "x1 must be.*got float"),
        ({"rowscale": one(2, 5), "x1": one(2, 5, 11)}, ValueError, "pass either rowscale or x1"),
        ({"rowscale": one(2)}, ValueError, "rowscale must have shape"),
    ),
    Mamba: (
        {"d_model": 8, "bimamba_type": "none"},
        ({"d_conv": 5}, ValueError, "d_conv must be one of 2, 3, 4, got 5"),
        ({"d_state": 257}, ValueError, "d_state must be 1 to 256.*, got 257"),
        ({"dt_init": "zeros"}, ValueError, "dt_init must be.*got 'zeros'"),
        ({"dt_rank": "full"}, ValueError, "dt_rank is supported only as 'auto', got 'full'"),
    ),
    create_block: (
        {"d_model": 8, "ssm_cfg": {"layer": "Mamba1"}},
        ({"d_intermediate": 16}, ValueError, "d_intermediate is supported only as 0, got 16"),
        ({"attn_layer_idx": [1]}, ValueError, r"attn_layer_idx is supported only as .*got \[1\]"),
        ({"ssm_cfg": {"layer": "Mamba2"}}, ValueError, "ssm_cfg.'layer'. is supported only as"),
    ),
}
CASES = [(call, *case) for call, (_, *cases) in REFUSED.items() for case in cases]


@pytest.mark.parametrize("call, change, error, text", CASES)
def test_refuses(call, change, error, text):
    given = REFUSED[call][0]
    call(**given)
    with pytest.raises(error, match=f"^{text}"):
        call(**given | change)
