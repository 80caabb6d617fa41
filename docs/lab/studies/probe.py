"""Bare scan for a CPU, to show the speed of the sum without an operator around it.

It is one native loop over a block of 16 adjacent channels, with their 16 states unrolled and exp2
by a polynomial. It has no gate, skip connection, softplus or bias, no gradient, one dtype and 16
states, and it writes to a given output. The operator's cost is stated as a ratio to its time.
"""

import functools
from typing import no_type_check

import warp as wp
from torch import Tensor

from gamba_warp.kernels.runtime.launch import parallel_launch

LANES = STATES = 16
_LOG2E = 1.4426950408889634

# exp2: adding and subtracting 1.5 * 2^23 rounds to an integer. A polynomial of degree 5 takes the
# rest (relative error 2e-7), and its exponent then gets the integer.
_SCAN = """
typedef float F __attribute__((vector_size(64), aligned(4)));
typedef int I __attribute__((vector_size(64), aligned(4)));
auto fma_ = [](F a, F b, F c) -> F { return __builtin_elementwise_fma(a, b, c); };
const F shifter = F{} + 12582912.0f;
F h[16], a[16];
for (int n = 0; n < 16; ++n) {
    h[n] = F{};
    a[n] = *(const F*)&rate.data[n * channels + d];
}
for (int t = 0; t < length; ++t) {
    const F step = *(const F*)&delta.data[t * channels + d];
    const F x = step * *(const F*)&u.data[t * channels + d];
    const float* b = &b_rows.data[t * 16];
    const float* c = &c_rows.data[t * 16];
    F y = F{};
    #pragma unroll
    for (int n = 0; n < 16; ++n) {
        F e = step * a[n];
        e = e < -126.0f ? F{} - 126.0f : e;
        F i = e + shifter;
        F r = e - (i - shifter);
        F p = F{} + 1.32764715e-3f;
        p = fma_(p, r, F{} + 9.67554133e-3f);
        p = fma_(p, r, F{} + 5.55071327e-2f);
        p = fma_(p, r, F{} + 0.240221197f);
        p = fma_(p, r, F{} + 0.693146967f);
        p = fma_(p, r, F{} + 1.00000007f);
        F f = (F)((I)p + ((I)i << 23));
        h[n] = fma_(f, h[n], x * b[n]);
        y = fma_(h[n], F{} + c[n], y);
    }
    *(F*)&out.data[t * channels + d] = y;
}
"""


@functools.cache
def _kernel():
    @wp.func_native(_SCAN)
    def scan_block(
        d: int,
        length: int,
        channels: int,
        u: wp.array(dtype=wp.float32),
        delta: wp.array(dtype=wp.float32),
        rate: wp.array(dtype=wp.float32),
        b_rows: wp.array(dtype=wp.float32),
        c_rows: wp.array(dtype=wp.float32),
        out: wp.array(dtype=wp.float32),
    ): ...

    @wp.kernel(enable_backward=False, module="unique")
    @no_type_check
    def probe(
        offset: int,
        # in
        length: int,
        channels: int,
        u_in: wp.array(dtype=wp.float32),
        delta_in: wp.array(dtype=wp.float32),
        rate_in: wp.array(dtype=wp.float32),
        b_in: wp.array(dtype=wp.float32),
        c_in: wp.array(dtype=wp.float32),
        # out
        y_out: wp.array(dtype=wp.float32),
    ):
        d = (offset + wp.tid()) * wp.static(LANES)
        scan_block(d, length, channels, u_in, delta_in, rate_in, b_in, c_in, y_out)

    return probe


def probe_scan(u: Tensor, delta: Tensor, rate: Tensor, B: Tensor, C: Tensor, out: Tensor) -> Tensor:
    """Compute h_t = exp(δA) h_{t-1} + δ B_t u_t, out_t = Σ_n C_t h_t on torch's threads.

    Args:
        u: ``[L, D]``, D a multiple of 16; like all arguments float32 on the CPU, dense.
        delta: ``[L, D]``, the step δ itself, > 0.
        rate: ``[16, D]`` from ``probe_rate``.
        B: ``[L, 16]``.
        C: ``[L, 16]``.
        out: ``[L, D]``, which is overwritten.

    Returns:
        ``out``.
    """
    length, channels = u.shape
    arrays = [x.view(-1) for x in (u, delta, rate, B, C)]
    parallel_launch(_kernel(), channels // LANES, [length, channels, *arrays], [out.view(-1)])
    return out


def probe_rate(A: Tensor) -> Tensor:
    """Map A ``[D, 16]``, negative numbers, to the A·log2(e) ``[16, D]`` of ``probe_scan``."""
    return (A.T * _LOG2E).contiguous()
