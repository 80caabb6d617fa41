"""The native loop of the CPU convolution: tokens of sixteen channels in one call."""

import torch
import warp as wp

from ..runtime.lanes import ACTIVATIONS, PRELUDE, WARP_DTYPES, lanes
from ..runtime.rows import ELEMENTS, SETTLE, put, rows

_STRIP = f"""
const F v0 = *(const F*)&w0, v1 = *(const F*)&w1, v2 = *(const F*)&w2, v3 = *(const F*)&w3;
const F v = *(const F*)&bias;
F x0 = *(const F*)&first, x1 = *(const F*)&second, x2 = *(const F*)&third;
for (int t = 0; t < count; ++t) {{
    const F x3 = read_x(t);
    F y = fma_(v0, x0, fma_(v1, x1, fma_(v2, x2, fma_(v3, x3, v))));
    if (use_silu) y = y * sigmoid_(y);
    put_y(t, y);
    x0 = x1, x1 = x2, x2 = x3;
}}
if (stream && d + 16 >= x_in.shape[2]) {{  // the last channels of a row of tasks
{SETTLE}
}}
"""


def strip(io: torch.dtype):
    """The function of ``count`` tokens of sixteen channels from ``t0`` on (README, equation 1).

    Args:
        io: dtype of ``x_in`` and ``y_out``; all else is float32.
    """
    scalar = WARP_DTYPES[io]
    text = PRELUDE + ACTIVATIONS + ELEMENTS + rows("x_in", io) + rows("y_out", io) + put("y")

    @wp.func_native(text + _STRIP)
    def conv_strip(
        x_in: wp.array3d(dtype=scalar),
        b: int,
        t0: int,
        count: int,
        d: int,
        width: int,
        w0: lanes,
        w1: lanes,
        w2: lanes,
        w3: lanes,
        bias: lanes,
        first: lanes,
        second: lanes,
        third: lanes,
        use_silu: int,
        stream: int,
        y_out: wp.array3d(dtype=scalar),
    ): ...

    return conv_strip
