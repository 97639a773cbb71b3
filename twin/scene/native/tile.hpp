// What all walks over one tile share: which pixels a Gaussian can touch, and how opaque it is there.
//
// A vector is a block of 4 x kTall pixels, and a tile is stored block by block: small Gaussians
// touch fewer blocks than they would touch rows.
#pragma once

#include <cmath>

#include "kernels_isa.hpp"
#include "lanes.hpp"

namespace splat::SPLAT_ISA {

constexpr int kTall = kLanes / kBlockWidth;
constexpr int kBlocksAcross = kTile / kBlockWidth;

struct Reach {
    int y0, y1, x0, x1;  // blocks of the tile that a Gaussian can touch, ends excluded
};

static inline int floor_int(float value, int low, int high) {
    const float down = std::floor(value);
    return down < low ? low : (down > high ? high : static_cast<int>(down));
}

static inline Reach reach_of(const Projected& g, const TileJob& job) {
    const float u = g.u - job.x0 - 0.5f, v = g.v - job.y0 - 0.5f;
    Reach reach;
    reach.y0 = floor_int(v - g.half_y + 1.0f, 0, kTile) / kTall;
    reach.y1 = (floor_int(v + g.half_y, -1, kTile - 1) + kTall) / kTall;
    reach.x0 = floor_int(u - g.half_x + 1.0f, 0, kTile) / kBlockWidth;
    reach.x1 = (floor_int(u + g.half_x, -1, kTile - 1) + kBlockWidth) / kBlockWidth;
    return reach;
}

static inline int block_at(int row, int column) { return (row * kBlocksAcross + column) * kLanes; }

// Column and row of each pixel in its block.
struct Grid {
    Floats x, y;
};

static inline Grid block_grid() {
    Grid grid;
    for (int i = 0; i < kLanes; ++i) {
        const int row = i / kBlockWidth;
        grid.x[i] = static_cast<float>(i % kBlockWidth);
        grid.y[i] = static_cast<float>(row);
    }
    return grid;
}

// One row of blocks: log2(alpha) = row - dx (a dx + b_dy).
struct RowShape {
    Floats dy, b_dy, row;
};

static inline RowShape row_shape(const Projected& g, const TileJob& job, int row,
                                 const Grid& grid) {
    const Floats dy = grid.y + (job.y0 + row * kTall + 0.5f - g.v);
    return {dy, g.b * dy, g.log2_opacity - g.c * dy * dy};
}

static inline Floats offsets(const Projected& g, const TileJob& job, int column,
                             const Grid& grid) {
    return grid.x + (job.x0 + column * kBlockWidth + 0.5f - g.u);
}

static inline Floats log2_alpha(const Projected& g, const RowShape& shape, Floats dx) {
    return shape.row - dx * (g.a * dx + shape.b_dy);
}

static inline Floats alpha_of(Floats power, float log2_cut) {
    return keep(power >= log2_cut, smaller(exp2(power), all(kMaxAlpha)));
}

static inline Floats4 load_four(const float* at) {
    Floats4 value;
    __builtin_memcpy(&value, at, sizeof value);
    return value;
}

static inline void store_four(float* at, Floats4 value) {
    __builtin_memcpy(at, &value, sizeof value);
}

// Visit the pixels of a tile that lie in the image, four in a row or fewer at its right border:
// ``visit(where in the tile, where in the image, how many)``.
template <class Visit>
static inline void each_four(const TileJob& job, const Camera& camera, Visit visit) {
    const int width = camera.width - job.x0 < kTile ? camera.width - job.x0 : kTile;
    const int height = camera.height - job.y0 < kTile ? camera.height - job.y0 : kTile;
    for (int y = 0; y < height; ++y)
        for (int x = 0; x < width; x += kBlockWidth)
            visit(tile_index(x, y, kTall), (job.y0 + y) * camera.width + job.x0 + x,
                  width - x < kBlockWidth ? width - x : kBlockWidth);
}

static inline void copy_four(float* to, const float* from, int count) {
    if (count == kBlockWidth)
        __builtin_memcpy(to, from, kBlockWidth * sizeof(float));
    else
        for (int i = 0; i < count; ++i) to[i] = from[i];
}

// Transmittance in front of everything: 1 in the image, 0 in the part of a tile beyond its border.
static inline void start_light(const TileJob& job, const Camera& camera, float* light) {
    __builtin_memset(light, 0, sizeof(float) * kTilePixels);
    each_four(job, camera, [&](int in_tile, int, int count) {
        for (int i = 0; i < count; ++i) light[in_tile + i] = 1.0f;
    });
}

}  // namespace splat::SPLAT_ISA
