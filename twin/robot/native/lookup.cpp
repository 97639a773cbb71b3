#include "lookup.hpp"

#include <cmath>

#ifndef GRID_ISA
#define GRID_ISA base
#endif

namespace lookups::GRID_ISA {

namespace {

// Beyond the grid as if all solid were inside of it (see Grid::at).
void look(const GridView& grid, const double* R, const double* t, const double* points, int count,
          double* distances) {
    const std::int32_t step_y = grid.count[2], step_x = grid.count[1] * grid.count[2];
    const double last_x = grid.count[0] - 1, last_y = grid.count[1] - 1, last_z = grid.count[2] - 1;
    const std::int32_t end_x = grid.count[0] - 2, end_y = grid.count[1] - 2, end_z = grid.count[2] - 2;
    const float* rows = grid.rows;
    const double voxel = grid.voxel;
    const double ox = grid.origin[0], oy = grid.origin[1], oz = grid.origin[2];
#pragma omp simd
    for (int i = 0; i < count; ++i) {
        const double px = points[3 * i], py = points[3 * i + 1], pz = points[3 * i + 2];
        const double x = (R[0] * px + R[1] * py + R[2] * pz + t[0] - ox) / voxel;
        const double y = (R[3] * px + R[4] * py + R[5] * pz + t[1] - oy) / voxel;
        const double z = (R[6] * px + R[7] * py + R[8] * pz + t[2] - oz) / voxel;
        // Written so that what is no number ends up inside of the grid.
        const double low_x = x > 0.0 ? x : 0.0, low_y = y > 0.0 ? y : 0.0, low_z = z > 0.0 ? z : 0.0;
        const double hx = low_x < last_x ? low_x : last_x;
        const double hy = low_y < last_y ? low_y : last_y;
        const double hz = low_z < last_z ? low_z : last_z;
        const auto ix = static_cast<std::int32_t>(hx), iy = static_cast<std::int32_t>(hy),
                   iz = static_cast<std::int32_t>(hz);
        const std::int32_t cx = ix < end_x ? ix : end_x, cy = iy < end_y ? iy : end_y,
                           cz = iz < end_z ? iz : end_z;
        const double sx = hx - cx, sy = hy - cy, sz = hz - cz;
        const std::int32_t at = cx * step_x + cy * step_y + cz;
        const double a0 = rows[at], a1 = rows[at + 1];
        const double b0 = rows[at + step_y], b1 = rows[at + step_y + 1];
        const double c0 = rows[at + step_x], c1 = rows[at + step_x + 1];
        const double d0 = rows[at + step_x + step_y], d1 = rows[at + step_x + step_y + 1];
        const double a = a0 + (a1 - a0) * sz, b = b0 + (b1 - b0) * sz;
        const double c = c0 + (c1 - c0) * sz, d = d0 + (d1 - d0) * sz;
        const double low = a + (b - a) * sy, high = c + (d - c) * sy;
        const double value = low + (high - low) * sx;
        const double beyond = (x - hx) * (x - hx) + (y - hy) * (y - hy) + (z - hz) * (z - hz);
        const double far = std::sqrt(beyond) * voxel;
        const double around = std::sqrt(value * value + far * far);
        const double outside = value > 0.0 ? around : value + far;
        distances[i] = beyond > 0.0 ? outside : value;
    }
}

}  // namespace

extern const Lookup table;
const Lookup table = look;

}  // namespace lookups::GRID_ISA
