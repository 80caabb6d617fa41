"""The harmonics as C++ text for a CPU: sixteen Gaussians as the lanes of one SIMD value.

Rows of coefficients are turned, 16 x 16 floats at a time, so that a lane holds those of one
Gaussian; what is computed with them is then arithmetic on lanes, and the gradient is turned back.
README.md §6 of the rasterizer holds the maths.
"""

from .polynomials import SHORTEST, basis_text, slopes_text

CHUNK = 256  # Gaussians of a task; their gradient by a centre is one partial sum
_UNROLLED = 96  # floats of a row up to which its loops are written out


def _turning() -> str:
    """C++ that transposes 16 x 16 floats by exchanging ever smaller squares."""
    steps = []
    for width in (8, 4, 2, 1):
        low = [lane if not lane & width else 16 + lane - width for lane in range(16)]
        high = [lane + width if not lane & width else 16 + lane for lane in range(16)]
        low, high = (", ".join(map(str, side)) for side in (low, high))
        for i in range(16):
            if not i & width:
                a, b = f"r[{i}]", f"r[{i + width}]"
                steps.append(
                    f"{{ const F a = {a}, b = {b};"
                    f" {a} = __builtin_shufflevector(a, b, {low});"
                    f" {b} = __builtin_shufflevector(a, b, {high}); }}"
                )
    return "\n".join(steps)


# A row of coefficients is K * D floats, of which FLOATS are used. Lanes beyond the last Gaussian
# hold the last one again.
_TOOLS = """
    typedef float F __attribute__((vector_size(64), aligned(4)));
    typedef int I __attribute__((vector_size(64), aligned(4)));
    const int COUNT = {count}, D = {channels}, FLOATS = COUNT * D, PADDED = (FLOATS + 15) / 16 * 16;
    const float SHORTEST = {shortest}f;
    auto fma_ = [](F a, F b, F c) -> F {{ return __builtin_elementwise_fma(a, b, c); }};
    auto any_ = [](I mask) -> bool {{ return __builtin_reduce_or(mask) != 0; }};
    // not finite, by the exponent's bits
    auto wild_ = [](F x) -> I {{ return ((I)x & 0x7fffffff) >= 0x7f800000; }};
    auto turn_ = [](F* r) {{ {turning} }};
    const size_t K_D = coefficients.shape[1];
    const float* const stop = coefficients.data + (size_t)coefficients.shape[0] * K_D;
    // turns the rows of ``live`` Gaussians: the i-th float of each becomes into[i]
    auto load_rows_ = [&](const float* row, int live, F* into) {{
        const bool inside = row + (live - 1) * K_D + PADDED <= stop;
        for (int o = 0; o < FLOATS; o += 16) {{
            F r[16];
            for (int j = 0; j < 16; ++j) {{
                const float* const from = row + (j < live ? j : live - 1) * K_D + o;
                if (inside) {{
                    r[j] = *(const F*)from;
                }} else {{
                    float part[16] = {{}};
                    for (int i = 0; i < 16 && o + i < FLOATS; ++i) part[i] = from[i];
                    r[j] = *(const F*)part;
                }}
            }}
            turn_(r);
            for (int i = 0; i < 16; ++i) into[o + i] = r[i];
        }}
    }};
    // from the centre to the means of the lanes: its length, at least SHORTEST, and the direction
    auto direction_ = [&](const float* center, const F* mean, F* t) -> F {{
        for (int i = 0; i < 3; ++i) t[i] = mean[i] - center[i];
        const F square = t[0] * t[0] + t[1] * t[1] + t[2] * t[2];
        const F size = __builtin_elementwise_sqrt(square);
        const F divisor = size > SHORTEST ? size : F{{}} + SHORTEST;
        for (int i = 0; i < 3; ++i) t[i] /= divisor;
        return size;
    }};
    auto basis_ = [&](F x, F y, F z, F* Y) {{ {basis} }};
"""

# From a sum to the result, and which results pass a gradient on: colours above 0, and sums that are
# neither NaN, which says that something was not finite, nor -inf.
_COLORS = """
    auto shown_ = [](F sum) -> F { const F c = sum + 0.5f; return c < 0.0f ? F{} : c; };
    auto passes_ = [](F shown) -> I { return shown > 0.0f; };
"""
_SUMS = """
    auto shown_ = [](F sum) -> F { return sum; };
    auto passes_ = [](F shown) -> I { return shown > -3.4e38f; };
"""

# What each direction does is the body of a loop over groups of Gaussians.
_LOOP = """
    const int chunks = (num + {chunk} - 1) / {chunk};
    const int b = piece / chunks, begin = piece % chunks * {chunk};
    const int end = begin + {chunk} < num ? begin + {chunk} : num;
    for (int first = begin; first < end; first += 16) {{
        const int live = end - first < 16 ? end - first : 16;
        const float* const points = means.data + ((size_t)b * num + first) * 3;
        F mean[3];
        for (int j = 0; j < 16; ++j)
            for (int i = 0; i < 3; ++i) mean[i][j] = points[(j < live ? j : live - 1) * 3 + i];
        {body}
    }}
"""

_FORWARD = """
        F T[PADDED];
        I lost = {};
        for (int i = 0; i < 3; ++i) lost |= wild_(mean[i]);
        for (int view = 0; view < views; ++view) {
            const size_t image = (size_t)b * views + view, at = image * num + first;
            const size_t row = per_view ? at : (size_t)b * num + first;
            if (per_view || view == 0) load_rows_(coefficients.data + row * K_D, live, T);
            F t[3], Y[COUNT], sum[D];
            direction_(centers.data + image * 3, mean, t);
            basis_(t[0], t[1], t[2], Y);
            for (int d = 0; d < D; ++d) sum[d] = Y[0] * T[d];
            UNROLL
            for (int k = 1; k < COUNT; ++k)
                UNROLL
                for (int d = 0; d < D; ++d) sum[d] = fma_(Y[k], T[k * D + d], sum[d]);
            // a coefficient that is not finite leaves a sum that is not; the reverse need not hold
            I bad = lost;
            for (int d = 0; d < D; ++d) bad |= wild_(sum[d]);
            if (any_(bad))
                for (int j = 0; j < live; ++j) {
                    bool finite = !lost[j];
                    for (int i = 0; i < FLOATS; ++i)
                        finite &= __builtin_isfinite(coefficients.data[(row + j) * K_D + i]);
                    bad[j] = finite ? 0 : -1;
                }
            float values[16 * D];
            for (int d = 0; d < D; ++d) {
                const F shown = bad ? F{} + __builtin_nanf("") : shown_(sum[d]);
                for (int j = 0; j < 16; ++j) values[j * D + d] = shown[j];
            }
            __builtin_memcpy(colors.data + at * D, values, (size_t)live * D * 4);
        }
"""

_BACKWARD = """
        F T[PADDED], v_T[PADDED], v_mean[3] = {};
        const bool slopes = COUNT > 1 && (v_means.data || v_centers.data);
        for (int view = 0; view < views; ++view) {
            const size_t image = (size_t)b * views + view, at = image * num + first;
            const size_t row = per_view ? at : (size_t)b * num + first;
            if (slopes && (per_view || view == 0))
                load_rows_(coefficients.data + row * K_D, live, T);
            F v[D];
            I alive = {};
            const float* const values = v_colors.data + at * D;
            for (int d = 0; d < D; ++d) {
                F value = {}, shown = {};
                for (int j = 0; j < live; ++j) {
                    value[j] = values[j * D + d];
                    shown[j] = colors.data[(at + j) * D + d];
                }
                const I passes = passes_(shown);
                v[d] = passes ? value : F{};
                alive |= passes;
            }
            F t[3], Y[COUNT];
            const F size = direction_(centers.data + image * 3, mean, t);
            // what passes no gradient on may hold NaN, which must not meet a zero
            for (int i = 0; i < 3; ++i) t[i] = alive ? t[i] : F{};
            basis_(t[0], t[1], t[2], Y);
            if (v_coefficients.data) {
                if (per_view || view == 0) {
                    UNROLL
                    for (int k = 0; k < COUNT; ++k)
                        UNROLL
                        for (int d = 0; d < D; ++d) v_T[k * D + d] = Y[k] * v[d];
                } else {
                    UNROLL
                    for (int k = 0; k < COUNT; ++k)
                        UNROLL
                        for (int d = 0; d < D; ++d)
                            v_T[k * D + d] = fma_(Y[k], v[d], v_T[k * D + d]);
                }
                if (per_view || view == views - 1)
                    store_rows_(v_coefficients.data + row * K_D, live, v_T);
            }
            if (!slopes) continue;
            F s[COUNT];
            UNROLL
            for (int k = 0; k < COUNT; ++k) {
                s[k] = T[k * D] * v[0];
                UNROLL
                for (int d = 1; d < D; ++d) s[k] = fma_(T[k * D + d], v[d], s[k]);
            }
            F v_t[3] = {};
            slopes_(t[0], t[1], t[2], s, v_t[0], v_t[1], v_t[2]);
            // through the division by the length, which is a constant where it is SHORTEST
            F along = t[0] * v_t[0] + t[1] * v_t[1] + t[2] * v_t[2];
            along = size >= SHORTEST ? along : F{};
            const F divisor = size > SHORTEST ? size : F{} + SHORTEST;
            for (int i = 0; i < 3; ++i) {
                v_t[i] = alive ? (v_t[i] - t[i] * along) / divisor : F{};
                v_mean[i] += v_t[i];
            }
            if (v_centers.data) {
                float* const out = v_centers.data + (image * chunks + piece % chunks) * 3;
                for (int i = 0; i < 3; ++i)
                    out[i] = (first == begin ? 0.0f : out[i]) - total_(v_t[i]);
            }
        }
        if (v_means.data)
            for (int j = 0; j < live; ++j)
                for (int i = 0; i < 3; ++i)
                    v_means.data[((size_t)b * num + first + j) * 3 + i] = v_mean[i][j];
"""

# What the gradient needs beside ``_TOOLS``.
_BACKWARD_TOOLS = """
    auto slopes_ = [&](F x, F y, F z, const F* s, F& v_x, F& v_y, F& v_z) {{ {slopes} }};
    // pairwise, in a fixed order
    auto total_ = [](F x) -> float {{
        float s[16];
        *(F*)s = x;
        for (int w = 8; w > 0; w >>= 1)
            for (int l = 0; l < w; ++l) s[l] += s[l + w];
        return s[0];
    }};
    // the way back from load_rows_, and zeros for the coefficients that are not used
    auto store_rows_ = [&](float* row, int live, const F* from) {{
        for (int o = 0; o < FLOATS; o += 16) {{
            F r[16];
            for (int i = 0; i < 16; ++i) r[i] = from[o + i];
            turn_(r);
            for (int j = 0; j < live; ++j)
                if (o + 16 <= FLOATS) *(F*)(row + j * K_D + o) = r[j];
                else __builtin_memcpy(row + j * K_D + o, r + j, FLOATS % 16 * 4);
        }}
        for (int j = 0; j < live && K_D > FLOATS; ++j)
            __builtin_memset(row + j * K_D + FLOATS, 0, (K_D - FLOATS) * 4);
    }};
"""


def forward_text(degree: int, channels: int, clamped: bool) -> str:
    """C++ that fills the colours, or the bare sums, of a chunk of Gaussians."""
    return _text(_FORWARD, degree, channels, clamped)


def backward_text(degree: int, channels: int, clamped: bool) -> str:
    """C++ of the gradient of ``forward_text``."""
    return _text(_BACKWARD, degree, channels, clamped, _BACKWARD_TOOLS)


def _text(body: str, degree: int, channels: int, clamped: bool, tools: str = "") -> str:
    count = (degree + 1) ** 2
    text = (_TOOLS + tools).format(
        count=count,
        channels=channels,
        shortest=SHORTEST,
        turning=_turning(),
        basis=basis_text(degree),
        slopes=slopes_text(degree),
    )
    unroll = '_Pragma("clang loop unroll(full)")' if count * channels <= _UNROLLED else ""
    text += _COLORS if clamped else _SUMS
    return text + _LOOP.format(chunk=CHUNK, body=body.replace("UNROLL", unroll))
