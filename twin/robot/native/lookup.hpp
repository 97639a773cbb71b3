// Trilinear lookups of many points at once, once per instruction set: the same bits in each.
#pragma once

#include <cstdint>

struct GridView {
    const float* rows;
    double voxel;
    std::int32_t count[3];
    double origin[3];
};

// How many points are asked at once at most.
constexpr int kBatch = 64;

// Distances of points, turned (R row by row) and shifted.
using Lookup = void (*)(const GridView& grid, const double* R, const double* t,
                        const double* points, int count, double* distances);

Lookup lookup();
