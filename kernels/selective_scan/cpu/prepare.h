// needs: kernels.py: sizes, delta_in, u_in, dout_in, z_in, SCALE; lanes.h: F, read_, splat, decay_,
//     fma_, softplus_of_, sigmoid_, softplus_, max_abs_, in_range_; gather.inl: p
// gives: use_z, prepare
// The part of the gradient that does not depend on the state n: as in forward.inl, with
// dy = dout silu(z), and the slopes of the step and of the gate.
#include "strip.h"
const bool use_z = sizes.use_z;
read_soon_(delta_in), read_soon_(u_in), read_soon_(dout_in);
if (use_z) read_soon_(z_in);
auto prepare = [&](int width, bool use_softplus, bool use_z) __attribute__((always_inline)) {
    const auto us = here_(u_in, width);
    const auto deltas = here_(delta_in, width);
    const auto zs = here_(z_in, width);
    const auto douts = here_(dout_in, width);
    for (int t = 0; t < count; ++t) {
        F step = read_(deltas, t) + bias, slope = splat(1.0f), dy = read_(douts, t), gate = F{};
        if (use_softplus && use_z) {  // both slopes with one division
            const F z = read_(zs, t), e = decay_(step), ez = decay_(z);
            const F ds = e + 1.0f, dz = ez + 1.0f, r = 1.0f / (ds * dz);
            const F sig = (z < 0.0f ? ez : splat(1.0f)) * (ds * r), silu = z * sig;
            gate = dy * fma_(silu, 1.0f - sig, sig);
            dy *= silu;
            slope = (step < 0.0f ? e : splat(1.0f)) * (dz * r);
            step = softplus_of_(step, e / (e + 2.0f));  // as in the forward, to the last bit
        } else {
            if (use_z) {
                const F z = read_(zs, t), sig = sigmoid_(z), silu = z * sig;
                gate = dy * fma_(silu, 1.0f - sig, sig);
                dy *= silu;
            }
            if (use_softplus) {
                slope = sigmoid_(step);
                step = softplus_(step);
            }
        }
        const F u = read_(us, t), rate = step * SCALE;
        max_rate = max_abs_(max_rate, rate);
        token[t] = {rate, step * u, dy, skip * u, F{}, F{}};
        per_token[t] = {u, slope, gate};
    }
};
if (p.width >= 16 && use_softplus && use_z) prepare(16, true, true);  // usual: compiled by itself
else prepare(p.width, use_softplus, use_z);
in_range = in_range_(max_rate * max_a);
