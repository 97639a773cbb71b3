// Plain records shared by all parts of the rasteriser. No std:: containers here: these headers are
// compiled once per instruction set, and shared inline code would break the one-definition rule.
#pragma once

#include <cstdint>

namespace splat {

constexpr int kTile = 16;          // tile edge [px]
constexpr int kTilePixels = kTile * kTile;
constexpr int kBlockWidth = 4;     // a tile is stored in blocks of 4 x tall pixels
constexpr int kPlanes = 5;         // red, green, blue, depth, alpha
constexpr int kPairGradients = 12; // see PairGradient
constexpr int kPoseEntries = 12;   // a 3 x 4 matrix
constexpr int kNumHarmonics = 3;  // real spherical harmonics of degree 1
constexpr float kHarmonicFactor = 0.4886025119029199f;  // sqrt(3 / (4 pi))
constexpr float kMaxAlpha = 0.999f;
constexpr float kMipVariance = 0.1f;     // added to the image covariance [px^2]
constexpr float kMinMipRatio = 2.5e-5f;  // floor of det/det', bounds its gradient
constexpr float kSurfaceBand = 0.02f;    // what belongs to a surface, in its depth
constexpr float kNearDepth = 0.02f;      // nothing closer to the camera is drawn [m]

// Where a pixel of a tile is stored; ``tall`` rows make a block.
static inline int tile_index(int x, int y, int tall) {
    const int block = y / tall * (kTile / kBlockWidth) + x / kBlockWidth;
    return (block * tall + y % tall) * kBlockWidth + x % kBlockWidth;
}

struct Camera {
    float R[9];       // R_camera_world, row-major
    float t[3];       // p_camera_world [m]
    float centre[3];  // p_world_camera = -R^T t [m]
    float fx, fy, cx, cy;
    int width, height;
};

struct Settings {
    float alpha_cut;           // contributions below are dropped
    float transmittance_stop;  // a tile ends when all its pixels let less light through
};

// Inputs, one row per Gaussian.
struct Splats {
    const float* means;        // n x 3 [m]
    const float* quats;        // n x 4, wxyz, any length but zero
    const float* scales_log;   // n x 3
    const float* opacities;    // n, logits
    const float* colors;       // n x 3
    const float* harmonics;    // n x num_harmonics x 3; null where there are none
    int num_harmonics;         // 0 or 3
};

struct SplatGradients {
    float* means;
    float* quats;
    float* scales_log;
    float* opacities;
    float* colors;
    float* harmonics;  // null where there are none
};

// What the tile loops need of one projected Gaussian; opacity enters as log2.
struct Projected {
    float u, v;          // centre [px]
    float a, b, c;       // log2(alpha) = log2_opacity - (a dx^2 + b dx dy + c dy^2)
    float log2_opacity;  // after mip compensation
    float rgb[3];
    float depth;         // of the centre, along the optical axis [m]
    float depth_x, depth_y;  // how it changes over the image [m/px]
    float half_x, half_y;  // half extent where alpha reaches the cut [px]; half_x < 0: not visible
};

// Sums over the pixels of one (Gaussian, tile) pair; e = dL/dalpha * alpha.
enum PairGradient {
    kE, kEx, kEy, kExx, kExy, kEyy, kRed, kGreen, kBlue, kDepth, kDepthX, kDepthY
};

struct TileJob {
    int x0, y0;                // first pixel of the tile
    const std::uint32_t* ids;  // Gaussians in depth order
    int count;
};

}  // namespace splat
