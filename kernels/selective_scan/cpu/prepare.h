// needs: kernels.py: SCALE; lanes.h: read_, decay_, softplus_of_, sigmoid_, softplus_, max_abs_;
//     sixteen.inl: F, splat, fma_; task.h: Position; strip.h: Token, PerToken, Group, Fetches,
//     lanes_, read_soon_
// gives: prepare_
// The part of the gradient that does not depend on the state n: as in forward.inl, with
// dy = dout silu(z), and the slopes of the step and of the gate. Returns the largest |rate|.
auto prepare_ = [&](const auto& sizes, const Position& p, const Group& group, auto& u_in,
                    auto& delta_in, auto& z_in, auto& dout_in, Token* token, PerToken* per_token,
                    Fetches& fetches) __attribute__((always_inline)) -> F {
    read_soon_(fetches, delta_in, p), read_soon_(fetches, u_in, p);
    read_soon_(fetches, dout_in, p);
    if (sizes.use_z) read_soon_(fetches, z_in, p);
    F max_rate = F{};
    auto prepare = [&](int width, bool use_softplus, bool use_z) __attribute__((always_inline)) {
        const auto us = lanes_(u_in, p, width, token[0].du);
        const auto deltas = lanes_(delta_in, p, width, token[0].rate);
        const auto zs = lanes_(z_in, p, width, token[0].y, use_z);
        const auto douts = lanes_(dout_in, p, width, token[0].dy);
        for (int t = 0; t < p.count; ++t) {
            F step = read_(deltas, t) + group.bias, slope = splat(1.0f), dy = read_(douts, t),
              gate = F{};
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
            token[t] = {rate, step * u, dy, group.skip * u, F{}, F{}};
            per_token[t] = {u, slope, gate};
        }
    };
    // the usual case: compiled separately
    if (p.width >= 16 && sizes.use_softplus && sizes.use_z) prepare(16, true, true);
    else prepare(p.width, sizes.use_softplus, sizes.use_z);
    return max_rate;
};
