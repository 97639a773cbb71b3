// The loops worth compiling per instruction set, and the table that chooses between the copies.
#pragma once

#include "types.hpp"

namespace splat {

constexpr int kBlurRadius = 5;

constexpr int kStripColumns = 96;  // of an image whose similarity is taken at once
constexpr int kStripRow = kStripColumns + 4 * kBlurRadius + 28;  // with borders and whole vectors

struct AdamRates {
    float rate, beta1, beta2, epsilon;
    float correction1, correction2;  // 1 - beta^step
};

// Channels of all Gaussians that are drawn together.
struct FeatureBlock {
    const float* values;  // channel of the first Gaussian
    std::int64_t stride;  // from one Gaussian to the next
    int count;
};

// One row of a drawn colour plane and what a camera saw there.
struct ColorRow {
    const float* drawn;
    const std::uint8_t* seen;
    const std::uint8_t* is_static;  // 0: something moving stood there, do not compare
    float gain;                     // drawn times gain is compared
    int width;
};

struct ColorWeights {
    float l1;          // times the sign of the difference
    float squared;     // times twice the difference
    float similarity;  // times the gradient of the mean similarity, which is taken away
};

// One row of the drawn depth and alpha planes and what a depth camera measured there.
struct DepthRow {
    const float *drawn, *alpha;
    const float* measured_m;
    const std::uint8_t* is_static;
    float weight;  // of the L1 norm
    int width;
};

struct Kernels {
    const char* name;
    int block_height;  // of the tiles that ``label_tile`` fills, see tile_index
    void (*project)(const Splats&, const Camera&, const Settings&, Projected*, int begin, int end);
    // ``pair_sums`` (kPairGradients each) and ``shown`` (0 or 1) begin with Gaussian ``begin``.
    // Gradients of those not shown are zero; ``d_pose`` gets the sum over the others.
    void (*unproject_gradients)(const Splats&, const Camera&, const float* pair_sums,
                                const float* shown, const SplatGradients&, float* d_pose,
                                int begin, int end);
    // Returns how many of the job's Gaussians were drawn before the tile was opaque.
    int (*draw_tile)(const Projected*, const TileJob&, const Camera&, const Settings&,
                     float* planes);
    void (*draw_tile_gradients)(const Projected*, const TileJob&, const Camera&, const Settings&,
                                const float* planes, const float* plane_gradients,
                                float* pair_gradients);
    // ``tile_planes`` is working memory, one tile for each channel.
    void (*draw_tile_features)(const Projected*, const TileJob&, const Camera&, const Settings&,
                               const FeatureBlock&, float* tile_planes, float* planes);
    void (*lift_tile)(const Projected*, const TileJob&, const Camera&, const Settings&,
                      const float* planes, int num_planes, float* tile_planes, float* pair_sums);
    // ``slots`` names for each Gaussian of the job the tile of ``label_weights`` it adds to.
    void (*label_tile)(const Projected*, const TileJob&, const Camera&, const Settings&,
                       const int* slots, float* label_weights);
    // ``plane`` (height x width): depth of the surface behind which less than half of the light
    // is left, averaged with all that lies within kSurfaceBand of it; 0 where more light passes.
    void (*surface_tile)(const Projected*, const TileJob&, const Camera&, const Settings&,
                         float* plane);
    // Structural similarity of the columns from x0 on (at most kStripColumns) of two planes:
    // returns its sum, and fills these columns of the gradient of ``scale`` times the sum over the
    // whole plane with respect to ``x``.
    double (*similarity_strip)(const float* x, const float* y, float* gradient, float scale,
                               int width, int height, int x0);
    // Fills the two rows to compare; adds the sums of |difference| and difference^2.
    void (*compare_row)(const ColorRow&, float* compared, float* wanted, double* l1,
                        double* squared);
    // ``gradient`` holds that of the similarity and gets that on the plane; returns dL/dgain.
    float (*color_gradient_row)(const ColorRow&, const float* compared, const float* wanted,
                                const ColorWeights&, float* gradient);
    // Fills the gradient on the depth and alpha planes; returns the sum of |residual|.
    float (*depth_gradient_row)(const DepthRow&, float* d_drawn, float* d_alpha);
    void (*adam)(float* values, const float* gradients, float* first, float* second,
                 const AdamRates&, int count);
};

namespace base {
extern const Kernels kernels;
}
#ifdef SPLAT_HAS_X86
namespace v3 {
extern const Kernels kernels;
}
namespace v4 {
extern const Kernels kernels;
}
#endif

}  // namespace splat
