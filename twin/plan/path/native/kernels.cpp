#include "kernels.hpp"

#include <cmath>

#ifndef MOTION_ISA
#define MOTION_ISA base
#endif

namespace motion::MOTION_ISA {

namespace {

void place(const float* R, const float* t, const Spheres& own, float* x, float* y, float* z) {
#pragma omp simd
    for (int i = 0; i < own.count; ++i) {
        x[i] = R[0] * own.x[i] + R[1] * own.y[i] + R[2] * own.z[i] + t[0];
        y[i] = R[3] * own.x[i] + R[4] * own.y[i] + R[5] * own.z[i] + t[1];
        z[i] = R[6] * own.x[i] + R[7] * own.y[i] + R[8] * own.z[i] + t[2];
    }
}

float to_box(const Spheres& spheres, const float* R, const float* t, const float* half) {
    float best = 1e9F;
#pragma omp simd reduction(min : best)
    for (int i = 0; i < spheres.count; ++i) {
        const float dx = spheres.x[i] - t[0], dy = spheres.y[i] - t[1], dz = spheres.z[i] - t[2];
        float u = std::fabs(R[0] * dx + R[3] * dy + R[6] * dz) - half[0];
        float v = std::fabs(R[1] * dx + R[4] * dy + R[7] * dz) - half[1];
        float w = std::fabs(R[2] * dx + R[5] * dy + R[8] * dz) - half[2];
        u = u > 0.0F ? u : 0.0F;
        v = v > 0.0F ? v : 0.0F;
        w = w > 0.0F ? w : 0.0F;
        const float away = std::sqrt(u * u + v * v + w * w) - spheres.r[i];
        best = away < best ? away : best;
    }
    return best;
}

float to_ground(const Spheres& spheres) {
    float best = 1e9F;
#pragma omp simd reduction(min : best)
    for (int i = 0; i < spheres.count; ++i) {
        const float height = spheres.z[i] - spheres.r[i];
        best = height < best ? height : best;
    }
    return best;
}

float between(const Spheres& one, const Spheres& other) {
    float best = 1e9F;
    for (int k = 0; k < other.count; ++k) {
        const float ox = other.x[k], oy = other.y[k], oz = other.z[k];
        float nearest = 1e9F;
#pragma omp simd reduction(min : nearest)
        for (int i = 0; i < one.count; ++i) {
            const float dx = one.x[i] - ox, dy = one.y[i] - oy, dz = one.z[i] - oz;
            const float away = std::sqrt(dx * dx + dy * dy + dz * dz) - one.r[i];
            nearest = away < nearest ? away : nearest;
        }
        const float away = nearest - other.r[k];
        best = away < best ? away : best;
    }
    return best;
}

int farthest(const float* x, const float* y, const float* z, int count, const float* d) {
    const float dx = d[0], dy = d[1], dz = d[2];
    float best[kLanes];
    int block[kLanes];
    for (int lane = 0; lane < kLanes; ++lane) {
        best[lane] = dx * x[lane] + dy * y[lane] + dz * z[lane];
        block[lane] = 0;
    }
    for (int begin = kLanes; begin < count; begin += kLanes) {
#pragma omp simd
        for (int lane = 0; lane < kLanes; ++lane) {
            const int i = begin + lane;
            const float along = dx * x[i] + dy * y[i] + dz * z[i];
            const bool more = along > best[lane];
            best[lane] = more ? along : best[lane];
            block[lane] = more ? begin : block[lane];
        }
    }
    int lane = 0;
    for (int other = 1; other < kLanes; ++other)
        if (best[other] > best[lane]) lane = other;
    return block[lane] + lane;
}

}  // namespace

extern const Kernels table;
const Kernels table{place, to_box, to_ground, between, farthest};

}  // namespace motion::MOTION_ISA
