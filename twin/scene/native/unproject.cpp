// From gradients on ellipses back to Gaussians and to the camera, one Gaussian in each lane.
#include "ellipse.hpp"

namespace splat::SPLAT_ISA {

namespace {

// Inverse K of the image covariance with the low-pass, and of its determinant without.
struct Inverse {
    Floats xx, xy, yy;
    Floats low_pass;  // 1 / det with the low-pass
    Floats raw;  // 1 / det; 0 where the mip compensation is held at its floor
};

Inverse inverse_of(const Local& local) {
    const Floats det_raw = image_determinant(local.A);
    const Floats det = low_pass_determinant(local, det_raw);
    const Floats inverse = 1.0f / det;
    return {(local.yy + kMipVariance) * inverse, -local.xy * inverse,
            (local.xx + kMipVariance) * inverse, inverse,
            keep(det_raw > kMinMipRatio * det, 1.0f / det_raw)};
}

struct CovarianceGradient {
    Floats xx, xy, yy;  // symmetric matrix [[xx, xy], [xy, yy]]
};

// Through the inverse and through the mip compensation of the opacity.
CovarianceGradient covariance_gradient(const Local& local, const Inverse& K, const Floats* sums) {
    // dL/dK = -1/2 sum e d d^T, and dL/dcov = -K (dL/dK) K.
    const Floats gxx = 0.5f * sums[kExx], gxy = 0.5f * sums[kExy], gyy = 0.5f * sums[kEyy];
    const Floats hxx = K.xx * gxx + K.xy * gxy, hxy = K.xx * gxy + K.xy * gyy;
    const Floats hyx = K.xy * gxx + K.yy * gxy, hyy = K.xy * gxy + K.yy * gyy;
    const Floats half_e = keep(K.raw > 0.0f, 0.5f * sums[kE]);
    return {hxx * K.xx + hxy * K.xy + half_e * (local.yy * K.raw - K.xx),
            hxx * K.xy + hxy * K.yy + half_e * (-local.xy * K.raw - K.xy),
            hyx * K.xy + hyy * K.yy + half_e * (local.xx * K.raw - K.yy)};
}

// On the covariance of depth and pixel by way of the slope K (xz, yz), and on K by way of the same.
struct SlopeGradient {
    Floats x, y;  // dL/d(xz, yz)
};

SlopeGradient slope_gradient(const Inverse& K, const Floats* slope, const Floats* sums,
                             CovarianceGradient* on_covariance) {
    const Floats x = K.xx * sums[kDepthX] + K.xy * sums[kDepthY];
    const Floats y = K.xy * sums[kDepthX] + K.yy * sums[kDepthY];
    on_covariance->xx -= x * slope[0];
    on_covariance->xy -= 0.5f * (x * slope[1] + y * slope[0]);
    on_covariance->yy -= y * slope[1];
    return {x, y};
}

// Gradient of the normalised quaternion's rotation matrix, projected back on the raw quaternion.
void quaternion_gradient(const Local& local, const Floats* dR, Floats* out) {
    const Floats w = local.q[0], x = local.q[1], y = local.q[2], z = local.q[3];
    const Floats d[4] = {
        2.0f * (z * (dR[3] - dR[1]) + y * (dR[2] - dR[6]) + x * (dR[7] - dR[5])),
        2.0f * (y * (dR[1] + dR[3]) + z * (dR[2] + dR[6]) + w * (dR[7] - dR[5]) -
                2.0f * x * (dR[4] + dR[8])),
        2.0f * (x * (dR[1] + dR[3]) + z * (dR[5] + dR[7]) + w * (dR[2] - dR[6]) -
                2.0f * y * (dR[0] + dR[8])),
        2.0f * (x * (dR[2] + dR[6]) + y * (dR[5] + dR[7]) + w * (dR[3] - dR[1]) -
                2.0f * z * (dR[0] + dR[4]))};
    const Floats along = d[0] * w + d[1] * x + d[2] * y + d[3] * z;
    for (int i = 0; i < 4; ++i) out[i] = (d[i] - along * local.q[i]) * local.q_inverse_norm;
}

// Gradient on the centre in the camera frame.
void point_gradient(const Local& local, const Camera& camera, const Inverse& K,
                    const Floats* slope, const Floats* sums, const Floats* dT, Floats* dp) {
    const Floats inverse_z = local.inverse_z;
    const Floats jx = camera.fx * inverse_z, jy = camera.fy * inverse_z;
    // A centre that moves over the image takes its sloping surface with it.
    const Floats on_x =
        (K.xx * sums[kEx] + K.xy * sums[kEy] - slope[0] * sums[kDepth]) * jx;
    const Floats on_y =
        (K.xy * sums[kEx] + K.yy * sums[kEy] - slope[1] * sums[kDepth]) * jy;
    // T = J W: row 0 is jx (W0 - tx W2), row 1 is jy (W1 - ty W2).
    Floats d_jx{}, d_jy{}, d_tx{}, d_ty{};
    for (int k = 0; k < 3; ++k) {
        d_jx += dT[k] * (camera.R[k] - local.tx * camera.R[6 + k]);
        d_jy += dT[3 + k] * (camera.R[3 + k] - local.ty * camera.R[6 + k]);
        d_tx -= dT[k] * jx * camera.R[6 + k];
        d_ty -= dT[3 + k] * jy * camera.R[6 + k];
    }
    dp[0] = on_x + keep(local.free_x, d_tx * inverse_z);
    dp[1] = on_y + keep(local.free_y, d_ty * inverse_z);
    // u, v and the free tx, ty fall with z as x / z and y / z do.
    dp[2] = sums[kDepth] - (dp[0] * local.p[0] + dp[1] * local.p[1] + d_jx * jx + d_jy * jy) *
                               inverse_z;
}

// Fills dL/dharmonics and the gradient on the ray from the camera centre to the mean.
void harmonic_gradient(const Splats& in, const Camera& camera, const Local& local,
                       const Floats* d_rgb, int begin, int count, Floats* d_harmonics,
                       Floats* d_ray) {
    Floats direction[3], basis[kNumHarmonics], along[kNumHarmonics], h[3 * kNumHarmonics];
    const Floats inverse = view_direction(local, camera, direction);
    harmonic_basis(direction, basis);
    gather<3 * kNumHarmonics>(in.harmonics, begin, count, h);
    for (int k = 0; k < kNumHarmonics; ++k) {
        along[k] = h[3 * k] * d_rgb[0] + h[3 * k + 1] * d_rgb[1] + h[3 * k + 2] * d_rgb[2];
        for (int c = 0; c < 3; ++c) d_harmonics[3 * k + c] = basis[k] * d_rgb[c];
    }
    Floats d_direction[3] = {-kHarmonicFactor * along[2], -kHarmonicFactor * along[0],
                             kHarmonicFactor * along[1]};
    const Floats radial = d_direction[0] * direction[0] + d_direction[1] * direction[1] +
                          d_direction[2] * direction[2];
    for (int i = 0; i < 3; ++i) d_ray[i] = (d_direction[i] - radial * direction[i]) * inverse;
}

// The camera acts on the centre, on the Jacobian's T = J W and, as -R^T t, on the viewing ray.
void add_pose_gradient(const Local& local, const Camera& camera, Ints shown, const Floats* dp,
                       const Floats* dT, const Floats* d_axis, const Floats* d_ray, Floats* pose) {
    const Floats jx = camera.fx * local.inverse_z, jy = camera.fy * local.inverse_z;
    for (int k = 0; k < 3; ++k) {
        const Floats d0 = jx * dT[k], d1 = jy * dT[3 + k], m = local.mean[k];
        pose[k] += keep(shown, dp[0] * m + d0 + camera.t[0] * d_ray[k]);
        pose[4 + k] += keep(shown, dp[1] * m + d1 + camera.t[1] * d_ray[k]);
        pose[8 + k] += keep(shown, dp[2] * m - local.tx * d0 - local.ty * d1 + d_axis[k] +
                                       camera.t[2] * d_ray[k]);
    }
    for (int i = 0; i < 3; ++i)
        pose[4 * i + 3] +=
            keep(shown, dp[i] + camera.R[3 * i] * d_ray[0] + camera.R[3 * i + 1] * d_ray[1] +
                            camera.R[3 * i + 2] * d_ray[2]);
}

template <int kColumns>
void write(Floats* values, Ints shown, float* table, int begin, int count) {
    for (int k = 0; k < kColumns; ++k) values[k] = keep(shown, values[k]);
    scatter<kColumns>(values, table, begin, count);
}

void write_harmonics(const Splats& in, const Camera& camera, const Local& local,
                     const Floats* d_rgb, Ints shown, float* table, int begin, int count,
                     Floats* d_ray) {
    Floats d_harmonics[3 * kNumHarmonics];
    harmonic_gradient(in, camera, local, d_rgb, begin, count, d_harmonics, d_ray);
    write<3 * kNumHarmonics>(d_harmonics, shown, table, begin, count);
}

// dA and dB to scales, rotation, T and the optical axis (last row of W).
void shape_gradient(const Local& local, const Camera& camera, const Floats* dA, const Floats* dB,
                    Floats* d_scales, Floats* dR, Floats* dT, Floats* d_axis) {
    for (int k = 0; k < 6; ++k) dT[k] = Floats{};
    for (int k = 0; k < 3; ++k) d_axis[k] = Floats{};
    for (int k = 0; k < 3; ++k) {
        Floats ds{};
        for (int i = 0; i < 3; ++i) {
            const Floats dM =
                local.T[i] * dA[k] + local.T[3 + i] * dA[3 + k] + camera.R[6 + i] * dB[k];
            const Floats scaled = local.R[3 * i + k] * local.s[k];
            ds += dM * local.R[3 * i + k];
            dR[3 * i + k] = dM * local.s[k];
            dT[i] += dA[k] * scaled;
            dT[3 + i] += dA[3 + k] * scaled;
            d_axis[i] += dB[k] * scaled;
        }
        d_scales[k] = ds * local.s[k];
    }
}

void unproject_lanes(const Splats& in, const Camera& camera, const float* pair_sums, Ints shown,
                     const SplatGradients& out, Floats* pose, int begin, int count) {
    Local local;
    fill_local(in, camera, begin, count, &local);
    Floats sums[kPairGradients], slope[2], dA[6], dB[3], dT[6], dR[9], d_axis[3];
    Floats d_scales[3], d_quats[4], logit;
    gather<kPairGradients>(pair_sums, 0, count, sums);
    gather<1>(in.opacities, begin, count, &logit);
    const Inverse K = inverse_of(local);
    depth_slope(local, K.low_pass, slope);
    CovarianceGradient g = covariance_gradient(local, K, sums);
    const SlopeGradient on = slope_gradient(K, slope, sums, &g);
    for (int k = 0; k < 3; ++k) {
        dA[k] = 2.0f * (g.xx * local.A[k] + g.xy * local.A[3 + k]) + on.x * local.B[k];
        dA[3 + k] = 2.0f * (g.xy * local.A[k] + g.yy * local.A[3 + k]) + on.y * local.B[k];
        dB[k] = on.x * local.A[k] + on.y * local.A[3 + k];
    }
    shape_gradient(local, camera, dA, dB, d_scales, dR, dT, d_axis);
    quaternion_gradient(local, dR, d_quats);
    Floats dp[3], d_ray[3] = {Floats{}, Floats{}, Floats{}}, d_mean[3];
    point_gradient(local, camera, K, slope, sums, dT, dp);
    if (in.harmonics != nullptr)
        write_harmonics(in, camera, local, sums + kRed, shown, out.harmonics, begin, count, d_ray);
    for (int k = 0; k < 3; ++k)
        d_mean[k] = camera.R[k] * dp[0] + camera.R[3 + k] * dp[1] + camera.R[6 + k] * dp[2] +
                    d_ray[k];
    add_pose_gradient(local, camera, shown, dp, dT, d_axis, d_ray, pose);
    Floats d_logit = sums[kE] / (1.0f + exp(logit));
    write<3>(d_mean, shown, out.means, begin, count);
    write<4>(d_quats, shown, out.quats, begin, count);
    write<3>(d_scales, shown, out.scales_log, begin, count);
    write<1>(&d_logit, shown, out.opacities, begin, count);
    write<3>(sums + kRed, shown, out.colors, begin, count);
}

}  // namespace

void unproject_gradients(const Splats& in, const Camera& camera, const float* pair_sums,
                         const float* shown, const SplatGradients& out, float* d_pose, int begin,
                         int end) {
    Floats pose[kPoseEntries];
    for (Floats& entry : pose) entry = Floats{};
    for (int at = begin; at < end; at += kLanes) {
        const int row = at - begin;
        const Ints mask = load_some(shown + row, end - at) > 0.0f;
        unproject_lanes(in, camera, pair_sums + row * kPairGradients, mask, out, pose, at,
                        end - at);
    }
    for (int k = 0; k < kPoseEntries; ++k) d_pose[k] = sum(pose[k]);
}

}  // namespace splat::SPLAT_ISA
