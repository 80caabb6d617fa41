// Sums the rows of the Gaussians [begin, end) of the order: a row as lanes where it has at most 16
// numbers. What is past the end of a row is not read but for a last row, which is read by number.
#include "lanes.h"

const int moments = absolute.data ? 8 : 6, count = lists.order.shape[0];
const int width = rows.sums.shape[1], channels = width - moments;
const int begin = task * RUN, end = begin + RUN < count ? begin + RUN : count;
const long long all = (long long)rows.sums.shape[0] * width;
for (int j = begin; j < end; ++j) {
    const int i = lists.order.data[j], from = lists.offsets.data[j], to = lists.offsets.data[j + 1];
    float sums[16] = {};
    float* const colors = v.colors.data + (size_t)i * channels;
    if (width <= 16) {
        F sum = F{};
        for (int p = from; p < to; ++p) {
            if (!rows.written.data[p]) continue;
            const float* const row = rows.sums.data + (size_t)p * width;
            if ((long long)p * width + 16 <= all) sum += *(const F*)row;
            else {
                F part = F{};
                for (int c = 0; c < width; ++c) part[c] = row[c];
                sum += part;
            }
        }
        *(F*)sums = sum;
        for (int c = 0; c < channels; ++c) colors[c] = sums[moments + c];
    } else {
        for (int c = 0; c < channels; ++c) colors[c] = 0.0f;
        for (int p = from; p < to; ++p) {
            if (!rows.written.data[p]) continue;
            const float* const row = rows.sums.data + (size_t)p * width;
            for (int c = 0; c < moments; ++c) sums[c] += row[c];
            for (int c = 0; c < channels; ++c) colors[c] += row[moments + c];
        }
    }
    if (!rows.geometry) continue;
    // README eq. 11: moments of h to the gradients; products are stored before they are added
    const float* const conic = (const float*)(splats.conics.data + i);
    const float a = conic[0], k = conic[1], e = conic[2], ak = a * k;
    const float across = ak * sums[1], along = e * sums[2];
    float* const mean = (float*)(v.means2d.data + i);
    mean[0] = a * sums[1];
    mean[1] = across + along;
    float* const v_conic = (float*)(v.conics.data + i);
    v_conic[0] = -0.5f * sums[3];
    v_conic[1] = -a * sums[4];
    v_conic[2] = -0.5f * sums[5];
    v.opacities.data[i] = to > from ? sums[0] / splats.opacities.data[i] : 0.0f;
    if (absolute.data) {  // README eq. 14
        float* const both = (float*)(absolute.data + i);
        both[0] = a * sums[6];
        both[1] = sums[7];
    }
}
