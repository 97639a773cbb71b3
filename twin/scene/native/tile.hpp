// What all walks over one tile share: which pixels a Gaussian can touch, and how opaque it is there.
#pragma once

#include <cmath>

#include "kernels_isa.hpp"
#include "lanes.hpp"

namespace splat::SPLAT_ISA {

struct Reach {
    int y0, y1, c0, c1;  // rows and chunks of the tile that a Gaussian can touch, ends excluded
};

static inline int floor_int(float value, int low, int high) {
    const float down = std::floor(value);
    return down < low ? low : (down > high ? high : static_cast<int>(down));
}

static inline Reach reach_of(const Projected& g, const TileJob& job) {
    const float u = g.u - job.x0 - 0.5f, v = g.v - job.y0 - 0.5f;
    Reach reach;
    reach.y0 = floor_int(v - g.half_y + 1.0f, 0, kTile);
    reach.y1 = floor_int(v + g.half_y, -1, kTile - 1) + 1;
    reach.c0 = floor_int(u - g.half_x + 1.0f, 0, kTile) / kLanes;
    reach.c1 = (floor_int(u + g.half_x, -1, kTile - 1) + kLanes) / kLanes;
    return reach;
}

// Transmittance in front of everything: 1 in the image, 0 in the part of a tile beyond its border.
static inline void start_light(const TileJob& job, const Camera& camera, float* light) {
    for (int y = 0; y < kTile; ++y)
        for (int x = 0; x < kTile; ++x)
            light[y * kTile + x] =
                job.x0 + x < camera.width && job.y0 + y < camera.height ? 1.0f : 0.0f;
}

static inline Floats columns() {
    Floats x;
    for (int i = 0; i < kLanes; ++i) x[i] = static_cast<float>(i);
    return x;
}

// One row of a Gaussian in a tile: log2(alpha) = row - dx (a dx + b_dy).
struct RowShape {
    float dy, b_dy;
    Floats row;
};

static inline RowShape row_shape(const Projected& g, const TileJob& job, int y) {
    const float dy = job.y0 + y + 0.5f - g.v;
    return {dy, g.b * dy, all(g.log2_opacity - g.c * dy * dy)};
}

static inline Floats offsets(const Projected& g, const TileJob& job, int chunk, Floats columns) {
    return columns + (job.x0 + chunk * kLanes + 0.5f - g.u);
}

static inline Floats log2_alpha(const Projected& g, const RowShape& shape, Floats dx) {
    return shape.row - dx * (g.a * dx + shape.b_dy);
}

static inline Floats alpha_of(Floats power, float log2_cut) {
    return keep(power >= log2_cut, smaller(exp2(power), all(kMaxAlpha)));
}

// Copy between a tile and planes of the whole image, honouring the image border.
template <class Move>
static inline void each_row(const TileJob& job, const Camera& camera, Move move) {
    const int width = camera.width - job.x0 < kTile ? camera.width - job.x0 : kTile;
    const int height = camera.height - job.y0 < kTile ? camera.height - job.y0 : kTile;
    for (int y = 0; y < height; ++y)
        for (int x = 0; x < width; ++x)
            move(y * kTile + x, (job.y0 + y) * camera.width + job.x0 + x);
}

}  // namespace splat::SPLAT_ISA
