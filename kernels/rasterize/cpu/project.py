"""The projection on the CPU: sixteen Gaussians of a view as lanes, and the same bits as the kernel
of ``../project.py``, whose operations are done here in the same order. README.md §1 has the maths.
"""

from typing import no_type_check

import torch
import warp as wp

from ...runtime.launch import parallel_launch
from ..constants import COMPENSATION_MIN
from ..project import STATUS_NAMES, Lens, slope_bounds
from .lanes import TYPES

wp.set_module_options({"enable_backward": False})

_RUN = wp.constant(512)  # Gaussians of a task, a multiple of 16
_PIECES_PER_THREAD = 8  # those that are culled cost less

# What both directions share. A sum of products in one expression becomes fused operations, as it
# does in Warp's own functions; other sums are functions, so that they do not.
LEAD = (
    TYPES
    + """
auto splat = [](float x) -> F { return F{} + x; };
auto add_ = [](F a, F b) -> F { return a + b; };
auto mul_ = [](F a, F b) -> F { return a * b; };
auto abs_ = [](F a) -> F { return __builtin_elementwise_abs(a); };
auto root_ = [](F a) -> F { return __builtin_elementwise_sqrt(a); };
auto greater_ = [](F a, F b) -> F { return __builtin_elementwise_max(a, b); };
auto less_ = [](F a, F b) -> F { return __builtin_elementwise_min(a, b); };
auto finite_ = [&](F a) -> I { return abs_(a) <= 3.402823466e38f; };
auto dot_ = [](const F* a, const F* b) -> F { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; };
auto cross_ = [](F a, F b, F c, F d) -> F { return a * d - b * c; };
auto sum_ = [&](const F* v) -> F { return add_(add_(abs_(v[0]), abs_(v[1])), abs_(v[2])); };
auto read_ = [](const float* p, int size, int n, F* v) {
    float part[4][16] = {};
    if (n == 16 && size == 3)
        for (int l = 0; l < 16; ++l)
            for (int k = 0; k < 3; ++k) part[k][l] = p[3 * l + k];
    else if (n == 16 && size == 4)
        for (int l = 0; l < 16; ++l)
            for (int k = 0; k < 4; ++k) part[k][l] = p[4 * l + k];
    else
        for (int l = 0; l < n; ++l)
            for (int k = 0; k < size; ++k) part[k][l] = p[size * l + k];
    for (int k = 0; k < size; ++k) v[k] = *(const F*)part[k];
};
auto write_ = [](float* p, int size, int n, const F* v) {
    float part[3][16];
    for (int k = 0; k < size; ++k) *(F*)part[k] = v[k];
    if (n == 16 && size == 2)
        for (int l = 0; l < 16; ++l)
            for (int k = 0; k < 2; ++k) p[2 * l + k] = part[k][l];
    else if (n == 16 && size == 3)
        for (int l = 0; l < 16; ++l)
            for (int k = 0; k < 3; ++k) p[3 * l + k] = part[k][l];
    else
        for (int l = 0; l < n; ++l)
            for (int k = 0; k < size; ++k) p[size * l + k] = part[k][l];
};
// the length of quaternions, in numbers that do not leave float32's range
auto length_ = [&](const F* q) -> F {
    const F m = greater_(greater_(abs_(q[0]), abs_(q[1])), greater_(abs_(q[2]), abs_(q[3])));
    F sum = F{};
    for (int k = 0; k < 4; ++k) {
        const F part = q[k] / m;
        sum += part * part;
    }
    return m > 0.0f ? m * root_(sum) : F{};
};
// makes quaternions unit ones, and R their rotations
auto rotate_ = [&](F* q, F size, F (*R)[3]) {
    const I some = size > 0.0f;
    for (int k = 0; k < 4; ++k) q[k] = some ? q[k] / size : splat(k == 0);
    const F w = q[0], x = q[1], y = q[2], z = q[3], one = splat(1.0f), two = one + one;
    auto plus = [&](F a, F b, F c, F d) { return add_(mul_(a, b), mul_(c, d)); };
    auto minus = [&](F a, F b, F c, F d) { return add_(mul_(a, b), -mul_(c, d)); };
    R[0][0] = add_(one, -mul_(two, plus(y, y, z, z)));
    R[0][1] = mul_(two, minus(x, y, w, z));
    R[0][2] = mul_(two, plus(x, z, w, y));
    R[1][0] = mul_(two, plus(x, y, w, z));
    R[1][1] = add_(one, -mul_(two, plus(x, x, z, z)));
    R[1][2] = mul_(two, minus(y, z, w, x));
    R[2][0] = mul_(two, minus(x, z, w, y));
    R[2][1] = mul_(two, plus(y, z, w, x));
    R[2][2] = add_(one, -mul_(two, plus(x, x, y, y)));
};
// rows of J W: those of J are (fx, 0, jx) and (0, fy, jy)
auto camera_ = [&](const float* V, F fx, F jx, F fy, F jy, F* row0, F* row1) {
    for (int k = 0; k < 3; ++k) {
        row0[k] = fma_(jx, splat(V[8 + k]), mul_(fx, splat(V[k])));
        row1[k] = fma_(jy, splat(V[8 + k]), mul_(fy, splat(V[4 + k])));
    }
};
auto turned_ = [&](const F* row, const F (*R)[3], F* out) {
    for (int k = 0; k < 3; ++k)
        out[k] = fma_(row[2], R[2][k], fma_(row[1], R[1][k], mul_(row[0], R[0][k])));
};
auto to_camera_ = [&](const float* V, const F* mean, F* t) {
    for (int r = 0; r < 3; ++r) {
        F sum = mul_(mean[0], splat(V[4 * r]));
        sum = add_(sum, mul_(mean[1], splat(V[4 * r + 1])));
        sum = add_(sum, mul_(mean[2], splat(V[4 * r + 2])));
        t[r] = add_(sum, splat(V[4 * r + 3]));
    }
};
"""
)

_PROJECT = (
    LEAD
    + """
const float* const V = (const float*)viewmats.data + (size_t)image * 16;
const float* const K = (const float*)Ks.data + (size_t)image * 9;
const int channels = colors.shape[1];
for (int i0 = begin; i0 < end; i0 += 16) {
    const int n = end - i0 < 16 ? end - i0 : 16;
    const size_t i = (size_t)image * num + i0, g = (size_t)object * num + i0;
    F mean[3], scale[3], opacity, t[3];
    read_((const float*)means.data + 3 * g, 3, n, mean);
    read_((const float*)scales.data + 3 * g, 3, n, scale);
    read_(opacities.data + g, 1, n, &opacity);
    to_camera_(V, mean, t);
    I finite = finite_(sum_(mean)) & finite_(sum_(scale)) & finite_(opacity) & finite_(sum_(t));
    F q[4] = {splat(1.0f), F{}, F{}, F{}};
    if (quats.data) {
        read_((const float*)quats.data + 4 * g, 4, n, q);
        F sum = F{};
        for (int k = 0; k < 4; ++k) sum += abs_(q[k]) * 0.25f;
        finite &= finite_(sum);
    }
    const float* const color = colors.data + (colors_per_view ? i : g) * channels;
    F largest = F{};
    int c = 0;
    for (; c + 16 <= n * channels; c += 16) largest += *(const F*)(color + c) * 0.0f;
    float rest = __builtin_reduce_add((I)(largest != 0.0f)) ? 1.0f : 0.0f;
    for (; c < n * channels; ++c) rest += color[c] * 0.0f;
    if (rest != 0.0f)  // something is not finite: 0 times it is NaN
        for (int l = 0; l < n; ++l)
            for (int k = 0; k < channels; ++k)
                if (color[l * channels + k] * 0.0f != 0.0f) finite[l] = 0;

    // every cull is written so that NaN fails it, and comes before the first division by z
    const F z = t[2];
    I status = (z <= far_plane) ? ((opacity >= alpha_min) ? I{} : I{} + TRANSPARENT) : I{} + FAR;
    status = (z >= near_plane) ? status : I{} + NEAR;
    status = finite ? status : I{} + NOT_FINITE;
    const I lane = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};
    I seen = (I)(status == 0) & (I)(lane < n);
    F center[2] = {}, conic[3] = {splat(1.0f), F{}, splat(1.0f)}, extent[2] = {}, depth = F{};
    F shown = F{};
    if (any_(seen)) {
        const F fx = K[0] / z, fy = K[4] / z;
        const F sx = less_(greater_(splat(left), t[0] / z), splat(right));
        const F sy = less_(greater_(splat(top), t[1] / z), splat(bottom));
        const F jx = -fx * sx, jy = -fy * sy;
        F M0[3], M1[3];
        camera_(V, fx, jx, fy, jy, M0, M1);
        if (quats.data) {
            F R[3][3], N0[3], N1[3];
            rotate_(q, length_(q), R);
            turned_(M0, R, N0);
            turned_(M1, R, N1);
            for (int k = 0; k < 3; ++k) M0[k] = N0[k], M1[k] = N1[k];
        }
        for (int k = 0; k < 3; ++k) M0[k] = mul_(M0[k], scale[k]), M1[k] = mul_(M1[k], scale[k]);
        const F across[3] = {cross_(M0[1], M0[2], M1[1], M1[2]), cross_(M0[2], M0[0], M1[2], M1[0]),
            cross_(M0[0], M0[1], M1[0], M1[1])};
        const F det0 = dot_(across, across), d00 = dot_(M0, M0), d11 = dot_(M1, M1);
        const F eps = splat(eps2d);
        const F det = add_(add_(det0, mul_(eps, add_(d00, d11))), mul_(eps, eps));
        const F sxx = add_(d00, eps), sxy = dot_(M0, M1), syy = add_(d11, eps);
        const F a = syy / det;
        const F x = add_(mul_(splat(K[0]), t[0]) / z, splat(K[2]));
        const F y = add_(mul_(splat(K[4]), t[1]) / z, splat(K[5]));
        const I sound = finite_(det) & (I)(a > 0.0f) & finite_(x) & finite_(y);
        shown = opacity;
        I faint = I{};
        if (antialiased) {
            shown = mul_(opacity, greater_(splat(FLOOR), root_(det0 / det)));
            faint = ~(I)(shown >= alpha_min);
        }
        seen &= sound & ~faint;
        float cuts[16];
        const F over = shown / alpha_min;
        // of all lanes: to ask each costs more than its logarithm
        for (int l = 0; l < 16; ++l) cuts[l] = wp::log(over[l]);
        const F cut = root_(mul_(splat(2.0f), *(const F*)cuts));
        extent[0] = mul_(cut, root_(sxx));
        extent[1] = mul_(cut, root_(syy));
        F rx = extent[0], ry = extent[1];
        if (rounded) rx = __builtin_elementwise_ceil(rx), ry = __builtin_elementwise_ceil(ry);
        const I small = (I)(rx <= radius_clip) & (I)(ry <= radius_clip);
        const I inside = (I)(x + rx >= 0.0f) & (I)(x - rx <= width) & (I)(y + ry >= 0.0f)
            & (I)(y - ry <= height);
        I fate = inside ? I{} : I{} + OUTSIDE;
        fate = small ? I{} + SMALL : fate;
        fate = faint ? I{} + TRANSPARENT : fate;
        fate = sound ? fate : I{} + NOT_FINITE;
        status = status == 0 ? fate : status;
        seen = (I)(status == 0) & (I)(lane < n);
        auto keep_ = [&](F v, float other) -> F { return seen ? v : splat(other); };
        center[0] = keep_(x, 0.0f);
        center[1] = keep_(y, 0.0f);
        conic[0] = keep_(a, 1.0f);
        conic[1] = keep_(-sxy / syy, 0.0f);
        conic[2] = keep_(1.0f / syy, 1.0f);
        extent[0] = keep_(extent[0], 0.0f);
        extent[1] = keep_(extent[1], 0.0f);
        depth = keep_(z, 0.0f);
        shown = keep_(shown, 0.0f);
    }
    write_((float*)means2d_out.data + 2 * i, 2, n, center);
    write_((float*)conics_out.data + 3 * i, 3, n, conic);
    write_((float*)extents_out.data + 2 * i, 2, n, extent);
    write_(depths_out.data + i, 1, n, &depth);
    write_(opacities_out.data + i, 1, n, &shown);
    if (n == 16) *(I*)(status_out.data + i) = status;
    else
        for (int l = 0; l < n; ++l) status_out.data[i + l] = status[l];
}
"""
)


def _text() -> str:
    text = _PROJECT.replace("FLOOR", f"{COMPENSATION_MIN}f")
    for number, name in enumerate(STATUS_NAMES):
        text = text.replace(name.upper(), str(number))
    return text


@wp.func_native(_text())
def _project_run(
    image: int,
    object: int,
    num: int,
    begin: int,
    end: int,
    colors_per_view: int,
    left: float,
    right: float,
    top: float,
    bottom: float,
    width: float,
    height: float,
    near_plane: float,
    far_plane: float,
    radius_clip: float,
    eps2d: float,
    alpha_min: float,
    antialiased: int,
    rounded: int,
    means: wp.array[wp.vec3],
    quats: wp.array[wp.vec4],
    scales: wp.array[wp.vec3],
    opacities: wp.array[wp.float32],
    colors: wp.array2d[wp.float32],
    viewmats: wp.array[wp.mat44],
    Ks: wp.array[wp.mat33],
    means2d_out: wp.array[wp.vec2],
    conics_out: wp.array[wp.vec3],
    depths_out: wp.array[wp.float32],
    opacities_out: wp.array[wp.float32],
    extents_out: wp.array[wp.vec2],
    status_out: wp.array[wp.int32],
):
    """Projects the Gaussians [begin, end) of an object into an image."""
    ...


@wp.kernel
@no_type_check
def _project_lanes(
    offset: wp.int32,
    views: wp.int32,
    num: wp.int32,
    runs: wp.int32,
    colors_per_view: wp.int32,
    lens: Lens,
    means_in: wp.array[wp.vec3],
    quats_in: wp.array[wp.vec4],
    scales_in: wp.array[wp.vec3],
    opacities_in: wp.array[wp.float32],
    colors_in: wp.array2d[wp.float32],
    viewmats_in: wp.array[wp.mat44],
    Ks_in: wp.array[wp.mat33],
    means2d_out: wp.array[wp.vec2],
    conics_out: wp.array[wp.vec3],
    depths_out: wp.array[wp.float32],
    view_opacities_out: wp.array[wp.float32],
    extents_out: wp.array[wp.vec2],
    status_out: wp.array[wp.int32],
):
    task = offset + wp.tid()
    image = task // runs
    begin = task % runs * _RUN
    K = Ks_in[image]
    x = slope_bounds(K[0, 2], lens.width, K[0, 0])
    y = slope_bounds(K[1, 2], lens.height, K[1, 1])
    _project_run(
        image,
        image // views,
        num,
        begin,
        wp.min(begin + _RUN, num),
        colors_per_view,
        x[0],
        x[1],
        y[0],
        y[1],
        lens.width,
        lens.height,
        lens.near_plane,
        lens.far_plane,
        lens.radius_clip,
        lens.eps2d,
        lens.alpha_min,
        lens.antialiased,
        lens.rounded,
        means_in,
        quats_in,
        scales_in,
        opacities_in,
        colors_in,
        viewmats_in,
        Ks_in,
        means2d_out,
        conics_out,
        depths_out,
        view_opacities_out,
        extents_out,
        status_out,
    )


def project_on_lanes(
    images: int, views: int, num: int, colors_per_view: int, lens: Lens, inputs: list, outputs: list
) -> None:
    """Does what ``project_on_threads`` does, with the same arguments, on the lanes of a CPU."""
    runs = -(-num // _RUN)
    tasks = images * runs
    pieces = min(tasks, _PIECES_PER_THREAD * torch.get_num_threads())
    arguments = [views, num, runs, colors_per_view, lens, *inputs]
    parallel_launch(_project_lanes, tasks, arguments, outputs, pieces=pieces)
