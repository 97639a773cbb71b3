// Drawing one tile and the gradients of one tile, front to back; a row of pixels is a vector.
//
// Paper Eq. 2 with the product transmittance of the errata: w_i = alpha_i prod_{j<i}(1 - alpha_j).
// Planes: sum w rgb, sum w depth, sum w.
#include <cmath>

#include "kernels_isa.hpp"
#include "lanes.hpp"

namespace splat::SPLAT_ISA {

namespace {

constexpr int kPixels = kTile * kTile;
constexpr int kChunks = kTile / kLanes;
constexpr int kStopPeriod = 16;  // Gaussians between two looks at whether the tile is opaque

struct alignas(64) Tile {
    float light[kPixels];  // transmittance; 0 outside the image
    float planes[kPlanes][kPixels];
};

struct Reach {
    int y0, y1, c0, c1;  // rows and chunks of the tile that a Gaussian can touch, ends excluded
};

int floor_int(float value, int low, int high) {
    const float down = std::floor(value);
    return down < low ? low : (down > high ? high : static_cast<int>(down));
}

Reach reach_of(const Projected& g, const TileJob& job) {
    const float u = g.u - job.x0 - 0.5f, v = g.v - job.y0 - 0.5f;
    Reach reach;
    reach.y0 = floor_int(v - g.half_y + 1.0f, 0, kTile);
    reach.y1 = floor_int(v + g.half_y, -1, kTile - 1) + 1;
    reach.c0 = floor_int(u - g.half_x + 1.0f, 0, kTile) / kLanes;
    reach.c1 = (floor_int(u + g.half_x, -1, kTile - 1) + kLanes) / kLanes;
    return reach;
}

void start_light(const TileJob& job, const Camera& camera, float* light) {
    for (int y = 0; y < kTile; ++y)
        for (int x = 0; x < kTile; ++x)
            light[y * kTile + x] =
                job.x0 + x < camera.width && job.y0 + y < camera.height ? 1.0f : 0.0f;
}

bool opaque(const float* light, float stop) {
    Ints open = Ints{};
    for (int i = 0; i < kPixels; i += kLanes) open |= load(light + i) > stop;
    std::int32_t any = 0;
    for (int i = 0; i < kLanes; ++i) any |= open[i];
    return any == 0;
}

Floats columns() {
    Floats x;
    for (int i = 0; i < kLanes; ++i) x[i] = static_cast<float>(i);
    return x;
}

// Copy between a tile and planes of the whole image, honouring the image border.
template <class Move>
void each_row(const TileJob& job, const Camera& camera, Move move) {
    const int width = camera.width - job.x0 < kTile ? camera.width - job.x0 : kTile;
    const int height = camera.height - job.y0 < kTile ? camera.height - job.y0 : kTile;
    for (int y = 0; y < height; ++y)
        for (int x = 0; x < width; ++x)
            move(y * kTile + x, (job.y0 + y) * camera.width + job.x0 + x);
}

void draw_gaussian(const Projected& g, const TileJob& job, float log2_cut, Tile* tile) {
    const Reach reach = reach_of(g, job);
    const Floats x = columns();
    for (int y = reach.y0; y < reach.y1; ++y) {
        const float dy = job.y0 + y + 0.5f - g.v;
        const Floats row = all(g.log2_opacity - g.c * dy * dy);
        const float b_dy = g.b * dy;
        for (int c = reach.c0; c < reach.c1; ++c) {
            const int at = y * kTile + c * kLanes;
            const Floats dx = x + (job.x0 + c * kLanes + 0.5f - g.u);
            const Floats power = row - dx * (g.a * dx + b_dy);
            const Floats alpha =
                keep(power >= log2_cut, smaller(exp2(power), all(kMaxAlpha)));
            const Floats light = load(tile->light + at);
            const Floats weight = alpha * light;
            store(tile->light + at, light - weight);
            for (int k = 0; k < 3; ++k)
                store(tile->planes[k] + at, load(tile->planes[k] + at) + weight * g.rgb[k]);
            store(tile->planes[3] + at, load(tile->planes[3] + at) + weight * g.depth);
            store(tile->planes[4] + at, load(tile->planes[4] + at) + weight);
        }
    }
}

struct alignas(64) GradientTile {
    float light[kPixels];
    float planes[kPlanes][kPixels];  // dL/dplane
    float behind[kPixels];           // dL/dplane . (contributions not yet passed)
};

void pull_gaussian(const Projected& g, const TileJob& job, float log2_cut, float log2_max,
                   GradientTile* tile, float* out) {
    const Reach reach = reach_of(g, job);
    const Floats x = columns();
    Floats e0{}, ex{}, ey{}, exx{}, exy{}, eyy{}, red{}, green{}, blue{}, depth{};
    for (int y = reach.y0; y < reach.y1; ++y) {
        const float dy = job.y0 + y + 0.5f - g.v;
        const Floats row = all(g.log2_opacity - g.c * dy * dy);
        const float b_dy = g.b * dy;
        Floats row_e{}, row_ex{};
        for (int c = reach.c0; c < reach.c1; ++c) {
            const int at = y * kTile + c * kLanes;
            const Floats dx = x + (job.x0 + c * kLanes + 0.5f - g.u);
            const Floats power = row - dx * (g.a * dx + b_dy);
            const Floats alpha =
                keep(power >= log2_cut, smaller(exp2(power), all(kMaxAlpha)));
            const Floats light = load(tile->light + at);
            const Floats weight = alpha * light;
            const Floats g_red = load(tile->planes[0] + at), g_green = load(tile->planes[1] + at);
            const Floats g_blue = load(tile->planes[2] + at), g_depth = load(tile->planes[3] + at);
            const Floats value = g_red * g.rgb[0] + g_green * g.rgb[1] + g_blue * g.rgb[2] +
                                 g_depth * g.depth + load(tile->planes[4] + at);
            const Floats behind = load(tile->behind + at) - weight * value;
            store(tile->behind + at, behind);
            store(tile->light + at, light - weight);
            const Floats d_alpha = light * value - behind / (1.0f - alpha);
            // A clamped alpha no longer depends on the Gaussian's shape.
            const Floats e = keep(power < log2_max, d_alpha * alpha);
            row_e += e;
            row_ex += e * dx;
            exx += e * dx * dx;
            red += weight * g_red;
            green += weight * g_green;
            blue += weight * g_blue;
            depth += weight * g_depth;
        }
        e0 += row_e;
        ex += row_ex;
        ey += row_e * dy;
        exy += row_ex * dy;
        eyy += row_e * (dy * dy);
    }
    const Floats sums[kPairGradients] = {e0, ex, ey, exx, exy, eyy, red, green, blue, depth};
    for (int k = 0; k < kPairGradients; ++k) out[k] = sum(sums[k]);
}

}  // namespace

int draw_tile(const Projected* projected, const TileJob& job, const Camera& camera,
              const Settings& settings, float* planes) {
    Tile tile;
    start_light(job, camera, tile.light);
    __builtin_memset(tile.planes, 0, sizeof tile.planes);
    const float log2_cut = std::log2(settings.alpha_cut);
    int drawn = 0;
    while (drawn < job.count) {
        draw_gaussian(projected[job.ids[drawn]], job, log2_cut, &tile);
        ++drawn;
        if (drawn % kStopPeriod == 0 && opaque(tile.light, settings.transmittance_stop)) break;
    }
    const int plane_size = camera.width * camera.height;
    each_row(job, camera, [&](int in_tile, int in_image) {
        for (int k = 0; k < kPlanes; ++k)
            planes[k * plane_size + in_image] = tile.planes[k][in_tile];
    });
    return drawn;
}

void draw_tile_gradients(const Projected* projected, const TileJob& job, const Camera& camera,
                         const Settings& settings, const float* planes,
                         const float* plane_gradients, float* pair_gradients) {
    GradientTile tile;
    start_light(job, camera, tile.light);
    __builtin_memset(tile.planes, 0, sizeof tile.planes);
    __builtin_memset(tile.behind, 0, sizeof tile.behind);
    const int plane_size = camera.width * camera.height;
    each_row(job, camera, [&](int in_tile, int in_image) {
        for (int k = 0; k < kPlanes; ++k) {
            const int at = k * plane_size + in_image;
            tile.planes[k][in_tile] = plane_gradients[at];
            tile.behind[in_tile] += plane_gradients[at] * planes[at];
        }
    });
    const float log2_cut = std::log2(settings.alpha_cut), log2_max = std::log2(kMaxAlpha);
    for (int i = 0; i < job.count; ++i)
        pull_gaussian(projected[job.ids[i]], job, log2_cut, log2_max, &tile,
                      pair_gradients + static_cast<std::int64_t>(i) * kPairGradients);
}

}  // namespace splat::SPLAT_ISA
