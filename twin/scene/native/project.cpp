// From Gaussians in the world to ellipses in the image, and the gradients back.
//
// Sigma = R S S^T R^T (paper Eq. 1 as resolved by the errata), image covariance J W Sigma W^T J^T
// by the local affine approximation, then a pixel-sized low-pass with energy-preserving opacity.
// Compiled once per instruction set, with contraction off so that all sort depths alike.
#include <cmath>

#include "kernels_isa.hpp"
#include "scalar.hpp"

namespace splat::SPLAT_ISA {

namespace {

struct Local {
    float p[3];        // centre in the camera frame [m]
    float tx, ty;      // x/z and y/z, clamped for the Jacobian
    bool clamped_x, clamped_y;
    float q[4];        // unit quaternion
    float q_inverse_norm;
    float R[9];        // rotation of the Gaussian
    float s[3];        // scales [m]
    float T[6];        // J W, 2 x 3
    float A[6];        // J W R S, 2 x 3
    float xx, xy, yy;  // image covariance without the low-pass [px^2]
};

void rotation(const float* q, float* R) {
    const float w = q[0], x = q[1], y = q[2], z = q[3];
    R[0] = 1 - 2 * (y * y + z * z);
    R[1] = 2 * (x * y - w * z);
    R[2] = 2 * (x * z + w * y);
    R[3] = 2 * (x * y + w * z);
    R[4] = 1 - 2 * (x * x + z * z);
    R[5] = 2 * (y * z - w * x);
    R[6] = 2 * (x * z - w * y);
    R[7] = 2 * (y * z + w * x);
    R[8] = 1 - 2 * (x * x + y * y);
}

float clamp_to(float value, float low, float high, bool* clamped) {
    *clamped = value < low || value > high;
    return value < low ? low : (value > high ? high : value);
}

// Unit vector from the camera centre to a mean; returns one over the distance.
float view_direction(const float* mean, const Camera& camera, float* direction) {
    float norm2 = 0;
    for (int i = 0; i < 3; ++i) {
        direction[i] = mean[i] - camera.centre[i];
        norm2 += direction[i] * direction[i];
    }
    const float inverse = 1.0f / std::sqrt(norm2 > 1e-24f ? norm2 : 1e-24f);
    for (int i = 0; i < 3; ++i) direction[i] *= inverse;
    return inverse;
}

void harmonic_basis(const float* direction, float* basis) {
    basis[0] = -kHarmonicFactor * direction[1];
    basis[1] = kHarmonicFactor * direction[2];
    basis[2] = -kHarmonicFactor * direction[0];
}

void seen_color(const Splats& in, const Camera& camera, int index, float* rgb) {
    for (int c = 0; c < 3; ++c) rgb[c] = in.colors[3 * index + c];
    if (in.harmonics == nullptr) return;
    float direction[3], basis[kHarmonics];
    view_direction(in.means + 3 * index, camera, direction);
    harmonic_basis(direction, basis);
    const float* h = in.harmonics + 3 * kHarmonics * static_cast<std::int64_t>(index);
    for (int k = 0; k < kHarmonics; ++k)
        for (int c = 0; c < 3; ++c) rgb[c] += basis[k] * h[3 * k + c];
}

bool to_camera(const float* mean, const Camera& camera, float* p) {
    for (int i = 0; i < 3; ++i)
        p[i] = camera.R[3 * i] * mean[0] + camera.R[3 * i + 1] * mean[1] +
               camera.R[3 * i + 2] * mean[2] + camera.t[i];
    return p[2] > kNearDepth && p[2] < 1e6f;  // false for NaN as well
}

void fill_local(const Splats& in, const Camera& camera, int index, Local* out) {
    const float* quat = in.quats + 4 * index;
    const float norm2 =
        quat[0] * quat[0] + quat[1] * quat[1] + quat[2] * quat[2] + quat[3] * quat[3];
    out->q_inverse_norm = 1.0f / std::sqrt(norm2);
    for (int i = 0; i < 4; ++i) out->q[i] = quat[i] * out->q_inverse_norm;
    rotation(out->q, out->R);
    for (int i = 0; i < 3; ++i) out->s[i] = exp_of(in.scales_log[3 * index + i]);

    const float inverse_z = 1.0f / out->p[2];
    // Far outside the image the affine approximation explodes; hold it at 30 % beyond the border.
    const float margin_x = 0.3f * camera.width, margin_y = 0.3f * camera.height;
    out->tx = clamp_to(out->p[0] * inverse_z, (-margin_x - camera.cx) / camera.fx,
                       (camera.width + margin_x - camera.cx) / camera.fx, &out->clamped_x);
    out->ty = clamp_to(out->p[1] * inverse_z, (-margin_y - camera.cy) / camera.fy,
                       (camera.height + margin_y - camera.cy) / camera.fy, &out->clamped_y);
    const float jx = camera.fx * inverse_z, jy = camera.fy * inverse_z;
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
    const float* A = out->A;
    out->xx = A[0] * A[0] + A[1] * A[1] + A[2] * A[2];
    out->xy = A[0] * A[3] + A[1] * A[4] + A[2] * A[5];
    out->yy = A[3] * A[3] + A[4] * A[4] + A[5] * A[5];
}

// det = |row0 x row1|^2 (Lagrange): xx yy - xy^2 loses all digits for thin ellipses.
float image_determinant(const float* A) {
    const float n0 = A[1] * A[5] - A[2] * A[4];
    const float n1 = A[2] * A[3] - A[0] * A[5];
    const float n2 = A[0] * A[4] - A[1] * A[3];
    return n0 * n0 + n1 * n1 + n2 * n2;
}

struct Cut {
    float alpha, log2_alpha;
};

void project_one(const Splats& in, const Camera& camera, const Cut& cut, int index,
                 Projected* out) {
    out->half_x = -1.0f;
    Local local;
    if (!to_camera(in.means + 3 * index, camera, local.p)) return;
    fill_local(in, camera, index, &local);
    const float xx = local.xx + kMipVariance, yy = local.yy + kMipVariance;
    const float det_raw = image_determinant(local.A);
    const float det = det_raw + kMipVariance * (local.xx + local.yy) + kMipVariance * kMipVariance;
    if (!(det > 0.0f) || !(det < 1e30f)) return;
    const float ratio = det_raw / det;
    const float compensation = std::sqrt(ratio > kMinMipRatio ? ratio : kMinMipRatio);
    const float opacity = compensation / (1.0f + exp_of(-in.opacities[index]));
    if (!(opacity > cut.alpha)) return;

    const float inverse_z = 1.0f / local.p[2];
    out->u = camera.fx * local.p[0] * inverse_z + camera.cx;
    out->v = camera.fy * local.p[1] * inverse_z + camera.cy;
    const float half_log2e_over_det = 0.5f * kLog2E / det;
    out->a = yy * half_log2e_over_det;
    out->b = -2.0f * local.xy * half_log2e_over_det;
    out->c = xx * half_log2e_over_det;
    out->log2_opacity = log2_of(opacity);
    seen_color(in, camera, index, out->rgb);
    out->depth = local.p[2];
    // exp(-r^2 / 2) = cut / opacity
    const float above = out->log2_opacity - cut.log2_alpha;
    const float radius2 = above > 0 ? 2.0f / kLog2E * above : 0.0f;
    const float half_x = std::sqrt(radius2 * xx), half_y = std::sqrt(radius2 * yy);
    const float sum = out->u + out->v + out->a + out->b + out->c + out->log2_opacity + half_x +
                      half_y + out->rgb[0] + out->rgb[1] + out->rgb[2];
    const bool finite = sum - sum == 0.0f;
    const bool inside = out->u + half_x > 0 && out->u - half_x < camera.width &&
                        out->v + half_y > 0 && out->v - half_y < camera.height;
    if (!finite || !inside) return;
    out->half_x = half_x;
    out->half_y = half_y;
}

// Gradient of the normalised quaternion's rotation matrix, projected back on the raw quaternion.
void quaternion_gradient(const Local& local, const float* dR, float* out) {
    const float w = local.q[0], x = local.q[1], y = local.q[2], z = local.q[3];
    const float d[4] = {
        2 * (-z * dR[1] + y * dR[2] + z * dR[3] - x * dR[5] - y * dR[6] + x * dR[7]),
        2 * (y * dR[1] + z * dR[2] + y * dR[3] - 2 * x * dR[4] - w * dR[5] + z * dR[6] +
             w * dR[7] - 2 * x * dR[8]),
        2 * (-2 * y * dR[0] + x * dR[1] + w * dR[2] + x * dR[3] + z * dR[5] - w * dR[6] +
             z * dR[7] - 2 * y * dR[8]),
        2 * (-2 * z * dR[0] - w * dR[1] + x * dR[2] + w * dR[3] - 2 * z * dR[4] + y * dR[5] +
             x * dR[6] + y * dR[7])};
    const float along =
        d[0] * local.q[0] + d[1] * local.q[1] + d[2] * local.q[2] + d[3] * local.q[3];
    for (int i = 0; i < 4; ++i)
        out[i] = (d[i] - along * local.q[i]) * local.q_inverse_norm;
}

// Inverse K of the image covariance with the low-pass, and of its determinant without.
struct Inverse {
    float xx, xy, yy;
    float raw;  // 1 / det; 0 where the mip compensation is held at its floor
};

Inverse inverse_of(const Local& local) {
    const float det_raw = image_determinant(local.A);
    const float det = det_raw + kMipVariance * (local.xx + local.yy) + kMipVariance * kMipVariance;
    const float inverse = 1.0f / det;
    return {(local.yy + kMipVariance) * inverse, -local.xy * inverse,
            (local.xx + kMipVariance) * inverse,
            det_raw > kMinMipRatio * det ? 1.0f / det_raw : 0.0f};
}

struct CovarianceGradient {
    float xx, xy, yy;  // symmetric matrix [[xx, xy], [xy, yy]]
};

// Through the inverse and through the mip compensation of the opacity.
CovarianceGradient covariance_gradient(const Local& local, const Inverse& K, const float* sums) {
    // dL/dK = -1/2 sum e d d^T, and dL/dcov = -K (dL/dK) K.
    const float gxx = 0.5f * sums[kExx], gxy = 0.5f * sums[kExy], gyy = 0.5f * sums[kEyy];
    const float hxx = K.xx * gxx + K.xy * gxy, hxy = K.xx * gxy + K.xy * gyy;
    const float hyx = K.xy * gxx + K.yy * gxy, hyy = K.xy * gxy + K.yy * gyy;
    CovarianceGradient g{hxx * K.xx + hxy * K.xy, hxx * K.xy + hxy * K.yy,
                         hyx * K.xy + hyy * K.yy};
    if (K.raw > 0) {
        const float half_e = 0.5f * sums[kE];
        g.xx += half_e * (local.yy * K.raw - K.xx);
        g.xy += half_e * (-local.xy * K.raw - K.xy);
        g.yy += half_e * (local.xx * K.raw - K.yy);
    }
    return g;
}

// Gradient on the centre in the camera frame.
void point_gradient(const Local& local, const Camera& camera, const Inverse& K, const float* sums,
                    const float* dT, float* dp) {
    const float du = K.xx * sums[kEx] + K.xy * sums[kEy];
    const float dv = K.xy * sums[kEx] + K.yy * sums[kEy];
    const float inverse_z = 1.0f / local.p[2];
    const float jx = camera.fx * inverse_z, jy = camera.fy * inverse_z;
    dp[0] = du * jx;
    dp[1] = dv * jy;
    dp[2] = sums[kDepth] - (du * jx * local.p[0] + dv * jy * local.p[1]) * inverse_z;
    // T = J W: row 0 is jx (W0 - tx W2), row 1 is jy (W1 - ty W2).
    float d_jx = 0, d_jy = 0, d_tx = 0, d_ty = 0;
    for (int k = 0; k < 3; ++k) {
        d_jx += dT[k] * (camera.R[k] - local.tx * camera.R[6 + k]);
        d_jy += dT[3 + k] * (camera.R[3 + k] - local.ty * camera.R[6 + k]);
        d_tx -= dT[k] * jx * camera.R[6 + k];
        d_ty -= dT[3 + k] * jy * camera.R[6 + k];
    }
    dp[2] -= (d_jx * jx + d_jy * jy) * inverse_z;
    if (!local.clamped_x) {
        dp[0] += d_tx * inverse_z;
        dp[2] -= d_tx * local.p[0] * inverse_z * inverse_z;
    }
    if (!local.clamped_y) {
        dp[1] += d_ty * inverse_z;
        dp[2] -= d_ty * local.p[1] * inverse_z * inverse_z;
    }
}

// Fills dL/dharmonics and the gradient on the ray from the camera centre to the mean.
void harmonic_gradient(const Splats& in, const Camera& camera, const float* d_rgb, int index,
                       float* d_harmonics, float* d_ray) {
    float direction[3], basis[kHarmonics], along[kHarmonics];
    const float inverse = view_direction(in.means + 3 * index, camera, direction);
    harmonic_basis(direction, basis);
    const float* h = in.harmonics + 3 * kHarmonics * static_cast<std::int64_t>(index);
    for (int k = 0; k < kHarmonics; ++k) {
        along[k] = h[3 * k] * d_rgb[0] + h[3 * k + 1] * d_rgb[1] + h[3 * k + 2] * d_rgb[2];
        for (int c = 0; c < 3; ++c) d_harmonics[3 * k + c] = basis[k] * d_rgb[c];
    }
    const float d_direction[3] = {-kHarmonicFactor * along[2], -kHarmonicFactor * along[0],
                                  kHarmonicFactor * along[1]};
    const float radial = d_direction[0] * direction[0] + d_direction[1] * direction[1] +
                         d_direction[2] * direction[2];
    for (int i = 0; i < 3; ++i) d_ray[i] = (d_direction[i] - radial * direction[i]) * inverse;
}

// The camera acts on the centre, on the Jacobian's T = J W and, as -R^T t, on the viewing ray.
void pose_gradient(const Local& local, const Camera& camera, const float* mean, const float* dp,
                   const float* dT, const float* d_ray, float* out) {
    const float jx = camera.fx / local.p[2], jy = camera.fy / local.p[2];
    for (int k = 0; k < 3; ++k) {
        const float d0 = jx * dT[k], d1 = jy * dT[3 + k];
        out[k] = dp[0] * mean[k] + d0 + camera.t[0] * d_ray[k];
        out[4 + k] = dp[1] * mean[k] + d1 + camera.t[1] * d_ray[k];
        out[8 + k] =
            dp[2] * mean[k] - local.tx * d0 - local.ty * d1 + camera.t[2] * d_ray[k];
    }
    for (int i = 0; i < 3; ++i)
        out[4 * i + 3] = dp[i] + camera.R[3 * i] * d_ray[0] + camera.R[3 * i + 1] * d_ray[1] +
                         camera.R[3 * i + 2] * d_ray[2];
}

}  // namespace

void project(const Splats& in, const Camera& camera, const Settings& settings, Projected* out,
             int begin, int end) {
    const Cut cut{settings.alpha_cut, log2_of(settings.alpha_cut)};
    for (int index = begin; index < end; ++index) project_one(in, camera, cut, index, out + index);
}

void unproject_gradients(const Splats& in, const Camera& camera, const float* sums,
                         const SplatGradients& out, float* d_pose, int index) {
    Local local;
    to_camera(in.means + 3 * index, camera, local.p);
    fill_local(in, camera, index, &local);

    const Inverse K = inverse_of(local);
    const CovarianceGradient g = covariance_gradient(local, K, sums);
    float dA[6], dT[6] = {0, 0, 0, 0, 0, 0}, dR[9];
    for (int k = 0; k < 3; ++k) {
        dA[k] = 2 * (g.xx * local.A[k] + g.xy * local.A[3 + k]);
        dA[3 + k] = 2 * (g.xy * local.A[k] + g.yy * local.A[3 + k]);
    }
    for (int k = 0; k < 3; ++k) {
        float ds = 0;
        for (int i = 0; i < 3; ++i) {
            const float dM = local.T[i] * dA[k] + local.T[3 + i] * dA[3 + k];
            ds += dM * local.R[3 * i + k];
            dR[3 * i + k] = dM * local.s[k];
            dT[i] += dA[k] * local.R[3 * i + k] * local.s[k];
            dT[3 + i] += dA[3 + k] * local.R[3 * i + k] * local.s[k];
        }
        out.scales_log[3 * index + k] = ds * local.s[k];
    }
    quaternion_gradient(local, dR, out.quats + 4 * index);
    float dp[3], d_ray[3] = {0, 0, 0};
    point_gradient(local, camera, K, sums, dT, dp);
    if (in.harmonics != nullptr)
        harmonic_gradient(in, camera, sums + kRed, index,
                          out.harmonics + 3 * kHarmonics * static_cast<std::int64_t>(index), d_ray);
    for (int k = 0; k < 3; ++k)
        out.means[3 * index + k] = camera.R[k] * dp[0] + camera.R[3 + k] * dp[1] +
                                   camera.R[6 + k] * dp[2] + d_ray[k];
    pose_gradient(local, camera, in.means + 3 * index, dp, dT, d_ray, d_pose);
    out.opacities[index] = sums[kE] / (1.0f + exp_of(in.opacities[index]));
    for (int k = 0; k < 3; ++k) out.colors[3 * index + k] = sums[kRed + k];
}

}  // namespace splat::SPLAT_ISA
