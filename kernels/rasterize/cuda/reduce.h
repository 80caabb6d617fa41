// The kernel that adds up the rows of each Gaussian, one of a thread, in the order of its pairs.
#include "record.h"
namespace gamba::raster {

// The sums of the rows of pairs [begin, end), of the columns of a chunk: eight of heads, and of
// tails as many as there are.
template<class Rows>
static inline void add_columns(
    const Rows& rows, int begin, int end, int head_at, int tail_at, int tails, float (&sums)[12]) {
    for (int p = begin; p < end; ++p) {
        if (!(rows.written.data[p >> 5] >> (p & 31) & 1)) continue;
        const float* const head = rows.heads.data + (size_t)p * rows.heads.shape[1] + head_at;
        const float* const tail = rows.tails.data + (size_t)p * rows.tails.shape[1] + tail_at;
        const Four low = *(const Four*)head, high = *(const Four*)(head + 4);
        for (int c = 0; c < 4; ++c) {
            sums[c] += low.of[c];
            sums[4 + c] += high.of[c];
            sums[8 + c] += c < tails ? tail[c] : 0.0f;
        }
    }
}

// The gradients of the j-th Gaussian of the lists. A chunk has six moments, two sums of absolute
// values if they are asked for, and colours.
template<class In, class Out>
static void add_rows(int j, const In& in, const Out& out) {
    const int i = in.order.data[j], begin = in.offsets.data[j], end = in.offsets.data[j + 1];
    const int channels = out.v_colors.shape[1];
    const bool absolute = out.absolute.data;
    float* const v_colors = out.v_colors.data + (size_t)i * channels;
    float moments[8] = {};
    for (int first = 0, tail_at = 0; first < channels; first += CHUNK) {
        const int rest = channels - first;
        const int tails = (rest < CHUNK ? rest : CHUNK) - (absolute ? 0 : 2);
        float sums[12] = {};
        add_columns(in.rows, begin, end, 2 * first, tail_at, tails, sums);
        tail_at += tails;
        for (int c = 0; c < 8; ++c) moments[c] += sums[c];
        for (int c = 0; c < CHUNK; ++c)
            if (c < rest) v_colors[first + c] = absolute ? sums[8 + c] : sums[6 + c];
    }
    if (!out.v_splats.means2d.data) return;
    // README eq. 11: moments of h to the gradients
    const auto [h, hu, hy, huu, huy, hyy, abs_u, abs_y] = moments;
    const wp::vec3 conic = in.splats.conics.data[i];
    const float a = conic[0], k = conic[1], e = conic[2];
    out.v_splats.means2d.data[i] = {a * hu, a * k * hu + e * hy};
    out.v_splats.conics.data[i] = {-0.5f * huu, -a * huy, -0.5f * hyy};
    const bool drawn = begin != end;
    out.v_splats.view_opacities.data[i] = drawn ? h / in.splats.view_opacities.data[i] : 0.0f;
    // README eq. 14; the compositor's second sum has a factor
    if (absolute) out.absolute.data[i] = {a * abs_u, abs_y / LOG2_E_HALF};
}

}  // namespace gamba::raster
