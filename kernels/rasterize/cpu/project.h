// The projection on a CPU: sixteen Gaussians as lanes.
#include "../rows.h"
namespace gamba::raster {

constexpr int WIDTH = 16;
typedef I Mask;  // -1 where true
static inline Mask first(int n) { return lane < n; }
// Unlike max and min, of a number and NaN the number.
static inline F larger(F a, F b) { return __builtin_elementwise_max(a, b); }
static inline F smaller(F a, F b) { return __builtin_elementwise_min(a, b); }
static inline F ceil(F a) { return __builtin_elementwise_ceil(a); }
static inline F log(F a) {  // of all lanes: to ask each costs more than its logarithm
    float logs[WIDTH];
    for (int l = 0; l < WIDTH; ++l) logs[l] = wp::log(a[l]);
    return *(const F*)logs;
}
static inline I load_status(const int* from, int n) {
    I status;
    load<1>(from, n, (F*)&status);
    return status;
}
static inline void store_status(int* to, int n, I status) { store<1>(to, n, (const F*)&status); }

// Takes out the Gaussians whose colours are not finite: 0 times these is NaN.
static inline Mask finite_colors(const float* colors, int channels, int n) {
    const int count = n * channels;
    F whole = F{};
    int c = 0;
    for (; c + 16 <= count; c += 16) whole += *(const F*)(colors + c) * 0.0f;
    float rest = any(whole != 0.0f) ? 1.0f : 0.0f;
    for (; c < count; ++c) rest += colors[c] * 0.0f;
    Mask found = I{} - 1;
    if (rest != 0.0f)
        for (c = 0; c < count; ++c)
            if (colors[c] * 0.0f != 0.0f) found[c / channels] = 0;
    return found;
}

}  // namespace gamba::raster
#include "../project.h"
