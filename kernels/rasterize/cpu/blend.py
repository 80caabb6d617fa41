"""Native inner loops of the CPU compositor: one Gaussian over the 4 x 4 blocks that it touches.

Lanes are the 16 pixels of a block; README.md §3 and §5 hold the maths. Blocks come as a mask, one
bit each. What a worker needs for its tile (sums, upstream gradients) lies in rows of ``room``.
"""

import functools
from types import SimpleNamespace

import warp as wp

from .lanes import TYPES, lanes, lanes_int
from .tuning import Tuning

# alpha of a block's pixels. The exponent is rounded to an integer n by adding 1.5 * 2^23 (+127, the
# bias), 2^rest is a minimax polynomial p of f. ``a`` and ``e`` of the conic come with -log2(e)/2.
_ALPHA = """
    const F U0 = X + Y * shear;
    const F shifter = F{} + 12583039.0f;
    auto alpha_ = [&](F U, F V) -> F {
        F x = fma_(U * a, U, V * V * e);
        x = max_(x, F{} - 126.0f);
        const F n = x + shifter;
        const F f = x - (n - shifter);
        EXP2
        return p * (F)((I)n << 23) * opacity;
    };
"""

# The coefficients of p by degree, those of the highest power first.
_EXP2 = {
    2: (0.23842893540859222, 0.7034479975700378, 1.0004431009292603),
    3: (0.0551716685295105, 0.2426111251115799, 0.6932609677314758, 0.9999280571937561),
    4: (
        9.570102207362652e-3,
        5.591785907745361e-2,
        0.240247443318367,
        0.6931217908859253,
        0.9999992847442627,
    ),
    5: (
        1.32764715e-3,
        9.67554133e-3,
        5.55071327e-2,
        0.240221197,
        0.693146967,
        1.00000007,
    ),
}


def _polynomial(degree: int) -> str:
    """C++ that makes p of f; degree 5 goes in pairs, which is a shorter chain than Horner's."""
    c = [f"(F{{}} + {value!r}f)" for value in _EXP2[degree]]
    if degree < 5:
        steps = "".join(f" p = fma_(p, f, {value});" for value in c[1:])
        return f"F p = {c[0]};{steps}"
    high, middle, low = (f"fma_({c[i]}, f, {c[i + 1]})" for i in (0, 2, 4))
    return f"const F f2 = f * f; const F p = fma_(fma_({high}, f2, {middle}), f2, {low});"


def _text(body: str, tuning: Tuning) -> str:
    columns = tuning.columns
    body = TYPES + _ALPHA.replace("EXP2", _polynomial(tuning.degree)) + body
    return body.replace("SHIFT", str(columns.bit_length() - 1)).replace("MASK", str(columns - 1))


# A pixel that has stopped keeps its transmittance, above t_min, with a minus sign. T itself is not
# chosen by a mask: that would become a masked store, and the next load would have to wait for it.
_BLEND = """
    F* const Ts = (F*)transmittances.data + first;
    I* const ends = (I*)stops.data + first;
    F* const sums = (F*)room.data + (size_t)worker * room.shape[1];
    const int channels = colors.shape[1];
    const float* const color = colors.data + (size_t)row * channels;
    unsigned used = 0, dead = 0;
    while (bits) {
        const int b = __builtin_ctz(bits);
        bits &= bits - 1;
        const float y = dy + (float)(b >> SHIFT << 2), x = dx + (float)((b & MASK) << 2);
        const F T = Ts[b];
        F alpha = alpha_(U0 + (x + shear * y), Y + y);
        alpha = ((alpha >= alpha_min) & (T > 0.0f)) ? min_(alpha, F{} + alpha_max) : F{};
        const F next = T - T * alpha;
        const I stays = max_(next, -next) > t_min;
        const F weight = stays ? T * alpha : F{};
        Ts[b] = stays ? next : -T;
        // there is no branch on a weight above 0: the processor would often predict it wrongly
        used |= (unsigned)any_(weight > 0.0f) << b;
        F* const sum = sums + b * channels;
        if (channels == 3)
            for (int c = 0; c < 3; ++c) sum[c] = fma_(weight, F{} + color[c], sum[c]);
        else
            for (int c = 0; c < channels; ++c) sum[c] = fma_(weight, F{} + color[c], sum[c]);
        if (!all_(stays)) {
            ends[b] = stays ? ends[b] : I{} + k;
            if (!any_(Ts[b] > 0.0f)) dead |= 1u << b;
        }
    }
    return (int)(used | dead << 16);
"""


# Accumulators stay in registers over the blocks; the totals go to the pair's row.
_UNBLEND = """
    const I* const ends = (const I*)stops.data + first;
    const int channels = colors.shape[1];
    F* const mine = (F*)room.data + (size_t)worker * room.shape[1];
    F *const Ts = mine, *const Rs = mine + 16, *const v_colors = mine + 32;
    const F* const v_sums = v_colors + channels;
    const float* const color = colors.data + (size_t)row * channels;
    F h0 = {}, hu = {}, hy = {}, huu = {}, huy = {}, hyy = {};
    for (int c = 0; c < channels; ++c) v_colors[c] = F{};
    while (bits) {
        const int b = __builtin_ctz(bits);
        bits &= bits - 1;
        const float y = dy + (float)(b >> SHIFT << 2), x = dx + (float)((b & MASK) << 2);
        const F U = U0 + (x + shear * y), V = Y + y;
        F alpha = alpha_(U, V);
        alpha = ((alpha >= alpha_min) & (ends[b] > k)) ? min_(alpha, F{} + alpha_max) : F{};
        const F T = Ts[b] / (1.0f - alpha);
        Ts[b] = T;
        const F weight = T * alpha;
        const F* const v = v_sums + b * (channels + 1);
        F s = v[channels];
        for (int c = 0; c < channels; ++c) {
            s = fma_(v[c], F{} + color[c], s);
            v_colors[c] = fma_(weight, v[c], v_colors[c]);
        }
        if (geometry) {
            const F diff = s - Rs[b];
            Rs[b] = fma_(alpha, diff, Rs[b]);
            const F h = alpha < alpha_max ? weight * diff : F{};
            const F u = h * U, w = h * V;
            h0 += h;
            hu += u;
            hy += w;
            huu = fma_(u, U, huu);
            huy = fma_(u, V, huy);
            hyy = fma_(w, V, hyy);
        }
    }
    float* const out = v_pairs.data + (size_t)pair * v_pairs.shape[1];
    out[0] = total_(h0);
    out[1] = total_(hu);
    out[2] = total_(hy);
    out[3] = total_(huu);
    out[4] = total_(huy);
    out[5] = total_(hyy);
    for (int c = 0; c < channels; ++c) out[6 + c] = total_(v_colors[c]);
"""


@functools.cache
def blend_leaves(tuning: Tuning) -> SimpleNamespace:
    """The leaves ``blend`` and ``unblend`` of a tuning."""

    @wp.func_native(_text(_BLEND, tuning))
    def blend(
        bits: wp.int32,
        k: wp.int32,
        dx: wp.float32,
        dy: wp.float32,
        shear: wp.float32,
        a: wp.float32,
        e: wp.float32,
        opacity: wp.float32,
        alpha_min: wp.float32,
        alpha_max: wp.float32,
        t_min: wp.float32,
        colors: wp.array2d[wp.float32],
        row: wp.int32,
        first: wp.int32,
        worker: wp.int32,
        transmittances: wp.array[lanes],
        stops: wp.array[lanes_int],
        room: wp.array2d[lanes],
    ) -> wp.int32:
        """Blends pair k into the blocks of ``bits``; ``dx, dy`` lead from its centre to the tile.

        Transmittances and stops of the tile's blocks begin at ``first``; ``room[worker]`` holds the
        colour sums. Returns the blocks it contributed to, and in the upper half those it ended.
        """
        ...

    @wp.func_native(_text(_UNBLEND, tuning))
    def unblend(
        bits: wp.int32,
        k: wp.int32,
        geometry: wp.int32,
        dx: wp.float32,
        dy: wp.float32,
        shear: wp.float32,
        a: wp.float32,
        e: wp.float32,
        opacity: wp.float32,
        alpha_min: wp.float32,
        alpha_max: wp.float32,
        colors: wp.array2d[wp.float32],
        row: wp.int32,
        first: wp.int32,
        worker: wp.int32,
        stops: wp.array[lanes_int],
        room: wp.array2d[lanes],
        pair: wp.int32,
        v_pairs: wp.array2d[wp.float32],
    ):
        """Takes pair k back out of the blocks of ``bits``; its gradient sums go to row ``pair``.

        ``room[worker]`` holds 16 transmittances, 16 values R behind, C accumulators, and for each
        block the C + 1 upstream gradients. Without ``geometry`` the first six sums are 0.
        """
        ...

    return SimpleNamespace(blend=blend, unblend=unblend)
