// The loops worth compiling per instruction set, and the table that chooses between the copies.
#pragma once

#include "types.hpp"

namespace splat {

constexpr int kBlurRadius = 5;

static constexpr std::int64_t blur_scratch(int width, int height) {
    return static_cast<std::int64_t>(width) * height + 2 * width + 2 * kBlurRadius;
}

struct AdamRates {
    float rate, beta1, beta2, epsilon;
    float correction1, correction2;  // 1 - beta^step
};

struct Kernels {
    const char* name;
    void (*project)(const Splats&, const Camera&, const Settings&, Projected*, int begin, int end);
    void (*unproject_gradients)(const Splats&, const Camera&, const Projected&,
                                const float* pair_sums, const SplatGradients&, int index);
    // Returns how many of the job's Gaussians were drawn before the tile was opaque.
    int (*draw_tile)(const Projected*, const TileJob&, const Camera&, const Settings&,
                     float* planes);
    void (*draw_tile_gradients)(const Projected*, const TileJob&, const Camera&, const Settings&,
                                const float* planes, const float* plane_gradients,
                                float* pair_gradients);
    // Separable 11-tap Gaussian window over one plane, zero outside.
    // ``scratch`` holds blur_scratch(width, height) floats.
    void (*blur)(const float* in, float* out, float* scratch, int width, int height);
    // Structural similarity of two planes: returns its sum and fills the three gradient maps.
    double (*similarity)(const float* mean_x, const float* mean_y, const float* mean_xx,
                         const float* mean_yy, const float* mean_xy, float* d_mean_x,
                         float* d_mean_xx, float* d_mean_xy, int count);
    void (*adam)(float* values, const float* gradients, float* first, float* second,
                 const AdamRates&, int count);
};

namespace base {
extern const Kernels kernels;
}
#ifdef SPLAT_HAS_V3
namespace v3 {
extern const Kernels kernels;
}
#endif

}  // namespace splat
