// The geometry that projection and its gradient share, one Gaussian in each lane.
//
// Sigma = R S S^T R^T (paper Eq. 1 as resolved by the errata), image covariance J W Sigma W^T J^T
// by the local affine approximation, then a pixel-sized low-pass with energy-preserving opacity.
#pragma once

#include <cmath>

#include "kernels_isa.hpp"
#include "lanes.hpp"

namespace splat::SPLAT_ISA {

constexpr float kLog2E = 1.4426950408889634f;

// Rows of a table as columns; lanes beyond ``count`` repeat the last row.
template <int kColumns>
static inline void gather(const float* table, int begin, int count, Floats* out) {
    float lanes[kColumns][kLanes];
    for (int i = 0; i < kLanes; ++i) {
        const int row = begin + (i < count ? i : count - 1);
        const float* at = table + static_cast<std::int64_t>(kColumns) * row;
        for (int k = 0; k < kColumns; ++k) lanes[k][i] = at[k];
    }
    for (int k = 0; k < kColumns; ++k) out[k] = load(lanes[k]);
}

template <int kColumns>
static inline void scatter(const Floats* values, float* table, int begin, int count) {
    float lanes[kColumns][kLanes];
    for (int k = 0; k < kColumns; ++k) store(lanes[k], values[k]);
    for (int i = 0; i < count && i < kLanes; ++i) {
        float* at = table + static_cast<std::int64_t>(kColumns) * (begin + i);
        for (int k = 0; k < kColumns; ++k) at[k] = lanes[k][i];
    }
}

static inline Floats root(Floats value) {
    float lanes[kLanes];
    store(lanes, value);
    for (int i = 0; i < kLanes; ++i) lanes[i] = std::sqrt(lanes[i]);
    return load(lanes);
}

static inline Floats at_least(Floats value, float least) {
    return value > least ? value : all(least);
}

// e^x, held at 2^-126 and 2^126; NaN stays NaN.
static inline Floats exp(Floats x) {
    const Floats power = x * kLog2E;
    const Floats low = power < -126.0f ? all(-126.0f) : power;
    const Floats held = low > 126.0f ? all(126.0f) : low;
    return x == x ? exp2(held) : x;
}

// Of positive normal numbers, by the series of the inverse hyperbolic tangent.
static inline Floats log2(Floats x) {
    const Ints bits = (Ints)x;
    const Floats mantissa = (Floats)((bits & 0x007fffff) | 0x3f800000);
    const Ints large = mantissa > 1.41421356f;
    const Floats m = large ? 0.5f * mantissa : mantissa;
    const Floats whole = __builtin_convertvector((bits >> 23) - 127 - large, Floats);
    const Floats t = (m - 1.0f) / (m + 1.0f), t2 = t * t;
    Floats series = t2 * 0.320598898f + 0.412198583f;
    series = series * t2 + 0.577078016f;
    series = series * t2 + 0.961796694f;
    series = series * t2 + 2.885390082f;
    return whole + t * series;
}

struct Local {
    Floats mean[3];
    Floats p[3];            // centre in the camera frame [m]
    Floats inverse_z;
    Floats tx, ty;          // x/z and y/z, held near the image for the Jacobian
    Ints free_x, free_y;    // whether they are not held
    Floats q[4];            // unit quaternion
    Floats q_inverse_norm;
    Floats R[9];            // rotation of the Gaussian
    Floats s[3];            // scales [m]
    Floats T[6];            // J W, 2 x 3
    Floats A[6];            // J W R S, 2 x 3
    Floats B[3];            // last row of W R S: depth [m]
    Floats xx, xy, yy;      // image covariance without the low-pass [px^2]
};

static inline void rotation(const Floats* q, Floats* R) {
    const Floats w = q[0], x = q[1], y = q[2], z = q[3];
    R[0] = 1.0f - 2.0f * (y * y + z * z);
    R[1] = 2.0f * (x * y - w * z);
    R[2] = 2.0f * (x * z + w * y);
    R[3] = 2.0f * (x * y + w * z);
    R[4] = 1.0f - 2.0f * (x * x + z * z);
    R[5] = 2.0f * (y * z - w * x);
    R[6] = 2.0f * (x * z - w * y);
    R[7] = 2.0f * (y * z + w * x);
    R[8] = 1.0f - 2.0f * (x * x + y * y);
}

static inline Floats hold(Floats value, float low, float high, Ints* is_free) {
    *is_free = (value >= low) & (value <= high);
    const Floats above = value < low ? all(low) : value;
    return above > high ? all(high) : above;
}

// Far outside the image the affine approximation explodes; it is held at 30 % beyond the border.
static inline void hold_near_image(const Camera& camera, Local* out) {
    const float margin_x = 0.3f * camera.width, margin_y = 0.3f * camera.height;
    out->tx = hold(out->p[0] * out->inverse_z, (-margin_x - camera.cx) / camera.fx,
                   (camera.width + margin_x - camera.cx) / camera.fx, &out->free_x);
    out->ty = hold(out->p[1] * out->inverse_z, (-margin_y - camera.cy) / camera.fy,
                   (camera.height + margin_y - camera.cy) / camera.fy, &out->free_y);
}

static inline void fill_local(const Splats& in, const Camera& camera, int begin, int count,
                              Local* out) {
    gather<3>(in.means, begin, count, out->mean);
    gather<4>(in.quats, begin, count, out->q);
    gather<3>(in.scales_log, begin, count, out->s);
    for (int i = 0; i < 3; ++i)
        out->p[i] = camera.R[3 * i] * out->mean[0] + camera.R[3 * i + 1] * out->mean[1] +
                    camera.R[3 * i + 2] * out->mean[2] + camera.t[i];
    const Floats* q = out->q;
    out->q_inverse_norm = 1.0f / root(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
    for (int i = 0; i < 4; ++i) out->q[i] *= out->q_inverse_norm;
    rotation(out->q, out->R);
    for (int i = 0; i < 3; ++i) out->s[i] = exp(out->s[i]);
    out->inverse_z = 1.0f / out->p[2];
    hold_near_image(camera, out);
    const Floats jx = camera.fx * out->inverse_z, jy = camera.fy * out->inverse_z;
    for (int k = 0; k < 3; ++k) {
        out->T[k] = jx * (camera.R[k] - out->tx * camera.R[6 + k]);
        out->T[3 + k] = jy * (camera.R[3 + k] - out->ty * camera.R[6 + k]);
    }
    for (int row = 0; row < 2; ++row)
        for (int k = 0; k < 3; ++k)
            out->A[3 * row + k] =
                (out->T[3 * row] * out->R[k] + out->T[3 * row + 1] * out->R[3 + k] +
                 out->T[3 * row + 2] * out->R[6 + k]) *
                out->s[k];
    for (int k = 0; k < 3; ++k)
        out->B[k] = (camera.R[6] * out->R[k] + camera.R[7] * out->R[3 + k] +
                     camera.R[8] * out->R[6 + k]) *
                    out->s[k];
    const Floats* A = out->A;
    out->xx = A[0] * A[0] + A[1] * A[1] + A[2] * A[2];
    out->xy = A[0] * A[3] + A[1] * A[4] + A[2] * A[5];
    out->yy = A[3] * A[3] + A[4] * A[4] + A[5] * A[5];
}

// det = |row0 x row1|^2 (Lagrange): xx yy - xy^2 loses all digits for thin ellipses.
static inline Floats image_determinant(const Floats* A) {
    const Floats n0 = A[1] * A[5] - A[2] * A[4];
    const Floats n1 = A[2] * A[3] - A[0] * A[5];
    const Floats n2 = A[0] * A[4] - A[1] * A[3];
    return n0 * n0 + n1 * n1 + n2 * n2;
}

static inline Floats low_pass_determinant(const Local& local, Floats det_raw) {
    return det_raw + kMipVariance * (local.xx + local.yy) + kMipVariance * kMipVariance;
}

// How depth changes over the image on the surface that a ray meets where the Gaussian is densest
// along it: the regression of depth on the pixel, cov(z, uv) cov(uv)^-1. Both covariances are those
// of the Gaussian seen through the low-pass, so that a grazing one has no infinite slope.
static inline void depth_slope(const Local& local, Floats inverse_det, Floats* slope) {
    const Floats *A = local.A, *B = local.B;
    const Floats xz = A[0] * B[0] + A[1] * B[1] + A[2] * B[2];
    const Floats yz = A[3] * B[0] + A[4] * B[1] + A[5] * B[2];
    slope[0] = ((local.yy + kMipVariance) * xz - local.xy * yz) * inverse_det;
    slope[1] = ((local.xx + kMipVariance) * yz - local.xy * xz) * inverse_det;
}

// Unit vector from the camera centre to each mean; returns one over the distance.
static inline Floats view_direction(const Local& local, const Camera& camera, Floats* direction) {
    for (int i = 0; i < 3; ++i) direction[i] = local.mean[i] - camera.centre[i];
    const Floats norm2 = direction[0] * direction[0] + direction[1] * direction[1] +
                         direction[2] * direction[2];
    const Floats inverse = 1.0f / root(at_least(norm2, 1e-24f));
    for (int i = 0; i < 3; ++i) direction[i] *= inverse;
    return inverse;
}

// Real spherical harmonics of degree 1 along a unit vector, with the signs of 3DGS files.
static inline void harmonic_basis(const Floats* direction, Floats* basis) {
    basis[0] = -kHarmonicFactor * direction[1];
    basis[1] = kHarmonicFactor * direction[2];
    basis[2] = -kHarmonicFactor * direction[0];
}

}  // namespace splat::SPLAT_ISA
