"""1 - SSIM of pictures and its slope, sixteen adjacent numbers of a row at a time.

Pictures are ``[P, H, E]`` with E = W · C. The maps between two launches have their rows side by
side: row ``4 y + i`` is map i of row y, and ``3 y + i`` where there are three. README.md has the
formulas.
"""

from typing import no_type_check

import torch
import warp as wp

from ...runtime.lanes import LANES, VECTORS, W, lanes
from ...runtime.views import struct
from ..constants import C1, C2, EDGE, SIGMA, WINDOW

STRIP = 8  # rows of windows of a task, whose values are summed before they are stored
_STRIP, _EDGE = wp.constant(STRIP), wp.constant(EDGE)
_ROW = wp.array3d(dtype=wp.float32)


def _weights() -> str:
    """The window's eleven weights of a row, as C++ text."""
    places = torch.arange(WINDOW, dtype=torch.float64) - WINDOW // 2
    line = torch.exp(-places.square() / (2 * SIGMA**2))
    return ", ".join(f"{float(w)!r}f" for w in line / line.sum())


# ``AT`` is where row r of the task's picture has its number d; lanes past ``width`` are read as 0.
_PRELUDE = (
    VECTORS
    + "const int b = at.picture, d = at.first, width = at.width;"
    + f"const float weights[{WINDOW}] = {{{_weights()}}};"
    + """
auto fma_ = [&](float a, F b, F c) -> F { return __builtin_elementwise_fma(splat(a), b, c); };
auto read = [&](const float* p) -> F {
    if (width >= 16) return *(const F*)p;
    F v = F{};
    for (int i = 0; i < width; ++i) v[i] = p[i];
    return v;
};
auto write = [&](float* p, F v) {
    if (width >= 16) *(F*)p = v;
    else for (int i = 0; i < width; ++i) p[i] = v[i];
};
#define AT(A, r, d) ((float*)((char*)(A).data + (size_t)b * (A).strides[0] \\
    + (size_t)(r) * (A).strides[1]) + (d))
"""
)

_ACROSS = """
const float *g = AT(got_in, y, d), *w = AT(want_in, y, d);
F s0 = F{}, s1 = F{}, s2 = F{}, s3 = F{};
const F m = read(AT(shift_in, 0, d));  // the same for each tap, which has the same channel
#pragma unroll
for (int k = 0; k < 11; ++k) {
    F a = read(g + k * channels), c = read(w + k * channels);
    F s = a + c - m, q = a - c;
    s0 = fma_(weights[k], s, s0);
    s1 = fma_(weights[k], q, s1);
    s2 = fma_(weights[k], s * s, s2);
    s3 = fma_(weights[k], q * q, s3);
}
write(AT(hor_out, 4 * y, d), s0);
write(AT(hor_out, 4 * y + 1, d), s1);
write(AT(hor_out, 4 * y + 2, d), s2);
write(AT(hor_out, 4 * y + 3, d), s3);
"""
_DOWN = f"""
F s0 = F{{}}, d0 = F{{}}, s2 = F{{}}, d2 = F{{}};
#pragma unroll
for (int k = 0; k < 11; ++k) {{
    s0 = fma_(weights[k], read(AT(hor_in, 4 * (y + k), d)), s0);
    d0 = fma_(weights[k], read(AT(hor_in, 4 * (y + k) + 1, d)), d0);
    s2 = fma_(weights[k], read(AT(hor_in, 4 * (y + k) + 2, d)), s2);
    d2 = fma_(weights[k], read(AT(hor_in, 4 * (y + k) + 3, d)), d2);
}}
F s = s0 + read(AT(shift_in, 0, d));
F bright = s * s + {2 * C1!r}f, dark = d0 * d0;
F rough = s2 - s0 * s0 + {2 * C2!r}f, odd = d2 - d0 * d0;
F one = splat(1.0f), p = one / (bright + dark), q = one / (rough + odd);
// the shares of dark and odd, of which light = 1 - 2 unlit and shape = 1 - 2 unlike
F unlit = dark * p, unlike = odd * q, light = one - 2.0f * unlit, shape = one - 2.0f * unlike;
if (by_out.shape[1] > 0) {{
    F f = light * q * q * (2.0f * scale);
    F by1 = -f * odd, by2 = f * rough;
    F by0 = (shape * p * p * (-4.0f * scale)) * (dark * s - bright * d0);
    write(AT(by_out, 3 * y, d), by0 - 2.0f * (by1 * s0 + by2 * d0));
    write(AT(by_out, 3 * y + 1, d), by1);
    write(AT(by_out, 3 * y + 2, d), by2);
}}
{LANES} r;
*(F*)&r = 2.0f * (unlit + unlike - 2.0f * unlit * unlike);
return r;
"""
_UP = """
const int first = y < 10 ? 0 : y - 10, last = y < rows ? y : rows - 1;
F v0 = F{}, v1 = F{}, v2 = F{};
for (int t = first; t <= last; ++t) {
    const float c = weights[y - t];
    v0 = fma_(c, read(AT(by_in, 3 * t, d)), v0);
    v1 = fma_(c, read(AT(by_in, 3 * t + 1, d)), v1);
    v2 = fma_(c, read(AT(by_in, 3 * t + 2, d)), v2);
}
write(AT(col_out, 3 * y, d + edge), v0);
write(AT(col_out, 3 * y + 1, d + edge), v1);
write(AT(col_out, 3 * y + 2, d + edge), v2);
"""
_BACK = """
const float *c0 = AT(col_in, 3 * y, d), *c1 = AT(col_in, 3 * y + 1, d);
const float *c2 = AT(col_in, 3 * y + 2, d);
F b0 = F{}, b1 = F{}, b2 = F{};
#pragma unroll
for (int k = 0; k < 11; ++k) {
    b0 = fma_(weights[k], read(c0 + k * channels), b0);
    b1 = fma_(weights[k], read(c1 + k * channels), b1);
    b2 = fma_(weights[k], read(c2 + k * channels), b2);
}
F a = read(AT(got_in, y, d)), c = read(AT(want_in, y, d));
F s = a + c - read(AT(shift_in, 0, d)), q = a - c;
write(AT(slope_out, y, d), b0 + 2.0f * (s * b1 + q * b2));
"""


@struct
class Place:
    """The numbers of a task: sixteen of a picture's row, or fewer at its end."""

    picture: int
    row: int  # or the number of a strip of rows
    first: int  # the first of the numbers in the row
    width: int  # how many numbers the row still has, at most sixteen


@wp.func
@no_type_check
def _place(task: int, rows: int, group: int, numbers: int) -> Place:
    # of pictures with so many rows to a picture and numbers to a row
    at = Place()
    at.picture = task / rows
    at.row = task % rows
    at.first = group * wp.static(W)
    at.width = wp.min(wp.static(W), numbers - at.first)
    return at


@wp.func_native(_PRELUDE + "const int y = at.row;" + _ACROSS)
def _across(
    at: Place, channels: int, got_in: _ROW, want_in: _ROW, shift_in: _ROW, hor_out: _ROW
): ...


@wp.func_native(_PRELUDE + _DOWN)
def _down(at: Place, y: int, scale: float, hor_in: _ROW, shift_in: _ROW, by_out: _ROW) -> lanes: ...


@wp.func_native(_PRELUDE + "const int y = at.row;" + _UP)
def _up(at: Place, rows: int, edge: int, by_in: _ROW, col_out: _ROW): ...


@wp.func_native(_PRELUDE + "const int y = at.row;" + _BACK)
def _back(
    at: Place, channels: int, got_in: _ROW, want_in: _ROW, shift_in: _ROW, col_in: _ROW,
    slope_out: _ROW,
): ...  # fmt: skip


@wp.func_native(_PRELUDE + "write(AT(values_out, at.row, d), *(const F*)&v);")
def _store(at: Place, v: lanes, values_out: _ROW): ...


@wp.kernel(enable_backward=False)
@no_type_check
def across(
    offset: int,
    # in
    channels: int,
    got_in: _ROW,
    want_in: _ROW,
    shift_in: _ROW,
    # out
    hor_out: _ROW,
):
    """The four maps' means along rows: ``hor_out [P, 4 H, E - 10 C]``."""
    task, group = wp.tid()
    at = _place(offset + task, got_in.shape[1], group, hor_out.shape[2])
    _across(at, channels, got_in, want_in, shift_in, hor_out)


@wp.kernel(enable_backward=False)
@no_type_check
def down(
    offset: int,
    # in
    rows: int,
    scale: float,
    hor_in: _ROW,
    shift_in: _ROW,
    # out
    by_out: _ROW,
    values_out: _ROW,
):
    """Values ``[P, strips, E - 10 C]``, sums of ``STRIP`` rows, and what the slope is made of."""
    task, group = wp.tid()
    at = _place(offset + task, values_out.shape[1], group, hor_in.shape[2])
    total = lanes(0.0)
    for y in range(at.row * _STRIP, wp.min((at.row + 1) * _STRIP, rows)):
        total = total + _down(at, y, scale, hor_in, shift_in, by_out)
    _store(at, total, values_out)


@wp.kernel(enable_backward=False)
@no_type_check
def up(
    offset: int,
    # in
    rows: int,
    edge: int,
    by_in: _ROW,
    # out
    col_out: _ROW,
):
    """Transposed means along columns: ``col_out [P, 3 H, E + 10 C]``, with room at both sides."""
    task, group = wp.tid()
    at = _place(offset + task, rows + _EDGE, group, by_in.shape[2])
    _up(at, rows, edge, by_in, col_out)


@wp.kernel(enable_backward=False)
@no_type_check
def back(
    offset: int,
    # in
    channels: int,
    got_in: _ROW,
    want_in: _ROW,
    shift_in: _ROW,
    col_in: _ROW,
    # out
    slope_out: _ROW,
):
    """The slope ``[P, H, E]``."""
    task, group = wp.tid()
    at = _place(offset + task, got_in.shape[1], group, got_in.shape[2])
    _back(at, channels, got_in, want_in, shift_in, col_in, slope_out)
