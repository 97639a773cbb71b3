// Declarations of one instruction set's copy of the kernels; SPLAT_ISA names its namespace.
#pragma once

#include "kernels.hpp"

namespace splat::SPLAT_ISA {

void project(const Splats&, const Camera&, const Settings&, Projected*, int begin, int end);
void unproject_gradients(const Splats&, const Camera&, const Projected&, const float* pair_sums,
                         const SplatGradients&, int index);
int draw_tile(const Projected*, const TileJob&, const Camera&, const Settings&, float* planes);
void draw_tile_gradients(const Projected*, const TileJob&, const Camera&, const Settings&,
                         const float* planes, const float* plane_gradients,
                         float* pair_gradients);
void blur(const float* in, float* out, float* scratch, int width, int height);
double similarity(const float* mean_x, const float* mean_y, const float* mean_xx,
                  const float* mean_yy, const float* mean_xy, float* d_mean_x, float* d_mean_xx,
                  float* d_mean_xy, int count);
void adam(float* values, const float* gradients, float* first, float* second, const AdamRates&,
          int count);

}  // namespace splat::SPLAT_ISA
