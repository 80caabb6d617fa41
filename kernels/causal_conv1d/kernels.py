"""Causal depthwise convolution of at most four taps, with SiLU: the step before the scan.

One kernel body serves both devices: its values are lanes of sixteen channels on a CPU and single
floats, one thread each, on CUDA. Equations 1 and 2 of README.md.
"""

import functools
from pathlib import Path
from typing import no_type_check

import torch
import warp as wp

from ..runtime import rows as cpu_values
from ..runtime import scalars as cuda_values
from ..runtime.lanes import PRELUDE, WARP_DTYPES
from ..runtime.native import native

TAPS = 4
STRIP = 16  # tokens of a forward task; few, because each row may lie in another page
CHUNK = 64  # tokens of a backward task, each with its own sum for the gradient of the weight
# Tokens that a CPU adds one after the other: equal terms would round to the same side 64 times.
# CUDA has no registers for a second level of sums: with 86 of them, not 78, a block less fits.
RUN = 16
_S = wp.constant(STRIP)
_K = wp.constant(CHUNK)
_HISTORY = wp.constant(TAPS - 1)


def _values(device_type: str, io: torch.dtype):
    """Value type, its channels, load, store and the arithmetic of one device."""
    m = cpu_values if device_type == "cpu" else cuda_values
    load, store = m.ACCESSORS[io]
    return m.VALUE, m.WIDTH, load, store, m.times, m.fma, m.sigmoid


def _strip(device_type: str, io: torch.dtype):
    """The function of ``count`` tokens of one value from ``t0`` on, after three older ones.

    Where a value is lanes of channels it is one loop of native code: the text below, which has the
    same bits, takes 1.1 to 1.4 times as long there.
    """
    value, channels_of_value, load, store, times, fma, sigmoid = _values(device_type, io)
    scalar = WARP_DTYPES[io]
    if channels_of_value > 1:
        text = native(Path(__file__).with_name("strip.inl"))

        @wp.func_native(PRELUDE + cpu_values.ROWS + text)
        def lanes_strip(
            x_in: wp.array3d(dtype=scalar),
            b: int,
            t0: int,
            count: int,
            d: int,
            width: int,
            w0: value,
            w1: value,
            w2: value,
            w3: value,
            bias: value,
            first: value,
            second: value,
            third: value,
            use_silu: int,
            stream: int,
            y_out: wp.array3d(dtype=scalar),
        ): ...

        return lanes_strip

    @wp.func
    @no_type_check
    def strip(
        x_in: wp.array3d(dtype=scalar),
        b: int,
        t0: int,
        count: int,
        d: int,
        width: int,
        w0: value,
        w1: value,
        w2: value,
        w3: value,
        bias: value,
        first: value,
        second: value,
        third: value,
        use_silu: int,
        stream: int,
        y_out: wp.array3d(dtype=scalar),
    ):
        x0 = first
        x1 = second
        x2 = third
        for t in range(t0, t0 + count):
            x3 = load(x_in, b, t, d, width)
            y = fma(w0, x0, fma(w1, x1, fma(w2, x2, fma(w3, x3, bias))))
            if use_silu != 0:
                y = times(y, sigmoid(y))
            store(y_out, b, t, d, width, y)
            x0 = x1
            x1 = x2
            x2 = x3

    return strip


@functools.cache
def forward_kernel(device_type: str, io: torch.dtype):
    """The kernel for tensors of dtype ``io`` on a device of that type (README, equation 1)."""
    value, channels_of_value, load, *_ = _values(device_type, io)
    scalar = WARP_DTYPES[io]
    strip = _strip(device_type, io)

    @wp.kernel(enable_backward=False, module="unique")
    @no_type_check
    def conv_forward(
        offset: int,
        # in
        strips: int,
        use_silu: int,
        stream: int,
        x_in: wp.array3d(dtype=scalar),
        weight_in: wp.array2d(dtype=value),
        bias_in: wp.array(dtype=value),
        state_in: wp.array3d(dtype=scalar),
        # out
        y_out: wp.array3d(dtype=scalar),
    ):
        task, k = wp.tid()
        task = task + offset
        b = task / strips
        t0 = (task % strips) * _S
        d = k * wp.static(channels_of_value)
        width = wp.min(wp.static(channels_of_value), x_in.shape[2] - d)
        x0, x1, x2 = value(0.0), value(0.0), value(0.0)
        for i in range(_HISTORY):
            x0 = x1
            x1 = x2
            t = t0 - _HISTORY + i
            if t >= 0:
                x2 = load(x_in, b, t, d, width)
            elif state_in.shape[1] > 0:
                x2 = load(state_in, b, t + _HISTORY, d, width)
        strip(
            x_in, b, t0, wp.min(_S, x_in.shape[1] - t0), d, width, weight_in[0, k],
            weight_in[1, k], weight_in[2, k], weight_in[3, k], bias_in[k], x0, x1, x2, use_silu,
            stream, y_out,
        )  # fmt: skip

    return conv_forward


@functools.cache
def backward_kernel(device_type: str, io: torch.dtype):
    """The kernel of the gradients (README, equation 2); those of the weight are one sum a chunk."""
    value, channels_of_value, load, store, times, fma, sigmoid = _values(device_type, io)
    scalar = WARP_DTYPES[io]
    in_runs = device_type == "cpu"
    most = RUN if in_runs else CHUNK + TAPS - 1

    @wp.kernel(enable_backward=False, module="unique")
    @no_type_check
    def conv_backward(
        offset: int,
        # in
        chunks: int,
        use_silu: int,
        x_in: wp.array3d(dtype=scalar),
        weight_in: wp.array2d(dtype=value),
        bias_in: wp.array(dtype=value),
        state_in: wp.array3d(dtype=scalar),
        dout_in: wp.array3d(dtype=scalar),
        # out
        dx_out: wp.array3d(dtype=scalar),
        dstate_out: wp.array3d(dtype=scalar),
        dweight_out: wp.array3d(dtype=value),
    ):
        task, k = wp.tid()
        task = task + offset
        b = task / chunks
        t0 = (task % chunks) * _K
        length = x_in.shape[1]
        end = wp.min(t0 + _K, length)
        d = k * wp.static(channels_of_value)
        width = wp.min(wp.static(channels_of_value), x_in.shape[2] - d)
        w0, w1, w2, w3 = weight_in[0, k], weight_in[1, k], weight_in[2, k], weight_in[3, k]
        x0, x1, x2, x3 = value(0.0), value(0.0), value(0.0), value(0.0)
        for i in range(_HISTORY):
            x0 = x1
            x1 = x2
            t = t0 - _HISTORY + i
            if t >= 0:
                x2 = load(x_in, b, t, d, width)
            elif state_in.shape[1] > 0:
                x2 = load(state_in, b, t + _HISTORY, d, width)
        g0, g1, g2, g3 = value(0.0), value(0.0), value(0.0), value(0.0)
        s0, s1, s2, s3, sb = value(0.0), value(0.0), value(0.0), value(0.0), value(0.0)
        # dx of token t needs the gradients g of t to t + 3: the loops run three tokens behind
        runs = 1
        if wp.static(in_runs):
            runs = (end + _HISTORY - t0 + wp.static(most - 1)) / wp.static(most)
        for run in range(runs):
            first = t0 + run * wp.static(most)
            v0, v1, v2, v3, vb = value(0.0), value(0.0), value(0.0), value(0.0), value(0.0)
            for t in range(first, wp.min(first + wp.static(most), end + _HISTORY)):
                g3 = value(0.0)
                if t < length:
                    x3 = load(x_in, b, t, d, width)
                    g3 = load(dout_in, b, t, d, width)
                    if use_silu != 0:
                        y = fma(w0, x0, fma(w1, x1, fma(w2, x2, fma(w3, x3, bias_in[k]))))
                        s = sigmoid(y)
                        g3 = times(g3, fma(times(y, s), value(1.0) - s, s))
                    if t < end:
                        v0 = fma(g3, x0, v0)
                        v1 = fma(g3, x1, v1)
                        v2 = fma(g3, x2, v2)
                        v3 = fma(g3, x3, v3)
                        vb = vb + g3
                dx = fma(w3, g0, fma(w2, g1, fma(w1, g2, times(w0, g3))))
                at = t - _HISTORY
                if at >= t0:
                    if dx_out.shape[1] > 0:
                        store(dx_out, b, at, d, width, dx)
                elif at < 0 and dstate_out.shape[1] > 0:
                    store(dstate_out, b, t, d, width, dx)
                x0 = x1
                x1 = x2
                x2 = x3
                g0 = g1
                g1 = g2
                g2 = g3
            s0, s1, s2, s3, sb = s0 + v0, s1 + v1, s2 + v2, s3 + v3, sb + vb
        if dweight_out.shape[1] > 0:
            dweight_out[task, 0, k] = s0
            dweight_out[task, 1, k] = s1
            dweight_out[task, 2, k] = s2
            dweight_out[task, 3, k] = s3
            dweight_out[task, 4, k] = sb

    return conv_backward
