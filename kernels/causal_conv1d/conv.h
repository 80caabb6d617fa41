// The causal convolution for both devices; equations of README.md. A value F is WIDTH channels:
// sixteen lanes on a CPU (conv_cpu.h), four numbers on CUDA (conv_cuda.h). Config, from kernels.py:
// TOKENS of a task, RUN (tokens whose sums are added one after the other, or 0 for all), and AHEAD,
// tokens whose loads a CUDA thread has under way, or 0.
namespace gamba::conv {

template<class T>
using Array = wp::array_t<T>;

// Tokens t0 to before end of a sequence, which has begin to before stop of row b. A piece of packed
// rows may have no token; its sequence is -1.
struct Piece {
    int b, sequence, begin, stop, t0, end;
};
template<int TOKENS>
static inline Piece piece_of(int task, const Array<int>& pieces, int length) {
    Piece p;
    if (pieces.shape[0] > 0) {
        const int* const own = pieces.data + (size_t)task * 5;
        p = {own[0], own[4], own[1], own[2], own[3], 0};
    } else {
        const int count = (length + TOKENS - 1) / TOKENS;  // of a sequence
        p = {task / count, task / count, 0, length, task % count * TOKENS, 0};
    }
    p.end = p.t0 + TOKENS < p.stop ? p.t0 + TOKENS : p.stop;
    return p;
}

// The taps and the bias of WIDTH channels.
struct Filter {
    F w0, w1, w2, w3, bias;
    F operator()(F x0, F x1, F x2, F x3) const {
        return fma(w0, x0, fma(w1, x1, fma(w2, x2, fma(w3, x3, bias))));
    }
};
template<class Weights, class Biases>
static inline Filter filter_of(int k, const Weights& weight, const Biases& bias) {
    const F* const w = (const F*)weight.data + k;
    const size_t taps = weight.shape[1];
    return {w[0], w[taps], w[2 * taps], w[3 * taps], ((const F*)bias.data)[k]};
}

// The last three tokens.
struct Window {
    F x0 = F{}, x1 = F{}, x2 = F{};
    void push(F x) { x0 = x1, x1 = x2, x2 = x; }
};
// Those before a piece, of the initial state where the sequence begins.
template<class X, class State>
static inline Window window_before(const Piece& p, const X& x, const State& state, bool has_state) {
    Window last;
    for (int t = p.t0 - 3; t < p.t0; ++t) {
        last.x0 = last.x1, last.x1 = last.x2;
        if (t >= p.begin) last.x2 = read(x, t);
        else if (has_state) last.x2 = read(state, t - p.begin + 3);
    }
    return last;
}

// Equation 1 for a piece of tokens.
template<class Config, class In, class Out>
static void forward(int task, int k, const In& in, const Out& out) {
    const Piece p = piece_of<Config::TOKENS>(task, in.pieces, in.x.shape[1]);
    if (p.sequence < 0) return;
    const int d = k * WIDTH, width = in.x.shape[2] - d < WIDTH ? in.x.shape[2] - d : WIDTH;
    const auto x = rows_from(in.x, p.b, 0, d, width), y = rows_from(out.y, p.b, 0, d, width);
    const auto state = rows_from(in.state, p.sequence, 0, d, width);
    const Filter filter = filter_of(k, in.weight, in.bias);
    Window last = window_before(p, x, state, in.state.shape[1] > 0);
    auto step = [&](int t, F x3, const auto& y) {
        F v = filter(last.x0, last.x1, last.x2, x3);
        if (in.use_silu) v = v * sigmoid(v);
        put(y, t, v, in.stream);
        last.push(x3);
    };
    int t = p.t0;
    if constexpr (Config::AHEAD > 0)
        if (x.whole && y.whole) {
            auto x_whole = x, y_whole = y;  // so that the compiler knows
            x_whole.whole = y_whole.whole = true;
            // No load can pass a store, which might write its address: so some tokens' come first.
            for (; t + Config::AHEAD <= p.end; t += Config::AHEAD) {
                F ahead[Config::AHEAD];
#pragma unroll
                for (int i = 0; i < Config::AHEAD; ++i) ahead[i] = read(x_whole, t + i);
#pragma unroll
                for (int i = 0; i < Config::AHEAD; ++i) step(t + i, ahead[i], y_whole);
            }
        }
    for (; t < p.end; ++t) {
        const F x3 = read(x, t);
        prefetch_right(x, t);
        step(t, x3, y);
    }
    if (in.stream && d + WIDTH >= in.x.shape[2]) finish_stores();  // the last of a row of tasks
}

// Equation 2 for a piece of tokens, of rows x, dout and dx, which are the tensors' or copies of
// them; prefetch(t) loads what the next task reads. Returns the sums for the weight and the bias in
// ``sums``. dx of token t needs the gradients g of t to t + 3: the loop is three tokens behind.
template<class Config, class X, class G, class State, class Prefetch>
static inline void gradient(const Piece& p, const Filter& filter, Window last, bool use_silu,
    const X& x, const G& dout, bool need_dx, const G& dx, bool need_dstate, const State& dstate,
    Prefetch prefetch, F (&sums)[5]) {
    const F one = F{} + 1.0f;
    F g0 = F{}, g1 = F{}, g2 = F{}, run[5] = {};
    auto complete = [&] {
        for (int i = 0; i < 5; ++i) sums[i] = sums[i] + run[i], run[i] = F{};
    };
    auto step = [&](int t, F x3, F g3, bool inside, bool own, const G& dx) {
        if (inside) {
            if (use_silu) {
                const F y = filter(last.x0, last.x1, last.x2, x3), s = sigmoid(y);
                g3 = g3 * fma(y * s, one - s, s);
            }
            if (own) {
                run[0] = fma(g3, last.x0, run[0]), run[1] = fma(g3, last.x1, run[1]);
                run[2] = fma(g3, last.x2, run[2]), run[3] = fma(g3, x3, run[3]);
                run[4] = run[4] + g3;
            }
        }
        const F v = fma(filter.w3, g0, fma(filter.w2, g1, fma(filter.w1, g2, filter.w0 * g3)));
        if (t - 3 >= p.t0) {
            if (need_dx) write(dx, t - 3, v);
        } else if (t - p.begin < 3 && need_dstate) write(dstate, t - p.begin, v);
        last.push(x3);
        g0 = g1, g1 = g2, g2 = g3;
        if (Config::RUN > 0 && (t - p.t0) % Config::RUN == Config::RUN - 1) complete();
    };
    int t = p.t0;
    if constexpr (Config::AHEAD > 0)
        if (x.whole && dout.whole && dx.whole) {  // as in the forward; and the compiler is told
            X x_whole = x;
            G dout_whole = dout, dx_whole = dx;
            x_whole.whole = dout_whole.whole = dx_whole.whole = true;
            for (; t + Config::AHEAD <= p.end; t += Config::AHEAD) {
                F xs[Config::AHEAD], gs[Config::AHEAD];
#pragma unroll
                for (int i = 0; i < Config::AHEAD; ++i)
                    xs[i] = read(x_whole, t + i), gs[i] = read(dout_whole, t + i);
#pragma unroll
                for (int i = 0; i < Config::AHEAD; ++i)
                    step(t + i, xs[i], gs[i], true, true, dx_whole);
            }
        }
    for (; t < p.end + 3; ++t) {
        F x3 = last.x2, g3 = F{};
        if (t < p.stop) {
            x3 = read(x, t), g3 = read(dout, t);
            prefetch(t);
        }
        step(t, x3, g3, t < p.stop, t < p.end, dx);
    }
    complete();
}

// The sums of a task, [task, taps and bias, k].
template<class Sums>
static inline void store_sums(int task, int k, int taps, const F (&sums)[5], const Sums& dweight) {
    F* const at = (F*)dweight.data + (size_t)task * 5 * taps + k;
    if (dweight.shape[1] > 0)
        for (int i = 0; i < 5; ++i) at[(size_t)i * taps] = sums[i];
}

// Equation 2.
template<class Config, class In, class Out>
static void backward(int task, int k, const In& in, const Out& out) {
    const Piece p = piece_of<Config::TOKENS>(task, in.pieces, in.x.shape[1]);
    if (p.sequence < 0) return;
    const int d = k * WIDTH, width = in.x.shape[2] - d < WIDTH ? in.x.shape[2] - d : WIDTH;
    const auto x = rows_from(in.x, p.b, 0, d, width), dout = rows_from(in.dout, p.b, 0, d, width);
    const auto state = rows_from(in.state, p.sequence, 0, d, width);
    const auto dx = rows_from(out.dx, p.b, 0, d, width);
    const auto dstate = rows_from(out.dstate, p.sequence, 0, d, width);
    const Window last = window_before(p, x, state, in.state.shape[1] > 0);
    auto prefetch = [&](int t) { prefetch_right(x, t), prefetch_right(dout, t); };
    F sums[5] = {};
    gradient<Config>(p, filter_of(k, in.weight, in.bias), last, in.use_silu, x, dout,
        out.dx.shape[1] > 0, dx, out.dstate.shape[1] > 0, dstate, prefetch, sums);
    store_sums(task, k, in.weight.shape[1], sums, out.dweight);
}

}  // namespace gamba::conv
