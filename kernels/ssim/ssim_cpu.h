// 1 - SSIM and its gradient on a CPU, sixteen adjacent numbers of a row at a time. Four kernels in
// the order of their launches: across, down, up, back. README.md has the formulas.
// Images are [P, H, E], E = W * C. Maps between two launches have their rows side by side: row 4 y
// + i is map i of row y, and 3 y + i where there are three.
#include "../runtime/sixteen.h"
namespace gamba::ssim {

typedef wp::array_t<float> Rows;
constexpr int TAPS = 11;  // of the window, exp(-(k - 5)² / (2 · 1.5²)) over their sum
constexpr float weights[TAPS] = {0.00102838008447911f, 0.007598758135239185f, 0.03600077212843083f,
    0.10936068950970002f, 0.2130055377112537f, 0.26601172486179436f, 0.2130055377112537f,
    0.10936068950970002f, 0.03600077212843083f, 0.007598758135239185f, 0.00102838008447911f};
constexpr int EDGE = TAPS - 1;
constexpr float TWO_C1 = 2e-4f, TWO_C2 = 1.8e-3f;  // C1 = .01², C2 = .03²

// Sixteen numbers of each row of E, or fewer at its end.
struct Lanes {
    int first, width;
    Lanes(int group, int E) : first(group * 16), width(E - first < 16 ? E - first : 16) {}
    float* at(const Rows& rows, int image, int y) const {
        return (float*)((char*)rows.data + (size_t)image * rows.strides[0]
                   + (size_t)y * rows.strides[1])
            + first;
    }
    F read(const float* p) const {
        if (width >= 16) return *(const F*)p;
        F v = F{};
        for (int i = 0; i < width; ++i) v[i] = p[i];
        return v;
    }
    F read(const Rows& rows, int image, int y) const { return read(at(rows, image, y)); }
    void write(float* p, F v) const {
        if (width >= 16) *(F*)p = v;
        else
            for (int i = 0; i < width; ++i) p[i] = v[i];
    }
    void write(const Rows& rows, int image, int y, F v) const { write(at(rows, image, y), v); }
};

// The four maps' means along a row of two images: hor [P, 4 H, E - 10 C].
template<class Maps>
static void across(int task, int group, const Maps& maps) {
    const int height = maps.got.shape[1], channels = maps.channels;
    const int image = task / height, y = task % height;
    const Lanes lanes(group, maps.hor.shape[2]);
    const float *a = lanes.at(maps.got, image, y), *b = lanes.at(maps.want, image, y);
    F s0 = F{}, s1 = F{}, s2 = F{}, s3 = F{};
    const F m = lanes.read(maps.shift, image, 0);  // the same for each tap: it has the same channel
#pragma unroll
    for (int k = 0; k < TAPS; ++k) {
        const F x = lanes.read(a + k * channels), y = lanes.read(b + k * channels);
        const F s = x + y - m, d = x - y, w = splat(weights[k]);
        s0 = fma(w, s, s0);
        s1 = fma(w, d, s1);
        s2 = fma(w, s * s, s2);
        s3 = fma(w, d * d, s3);
    }
    lanes.write(maps.hor, image, 4 * y, s0);
    lanes.write(maps.hor, image, 4 * y + 1, s1);
    lanes.write(maps.hor, image, 4 * y + 2, s2);
    lanes.write(maps.hor, image, 4 * y + 3, s3);
}

// Means along columns, the values of ROWS rows of windows, and the parts of the slope:
// values [P, strips, E - 10 C], each the sum of its rows, and by [P, 3 (H - 10), E - 10 C].
template<int ROWS, class Maps>
static void down(int task, int group, const Maps& maps) {
    const int rows = maps.hor.shape[1] / 4 - EDGE, strips = maps.values.shape[1];
    const int image = task / strips, strip = task % strips;
    const Lanes lanes(group, maps.hor.shape[2]);
    F total = F{};
    for (int y = strip * ROWS; y < (strip + 1) * ROWS && y < rows; ++y) {
        F s0 = F{}, d0 = F{}, s2 = F{}, d2 = F{};
#pragma unroll
        for (int k = 0; k < TAPS; ++k) {
            const F w = splat(weights[k]);
            s0 = fma(w, lanes.read(maps.hor, image, 4 * (y + k)), s0);
            d0 = fma(w, lanes.read(maps.hor, image, 4 * (y + k) + 1), d0);
            s2 = fma(w, lanes.read(maps.hor, image, 4 * (y + k) + 2), s2);
            d2 = fma(w, lanes.read(maps.hor, image, 4 * (y + k) + 3), d2);
        }
        const F s = s0 + lanes.read(maps.shift, image, 0);
        const F bright = s * s + TWO_C1, dark = d0 * d0;
        const F rough = s2 - s0 * s0 + TWO_C2, odd = d2 - d0 * d0;
        const F one = splat(1.0f), p = one / (bright + dark), q = one / (rough + odd);
        // the share that dark and odd have, of which light = 1 - 2 unlit and shape = 1 - 2 unlike
        const F unlit = dark * p, unlike = odd * q;
        const F light = one - 2.0f * unlit, shape = one - 2.0f * unlike;
        if (maps.by.data) {
            const F f = light * q * q * (2.0f * maps.scale);
            const F by1 = -f * odd, by2 = f * rough;
            const F by0 = (shape * p * p * (-4.0f * maps.scale)) * (dark * s - bright * d0);
            lanes.write(maps.by, image, 3 * y, by0 - 2.0f * (by1 * s0 + by2 * d0));
            lanes.write(maps.by, image, 3 * y + 1, by1);
            lanes.write(maps.by, image, 3 * y + 2, by2);
        }
        total = total + 2.0f * (unlit + unlike - 2.0f * unlit * unlike);
    }
    lanes.write(maps.values, image, strip, total);
}

// Transposed means along columns: col [P, 3 H, E + 10 C], padded on both sides.
template<class Maps>
static void up(int task, int group, const Maps& maps) {
    const int rows = maps.by.shape[1] / 3, height = rows + EDGE;
    const int image = task / height, y = task % height, edge = EDGE * maps.channels;
    const int first = y < EDGE ? 0 : y - EDGE, last = y < rows ? y : rows - 1;
    const Lanes lanes(group, maps.by.shape[2]);
    F v0 = F{}, v1 = F{}, v2 = F{};
    for (int t = first; t <= last; ++t) {
        const F w = splat(weights[y - t]);
        v0 = fma(w, lanes.read(maps.by, image, 3 * t), v0);
        v1 = fma(w, lanes.read(maps.by, image, 3 * t + 1), v1);
        v2 = fma(w, lanes.read(maps.by, image, 3 * t + 2), v2);
    }
    lanes.write(lanes.at(maps.col, image, 3 * y) + edge, v0);
    lanes.write(lanes.at(maps.col, image, 3 * y + 1) + edge, v1);
    lanes.write(lanes.at(maps.col, image, 3 * y + 2) + edge, v2);
}

// The slope [P, H, E], from transposed means along a row.
template<class Maps>
static void back(int task, int group, const Maps& maps) {
    const int height = maps.got.shape[1], channels = maps.channels;
    const int image = task / height, y = task % height;
    const Lanes lanes(group, maps.got.shape[2]);
    const float* const cols[3] = {lanes.at(maps.col, image, 3 * y),
        lanes.at(maps.col, image, 3 * y + 1), lanes.at(maps.col, image, 3 * y + 2)};
    F b0 = F{}, b1 = F{}, b2 = F{};
#pragma unroll
    for (int k = 0; k < TAPS; ++k) {
        const F w = splat(weights[k]);
        b0 = fma(w, lanes.read(cols[0] + k * channels), b0);
        b1 = fma(w, lanes.read(cols[1] + k * channels), b1);
        b2 = fma(w, lanes.read(cols[2] + k * channels), b2);
    }
    const F a = lanes.read(maps.got, image, y), b = lanes.read(maps.want, image, y);
    const F s = a + b - lanes.read(maps.shift, image, 0), d = a - b;
    lanes.write(maps.slope, image, y, b0 + 2.0f * (s * b1 + d * b2));
}

}  // namespace gamba::ssim
