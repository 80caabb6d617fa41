"""Packed rows: each sequence has the bits that it has alone, whatever stands beside it."""

from functools import partial
from unittest.mock import patch

import pytest
import torch
from helpers import on_threads
from helpers.kernels import conv_inputs as unpacked
from helpers.scan import gradients, leaves, make

from gamba_warp.kernels.causal_conv1d import causal_conv1d, causal_conv1d_fn
from gamba_warp.kernels.runtime.packed import sequences
from gamba_warp.kernels.selective_scan import selective_scan, selective_scan_state
from gamba_warp.kernels.selective_scan.cuda import launch as cuda

LENGTHS = [0, 1, 2, 3, 17, 64, 65, 0, 130, 1, 0]
SHARED = ("A", "D", "delta_bias", "weight", "bias")
STATES = ("initial_state",)


def borders(lengths):
    return torch.tensor([0, *lengths]).cumsum(0).int()


def scan_inputs(lengths, channels, states, groups=1, dtype=torch.float32):
    inputs = make(1, sum(lengths), channels, states, groups, dtype)
    return inputs | {"initial_state": torch.randn(len(lengths), channels, states)}


def conv_inputs(lengths, channels, width):
    inputs = unpacked(1, sum(lengths), channels, width)
    return inputs | {"initial_state": torch.randn(len(lengths), width - 1, channels)}


def assert_as_alone(function, inputs, lengths, limit):
    """Compares results and gradients of a packed row with those of each sequence by itself.

    Gradients of what the sequences share are sums over them, in another order: ``limit``.
    """
    cuts = borders(lengths)
    packed = leaves(inputs)
    outs = function(**packed, cu_seqlens=cuts)
    heads = [torch.randn_like(x) for x in outs]
    got = gradients(packed, outs, heads)
    shared = {name: 0 for name in SHARED if name in inputs}
    for s, (i, j) in enumerate(zip(cuts[:-1], cuts[1:])):
        tokens, state = (slice(None), slice(i, j)), slice(s, s + 1)
        place = {k: state if k in STATES else tokens for k in inputs if k not in SHARED}
        alone = leaves({k: v[place[k]] if k in place else v for k, v in inputs.items()})
        own = function(**alone)
        assert torch.equal(outs[0][tokens], own[0]), f"output of sequence {s}"
        assert torch.equal(outs[1][state], own[1]), f"last state of sequence {s}"
        wanted = gradients(alone, own, [heads[0][tokens], heads[1][state]])
        for name, gradient in wanted.items():
            if name in shared:
                shared[name] = shared[name] + gradient
            else:
                assert torch.equal(got[name][place[name]], gradient), f"d{name} of sequence {s}"
    for name, total in shared.items():
        assert (got[name] - total).abs().max() <= limit * total.abs().max(), name


def scan(**x):
    return selective_scan(**x, delta_softplus=True, return_last_state=True)


def conv(**x):
    return causal_conv1d(**x, activation="silu", return_final_state=True)


@pytest.mark.parametrize("device", ["cpu", "ptx", "ptx, in segments"])
@pytest.mark.parametrize(
    "lengths, channels, states, groups, rule, dtype",
    [
        (LENGTHS, 5, 3, 1, "mamba", torch.float32),
        ([5, 63, 64, 1, 129], 37, 16, 1, "mamba", torch.float32),
        ([1, 70, 0, 2], 32, 16, 2, "zoh", torch.float32),
        ([100, 20], 20, 5, 1, "bilinear", torch.float32),
        ([64, 31], 130, 16, 1, "mamba", torch.bfloat16),
        ([3, 40, 1], 700, 3, 1, "mamba", torch.float32),  # dB and dC are sums of many parts
        ([40, 3], 16, 9, 1, "mamba", torch.float16),
    ],
)
def test_scan(lengths, channels, states, groups, rule, dtype, device, from_ptx):
    inputs = scan_inputs(lengths, channels, states, groups, dtype)
    # On CUDA a sequence alone has the same bits if it is cut in as many segments.
    tuning = cuda.Tuning() if device == "ptx" else cuda.Tuning(segments=3, back_segments=2)
    with patch.object(cuda, "choose", lambda *_: tuning):
        if device != "cpu":
            from_ptx()
        assert_as_alone(partial(scan, discretization=rule), inputs, lengths, 1e-5)


def test_scan_on_cuda_of_long_sequences(from_ptx):
    """More segments than runs of sums, and a sequence of more tokens than a run of its sums."""
    lengths = [1300, 0, 70, 1]
    from_ptx()
    for tuning in (cuda.Tuning(5, back_segments=30), cuda.Tuning(2, back_segments=1)):
        with patch.object(cuda, "choose", lambda *_, tuning=tuning: tuning):
            assert_as_alone(scan, scan_inputs(lengths, 5, 3), lengths, 1e-5)


def test_borders_that_nobody_looks_at_are_bounded(from_ptx):
    """On CUDA and under torch.compile: those that fall end an empty sequence, none overlap."""
    lengths = [70, 0, 60, 0]
    inputs, tokens = scan_inputs(lengths, 5, 3), conv_inputs(lengths, 5, 4)
    from_ptx()
    results = []
    with patch.object(torch.compiler, "_is_compiling_flag", True):
        for cuts in ([0, 70, 70, 130, 130], [-3, 70, 20, 200, 130]):
            cuts = torch.tensor(cuts)
            rows = sequences(inputs["u"], cuts, None).tolist()
            assert rows == [[0, 0, 70], [0, 70, 70], [0, 70, 130], [0, 130, 130]]
            results.append([])
            for function, given in ((scan, inputs), (conv, tokens)):
                x = leaves(given)
                outs = function(**x, cu_seqlens=cuts)
                grads = gradients(x, outs, [torch.ones_like(out) for out in outs])
                results[-1] += [*outs, *grads.values()]
    assert all(map(torch.equal, *results))


@pytest.mark.parametrize("threads", [2, 5])
@pytest.mark.parametrize("channels, states", [(5, 4), (64, 16)])
def test_scan_in_segments(channels, states, threads):
    """A packed sequence is cut for the threads in the same places as one alone."""
    lengths = [700, 3, 0, 300, 512, 256, 1, 1030]
    with on_threads(threads):
        assert_as_alone(scan, scan_inputs(lengths, channels, states), lengths, 1e-5)


@pytest.mark.usefixtures("each_device")
@pytest.mark.parametrize("channels, width", [(5, 2), (37, 3), (16, 4)])
def test_convolution(channels, width):
    assert_as_alone(conv, conv_inputs(LENGTHS, channels, width), LENGTHS, 1e-5)


def test_state_alone_and_no_state():
    inputs, cuts = scan_inputs([3, 0, 70], 7, 4), borders([3, 0, 70])
    _, last = scan(**inputs, cu_seqlens=cuts)
    rest = {k: v for k, v in inputs.items() if k not in ("C", "D", "z")}
    assert torch.equal(selective_scan_state(**rest, delta_softplus=True, cu_seqlens=cuts), last)
    rest = {k: v for k, v in inputs.items() if k != "initial_state"}
    zero = torch.zeros_like(inputs["initial_state"])
    with_zeros = scan(**rest, initial_state=zero, cu_seqlens=cuts)
    assert all(map(torch.equal, scan(**rest, cu_seqlens=cuts), with_zeros))


@pytest.mark.parametrize("lengths", [[], [0], [0, 0]])
def test_no_tokens(lengths):
    cases = (scan, scan_inputs(lengths, 5, 3)), (conv, conv_inputs(lengths, 5, 4))
    for function, inputs in cases:
        out, last = function(**inputs, cu_seqlens=borders(lengths).long())
        assert out.shape == (1, 0, 5) and torch.equal(last, inputs["initial_state"])


def test_numbers_of_sequences():
    """``seq_idx`` of two rows says what ``cu_seqlens`` says of one; numbers may have gaps."""
    rows = [[4, 1, 70], [60, 15]]
    numbers = (torch.arange(len(r)).repeat_interleave(torch.tensor(r)) for r in rows)
    seq_idx = 3 * torch.stack([*numbers]).int()
    cuts = borders([*rows[0], *rows[1]])
    x = make(2, 75, 6, 4) | {"initial_state": torch.randn(5, 6, 4)}
    y = {k: v for k, v in unpacked(2, 75, 6, 4).items() if k != "initial_state"}
    for function, inputs in ((scan, x), (lambda **x: [causal_conv1d(**x)], y)):
        flat = {k: v.flatten(0, 1)[None] if len(v) == 2 else v for k, v in inputs.items()}
        outs = function(**inputs, seq_idx=seq_idx)
        wants = function(**flat, cu_seqlens=cuts)
        assert torch.equal(outs[0].flatten(0, 1), wants[0][0])
        assert all(map(torch.equal, outs[1:], wants[1:]))


def test_padding_of_causal_conv1d():
    """Numbers below 0 are no sequence for causal-conv1d: output 0, and no gradient flows."""
    x = unpacked(1, 9, 3, 4)
    t = x["x"].transpose(1, 2).detach().requires_grad_()
    seq_idx = torch.tensor([[0, 0, 0, 1, 1, 1, -1, -1, -1]])
    out = causal_conv1d_fn(t, x["weight"], x["bias"], seq_idx=seq_idx)
    out.sum().backward()
    assert (out[..., 6:] == 0).all() and (t.grad[..., 6:] == 0).all()
    want = causal_conv1d_fn(t[..., 3:6], x["weight"], x["bias"])
    assert torch.equal(out[..., 3:6], want)


@pytest.mark.parametrize(
    "given, error, text",
    [
        ({"cu_seqlens": [0, 4, 3, 7]}, ValueError, "decreases from 4 to 3"),
        ({"cu_seqlens": [1, 7]}, ValueError, "goes from 1 to 7, must go from 0 to 7"),
        ({"cu_seqlens": [0, 6]}, ValueError, "goes from 0 to 6"),
        ({"cu_seqlens": torch.empty(0).int()}, ValueError, r"shape \[S \+ 1\] .*got \(0,\)"),
        ({"cu_seqlens": [0.0, 7.0]}, TypeError, "must have dtype torch.int32.*got torch.float32"),
        ({"cu_seqlens": "all"}, TypeError, "cu_seqlens must be a tensor, got str"),
        ({"cu_seqlens": torch.tensor([0, 7]).to_sparse()}, TypeError, "cu_seqlens must be dense"),
        ({"seq_idx": torch.zeros(1, 7).int().to_sparse()}, TypeError, "seq_idx must be dense"),
        ({"seq_idx": [[0, 0, 1, 1, 0, 2, 2]]}, ValueError, "row 0 repeats 0"),
        ({"seq_idx": [[0, 1]]}, ValueError, r"shape \(1, 7\), got \(1, 2\)"),
        ({"seq_idx": [[0] * 7], "cu_seqlens": [0, 7]}, ValueError, "pass either cu_seqlens or"),
    ],
)
def test_bad_sequences(given, error, text):
    given = {k: torch.tensor(v) if isinstance(v, list) else v for k, v in given.items()}
    for function, inputs in ((selective_scan, make(1, 7, 5, 3)), (conv, unpacked(1, 7, 5, 4))):
        with pytest.raises(error, match=text):
            function(**inputs, **given)


def test_bad_states_and_devices():
    right, x = torch.tensor([0, 3, 7]), make(1, 7, 5, 3)
    for function, given, cuts, text in (
        (scan, x, right, r"initial_state must have shape \(2, 5, 3\).*, got \(1, 5, 3\)"),
        (conv, unpacked(1, 7, 5, 4), right, r"initial_state must have .*\(2, 3, 5\).*\(1, 3, 5\)"),
        (scan, x, right.to("meta"), "cu_seqlens must be on cpu, as the tokens, got meta"),
        (scan, make(2, 7, 5, 3), right, r"got \(3,\) with 2"),
    ):
        with pytest.raises(ValueError, match=text):
            function(**given, cu_seqlens=cuts)


def test_operator_contracts_and_whole_graph():
    """Schema, fake tensors, autograd registration; one graph of both operators under compile."""
    rows = sequences(torch.empty(1, 7, 1), torch.tensor([0, 3, 7]), None)
    x, y = leaves(scan_inputs([3, 4], 5, 3)), leaves(conv_inputs([3, 4], 5, 4))
    arguments = (*x.values(), rows, True, "mamba", True)
    torch.library.opcheck(torch.ops.gamba_warp.selective_scan.default, arguments)
    arguments = (*y.values(), rows, True)
    torch.library.opcheck(torch.ops.gamba_warp.causal_conv1d.default, arguments)

    def both(cuts):
        out, _ = conv(**y, cu_seqlens=cuts)
        return scan(**x | {"u": out}, cu_seqlens=cuts)

    compiled = torch.compile(both, fullgraph=True, backend="aot_eager")
    cuts = torch.tensor([0, 3, 7])
    assert all(map(torch.equal, compiled(cuts), both(cuts)))


def test_export_and_autocast_keep_the_bits(tmp_path):
    """A program of both operators, written to a file and read, with borders it was not made for."""
    x, y = scan_inputs([3, 4], 5, 3), conv_inputs([3, 4], 5, 4)

    class Both(torch.nn.Module):
        def forward(self, cu_seqlens):
            u, state = conv(**y, cu_seqlens=cu_seqlens)
            return *scan(**x | {"u": u}, cu_seqlens=cu_seqlens), state

    made = torch.export.export(Both(), (torch.tensor([0, 3, 7]),))
    torch.export.save(made, tmp_path / "both.pt2")
    read = torch.export.load(tmp_path / "both.pt2").module()
    for cuts in ([0, 3, 7], [0, 0, 7]):
        wanted = Both()(torch.tensor(cuts))
        assert all(map(torch.equal, read(torch.tensor(cuts)), wanted))
        with torch.autocast("cpu", torch.bfloat16):  # products round; these operators have none
            assert all(map(torch.equal, Both()(torch.tensor(cuts)), wanted))
