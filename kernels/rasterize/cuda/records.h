// The kernel that writes the records of all Gaussians. Config, from records.py: the slack of the
// limit.
#include "ellipse.h"
#include "record.h"
namespace gamba::raster {

// The record of view-major Gaussian g.
template<class Config, class Params, class Splats>
static void record(
    int g, const Params& params, const Splats& splats, const wp::array_t<float>& records) {
    const Ellipse ellipse = ellipse_of<Config>(splats, g, params.alpha_min, {});
    const float a = splats.conics.data[g][0], opacity = splats.view_opacities.data[g];
    float* const to = records.data + (size_t)g * records.shape[1];
    *(Shape*)to = {ellipse.x, ellipse.y, -LOG2_E_HALF * a, ellipse.k};
    *(Level*)(to + 4) = {
        -LOG2_E_HALF * ellipse.e, wp::log2(opacity), LOG2_E_HALF * ellipse.limit, ellipse.top};
    int row = g;  // of the colours; shared ones have one for each object's Gaussian
    if (!params.colors_per_view)
        row = g / (params.views * params.num) * params.num + g % params.num;
    const int channels = splats.colors.shape[1];
    const float* const colors = splats.colors.data + (size_t)row * channels;
    for (int first = 0; first < channels; first += CHUNK) {
        Four color = {};
        for (int c = 0; c < CHUNK; ++c)
            if (first + c < channels) color.of[c] = colors[first + c];
        *(Four*)(to + 8 + first) = color;
    }
}

}  // namespace gamba::raster
