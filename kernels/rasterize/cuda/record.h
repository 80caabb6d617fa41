// A Gaussian's record, which the CUDA compositor reads 16 bytes at a time: a shape, a level, and
// the colours in chunks.
namespace gamba::raster {

constexpr int CHUNK = 4;                       // channels of a chunk, as in tiles.py
constexpr float LOG2_E_HALF = 0.72134752044f;  // exp(-q/2) = 2^(-this q)

// a and e are README §1's times -log2(e)/2.
struct alignas(16) Shape {
    float x, y, a, k;
};
// The limit of q is README §1's times log2(e)/2, and top is y* of eq. 6.
struct alignas(16) Level {
    float e, log2_opacity, limit, top;
};
// A chunk of colours, or four numbers of a row of sums.
struct alignas(16) Four {
    float of[CHUNK];
};

}  // namespace gamba::raster
