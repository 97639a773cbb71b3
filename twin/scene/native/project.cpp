// From Gaussians in the world to ellipses in the image, one Gaussian in each lane.
//
// Compiled once per instruction set, with contraction off so that all sort depths alike.
#include "ellipse.hpp"

namespace splat::SPLAT_ISA {

namespace {

struct Cut {
    float alpha, log2_alpha;
};

void seen_colors(const Splats& in, const Camera& camera, const Local& local, int begin, int count,
                 Floats* rgb) {
    gather<3>(in.colors, begin, count, rgb);
    if (in.harmonics == nullptr) return;
    Floats direction[3];
    view_direction(local, camera, direction);
    Floats basis[kNumHarmonics], h[3 * kNumHarmonics];
    harmonic_basis(direction, basis);
    gather<3 * kNumHarmonics>(in.harmonics, begin, count, h);
    for (int k = 0; k < kNumHarmonics; ++k)
        for (int c = 0; c < 3; ++c) rgb[c] += basis[k] * h[3 * k + c];
}

// The members of Projected in their order.
enum Member {
    kU, kV, kA, kB, kC, kLog2Opacity, kRgb, kZ = kRgb + 3, kZx, kZy, kHalfX, kHalfY, kMembers
};
static_assert(sizeof(Projected) == kMembers * sizeof(float), "Projected is floats");

void project_lanes(const Splats& in, const Camera& camera, const Cut& cut, int begin, int count,
                   float* out) {
    Local local;
    fill_local(in, camera, begin, count, &local);
    const Floats z = local.p[2];
    const Floats xx = local.xx + kMipVariance, yy = local.yy + kMipVariance;
    const Floats det_raw = image_determinant(local.A);
    const Floats det = low_pass_determinant(local, det_raw);
    Floats logit;
    gather<1>(in.opacities, begin, count, &logit);
    const Floats compensation = root(at_least(det_raw / det, kMinMipRatio));
    const Floats opacity = compensation / (1.0f + exp(-logit));
    // Comparisons with NaN are false.
    Ints shown = (z > kNearDepth) & (z < 1e6f) & (det > 0.0f) & (det < 1e30f);
    shown &= opacity > cut.alpha;

    Floats member[kMembers];
    member[kU] = camera.fx * local.p[0] * local.inverse_z + camera.cx;
    member[kV] = camera.fy * local.p[1] * local.inverse_z + camera.cy;
    const Floats half_log2e_over_det = 0.5f * kLog2E / det;
    member[kA] = yy * half_log2e_over_det;
    member[kB] = -2.0f * local.xy * half_log2e_over_det;
    member[kC] = xx * half_log2e_over_det;
    member[kLog2Opacity] = log2(opacity);
    seen_colors(in, camera, local, begin, count, member + kRgb);
    member[kZ] = z;
    depth_slope(local, 1.0f / det, member + kZx);
    // exp(-r^2 / 2) = cut / opacity
    const Floats radius2 = 2.0f / kLog2E * at_least(member[kLog2Opacity] - cut.log2_alpha, 0.0f);
    const Floats half_x = root(radius2 * xx), half_y = root(radius2 * yy);
    Floats total = half_x + half_y;
    for (int k = 0; k < kHalfX; ++k) total += member[k];
    shown &= total - total == 0.0f;  // all are finite
    shown &= (member[kU] + half_x > 0.0f) & (member[kU] - half_x < camera.width * 1.0f);
    shown &= (member[kV] + half_y > 0.0f) & (member[kV] - half_y < camera.height * 1.0f);
    member[kHalfX] = shown ? half_x : all(-1.0f);
    member[kHalfY] = half_y;
    scatter<kMembers>(member, out, begin, count);
}

}  // namespace

void project(const Splats& in, const Camera& camera, const Settings& settings, Projected* out,
             int begin, int end) {
    const Cut cut{settings.alpha_cut, log2(all(settings.alpha_cut))[0]};
    for (int at = begin; at < end; at += kLanes)
        project_lanes(in, camera, cut, at, end - at, reinterpret_cast<float*>(out));
}

}  // namespace splat::SPLAT_ISA
