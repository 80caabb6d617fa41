"""The next tokens of a convolution: against whole sequences, with rings, rows and any lengths."""

import pytest
import torch
import torch.nn.functional as F
from helpers import assert_rel_rms

from gamba_warp.compat import causal_conv1d as compat
from gamba_warp.compat.causal_conv1d import causal_conv1d_ref, causal_conv1d_update
from gamba_warp.compat.causal_conv1d.causal_conv1d_varlen import causal_conv1d_varlen_states

LIMITS = {torch.float32: 5e-7, torch.float16: 5e-4, torch.bfloat16: 4e-3}  # half an ulp


def whole(tokens, weight, bias, activation):
    """The convolution of ``[B, D, L]`` from zeros on, in float64 by torch."""
    padded = F.pad(tokens.double(), (weight.shape[1] - 1, 0))
    bias = None if bias is None else bias.double()
    out = F.conv1d(padded, weight.double()[:, None], bias, groups=len(weight))
    return out if activation is None else F.silu(out)


@pytest.mark.parametrize("dtype", LIMITS, ids=str)
@pytest.mark.parametrize("ring", [False, True])
@pytest.mark.parametrize("width, size", [(2, 1), (3, 3), (4, 4), (4, 3), (3, 9)])
@pytest.mark.parametrize("bias, activation", [(True, "silu"), (False, None)])
@pytest.mark.parametrize("update", [causal_conv1d_update, compat.causal_conv1d_update_ref])
def test_pieces_make_the_whole(width, size, ring, bias, activation, dtype, update):
    batch, channels, pieces = 3, 5, (1, 1, 4, 2, 1, 11, 1)
    tokens = torch.randn(batch, channels, sum(pieces)).to(dtype)
    weight = torch.randn(channels, width)
    bias = torch.randn(channels) if bias else None
    state = torch.zeros(batch, channels, size).to(dtype)
    seen, outs = 0, []
    for piece in tokens.split(pieces, -1):
        at = torch.full((batch,), seen, dtype=torch.int32) if ring else None
        piece = piece[..., 0] if piece.shape[2] == 1 else piece
        out = update(piece, state, weight, bias, activation, cache_seqlens=at)
        assert out.shape == piece.shape and out.dtype == dtype
        outs.append(out.view(batch, channels, -1))
        seen += outs[-1].shape[2]
    assert_rel_rms(torch.cat(outs, -1), whole(tokens, weight, bias, activation), LIMITS[dtype], "")
    columns = [t % size if ring else t - seen + size for t in range(seen - size, seen)]
    assert torch.equal(state[..., columns], tokens[..., seen - size :])


@pytest.mark.parametrize("states, activation", [(False, None), (True, "swish")])
def test_the_reference(states, activation):
    """float64, any number of taps, and gradients."""
    x, weight = torch.randn(2, 3, 11).double().requires_grad_(), torch.randn(3, 6).double()
    bias, first = torch.randn(3).double(), torch.randn(2, 3, 5).double()
    before, given = (first, first) if states else (torch.zeros_like(first), None)
    out, final = causal_conv1d_ref(x, weight, bias, given, True, activation=activation)
    padded = torch.cat([before, x], -1)
    want = whole(padded, weight, bias, activation)[..., 5:]
    assert torch.allclose(out, want, atol=1e-12) and torch.equal(final, padded[..., -5:])
    into = torch.empty_like(first)
    given = {"return_final_states": True, "final_states_out": into}
    assert causal_conv1d_ref(x, weight, **given)[1] is into
    grads = [torch.autograd.grad(y.sum(), x, retain_graph=True)[0] for y in (out, want)]
    assert torch.allclose(*grads, atol=1e-12)
    for wrong in ({"activation": "relu"}, {"seq_idx": torch.zeros(2, 11)}):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            causal_conv1d_ref(x, weight, **wrong)


@pytest.mark.parametrize("lengths", [(3, 1, 7), (0, 4, 0), (0, 0)])
def test_the_states_of_packed_sequences(lengths):
    x = torch.randn(sum(lengths), 5)
    ends = torch.tensor([0, *lengths]).cumsum(0).int()
    got = causal_conv1d_varlen_states(x, ends, 4)
    want = [F.pad(part.T, (4, 0))[:, -4:] for part in x.split(lengths)]
    assert torch.equal(got, torch.stack(want))
    with pytest.raises(ValueError, match="cu_seqlens"):
        causal_conv1d_varlen_states(x[None], ends, 4)


@pytest.mark.parametrize("channels", [16, 5])
def test_one_token_as_a_column_is_one_as_a_row(channels):
    """``[B, D, 1]``, as transformers decodes."""
    both, weight = torch.randn(2, 1, 2 * channels).mT, torch.randn(channels, 4)
    column, states = both.chunk(2, 1)[0], torch.zeros(2, 2, channels, 4)
    got = causal_conv1d_update(column, states[0], weight, None, "silu")
    want = causal_conv1d_update(column[..., 0], states[1], weight, None, "silu")
    assert torch.equal(got, want[..., None]) and torch.equal(*states)


def test_each_ring_has_its_own_place():
    tokens, weight = torch.randn(2, 5, 9), torch.randn(5, 4)
    state = torch.zeros(2, 5, 6)
    causal_conv1d_update(tokens[:1, :, :5], state[:1], weight, cache_seqlens=torch.tensor([0]))
    causal_conv1d_update(tokens[1:, :, :8], state[1:], weight, cache_seqlens=torch.tensor([0]))
    following = torch.stack([tokens[0, :, 5], tokens[1, :, 8]])
    out = causal_conv1d_update(following, state, weight, cache_seqlens=torch.tensor([5, 8]))
    want = whole(tokens, weight, None, None)
    assert_rel_rms(out, torch.stack([want[0, :, 5], want[1, :, 8]]), 5e-7, "out")


@pytest.mark.parametrize("ring", [False, True])
def test_rows_by_indices_and_padding(ring):
    x, weight, bias = torch.randn(3, 5), torch.randn(5, 4), torch.randn(5)
    state = torch.randn(7, 5, 6)
    at = torch.tensor([3, 8, 1], dtype=torch.int32) if ring else None
    expected = state.clone()
    rows = expected[[4, 2]]
    places = at if at is None else at[::2]
    want = causal_conv1d_update(x[[0, 2]], rows, weight, bias, "silu", places)
    expected[[4, 2]] = rows
    indices = torch.tensor([4, -1, 2], dtype=torch.int32)
    out = causal_conv1d_update(x, state, weight, bias, "silu", at, indices)
    assert torch.equal(out[[0, 2]], want) and (out[1] == 0).all()
    assert torch.equal(state, expected)


def test_the_form_of_version_1_0():
    """The activation comes after the bias."""
    x, weight, bias = torch.randn(2, 5, 9), torch.randn(5, 4), torch.randn(5)
    want = compat.causal_conv1d_fn(x, weight, bias, activation="silu")
    assert torch.equal(compat.causal_conv1d_fn(x, weight, bias, "silu"), want)
    with pytest.raises(ValueError, match="activation"):
        compat.causal_conv1d_fn(x, weight, bias, "relu")
