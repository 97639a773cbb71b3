// Declarations of one instruction set's copy of the kernels; SPLAT_ISA names its namespace.
#pragma once

#include "kernels.hpp"

namespace splat::SPLAT_ISA {

void project(const Splats&, const Camera&, const Settings&, Projected*, int begin, int end);
void unproject_gradients(const Splats&, const Camera&, const float* pair_sums,
                         const float* shown, const SplatGradients&, float* d_pose, int begin,
                         int end);
int draw_tile(const Projected*, const TileJob&, const Camera&, const Settings&, float* planes);
void draw_tile_gradients(const Projected*, const TileJob&, const Camera&, const Settings&,
                         const float* planes, const float* plane_gradients,
                         float* pair_gradients);
void draw_tile_features(const Projected*, const TileJob&, const Camera&, const Settings&,
                        const FeatureBlock&, float* tile_planes, float* planes);
void lift_tile(const Projected*, const TileJob&, const Camera&, const Settings&,
               const float* planes, int num_planes, float* tile_planes, float* pair_sums);
void label_tile(const Projected*, const TileJob&, const Camera&, const Settings&, const int* slots,
                float* label_weights);
void surface_tile(const Projected*, const TileJob&, const Camera&, const Settings&, float* plane);
double similarity_strip(const float* x, const float* y, float* gradient, float scale, int width,
                        int height, int x0);
void compare_row(const ColorRow&, float* compared, float* wanted, double* l1, double* squared);
float color_gradient_row(const ColorRow&, const float* compared, const float* wanted,
                         const ColorWeights&, float* gradient);
float depth_gradient_row(const DepthRow&, float* d_drawn, float* d_alpha);
void adam(float* values, const float* gradients, float* first, float* second, const AdamRates&,
          int count);

}  // namespace splat::SPLAT_ISA
