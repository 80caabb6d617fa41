// What does not depend on the state n in the gradient: as in forward.inl, with dy = dout silu(z),
// and for later the slopes of the step and of the gate.
#include "tokens.h"
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
        top = wider_(top, rate);
        token[t] = {rate, step * u, dy, skip * u, F{}, F{}};
        late[t] = {u, slope, gate};
    }
};
if (p.width >= 16 && use_softplus && use_z) prepare(16, true, true);  // usual: compiled by itself
else prepare(p.width, use_softplus, use_z);
tame = tame_(top * widest);
