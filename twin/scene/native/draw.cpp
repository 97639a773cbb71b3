// Drawing one tile and the gradients of one tile, front to back; a block of pixels is a vector.
//
// Paper Eq. 2 with the product transmittance of the errata: w_i = alpha_i prod_{j<i}(1 - alpha_j).
// Planes: sum w rgb, sum w depth, sum w. Depth is that of the Gaussian's own surface at the pixel,
// depth + depth_x dx + depth_y dy: the densest point of the ray in it (Zhang et al. 2024, RaDe-GS).
#include "tile.hpp"

namespace splat::SPLAT_ISA {

namespace {

constexpr int kStopPeriod = 16;  // Gaussians between two looks at whether the tile is opaque

struct alignas(64) Tile {
    float light[kTilePixels];  // transmittance; 0 outside the image
    float planes[kPlanes][kTilePixels];
};

bool opaque(const float* light, float stop) {
    Ints open = Ints{};
    for (int i = 0; i < kTilePixels; i += kLanes) open |= load(light + i) > stop;
    std::int32_t any = 0;
    for (int i = 0; i < kLanes; ++i) any |= open[i];
    return any == 0;
}

void draw_gaussian(const Projected& g, const TileJob& job, float log2_cut, Tile* tile) {
    const Reach reach = reach_of(g, job);
    const Grid grid = block_grid();
    for (int y = reach.y0; y < reach.y1; ++y) {
        const RowShape shape = row_shape(g, job, y, grid);
        const Floats row_depth = g.depth + g.depth_y * shape.dy;
        for (int x = reach.x0; x < reach.x1; ++x) {
            const int at = block_at(y, x);
            const Floats dx = offsets(g, job, x, grid);
            const Floats alpha = alpha_of(log2_alpha(g, shape, dx), log2_cut);
            const Floats light = load(tile->light + at);
            const Floats weight = alpha * light;
            store(tile->light + at, light - weight);
            for (int k = 0; k < 3; ++k)
                store(tile->planes[k] + at, load(tile->planes[k] + at) + weight * g.rgb[k]);
            const Floats depth = row_depth + g.depth_x * dx;
            store(tile->planes[3] + at, load(tile->planes[3] + at) + weight * depth);
            store(tile->planes[4] + at, load(tile->planes[4] + at) + weight);
        }
    }
}

struct alignas(64) GradientTile {
    float light[kTilePixels];
    float planes[kPlanes][kTilePixels];  // dL/dplane
    float behind[kTilePixels];           // dL/dplane . (contributions not yet passed)
};

struct Limits {
    float log2_cut, log2_max;
};

void pull_gaussian(const Projected& g, const TileJob& job, Limits limits, GradientTile* tile,
                   float* out) {
    const Reach reach = reach_of(g, job);
    const Grid grid = block_grid();
    Floats e0{}, ex{}, ey{}, exx{}, exy{}, eyy{}, red{}, green{}, blue{};
    Floats depth{}, depth_x{}, depth_y{};
    for (int y = reach.y0; y < reach.y1; ++y) {
        const RowShape shape = row_shape(g, job, y, grid);
        const Floats row_depth = g.depth + g.depth_y * shape.dy;
        Floats row_e{}, row_ex{}, row_on_depth{};
        for (int x = reach.x0; x < reach.x1; ++x) {
            const int at = block_at(y, x);
            const Floats dx = offsets(g, job, x, grid);
            const Floats power = log2_alpha(g, shape, dx);
            const Floats alpha = alpha_of(power, limits.log2_cut);
            const Floats light = load(tile->light + at);
            const Floats weight = alpha * light;
            const Floats g_red = load(tile->planes[0] + at), g_green = load(tile->planes[1] + at);
            const Floats g_blue = load(tile->planes[2] + at), g_depth = load(tile->planes[3] + at);
            const Floats value = g_red * g.rgb[0] + g_green * g.rgb[1] + g_blue * g.rgb[2] +
                                 g_depth * (row_depth + g.depth_x * dx) +
                                 load(tile->planes[4] + at);
            const Floats behind = load(tile->behind + at) - weight * value;
            store(tile->behind + at, behind);
            store(tile->light + at, light - weight);
            const Floats d_alpha = light * value - behind / (1.0f - alpha);
            // A clamped alpha no longer depends on the Gaussian's shape.
            const Floats e = keep(power < limits.log2_max, d_alpha * alpha);
            row_e += e;
            row_ex += e * dx;
            exx += e * dx * dx;
            red += weight * g_red;
            green += weight * g_green;
            blue += weight * g_blue;
            const Floats on_depth = weight * g_depth;
            row_on_depth += on_depth;
            depth_x += on_depth * dx;
        }
        e0 += row_e;
        ex += row_ex;
        ey += row_e * shape.dy;
        exy += row_ex * shape.dy;
        eyy += row_e * (shape.dy * shape.dy);
        depth += row_on_depth;
        depth_y += row_on_depth * shape.dy;
    }
    const Floats4 first = four_sums(e0, ex, ey, exx), second = four_sums(exy, eyy, red, green);
    const Floats4 third = four_sums(blue, depth, depth_x, depth_y);
    __builtin_memcpy(out, &first, sizeof first);
    __builtin_memcpy(out + 4, &second, sizeof second);
    __builtin_memcpy(out + 8, &third, sizeof third);
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
    const std::int64_t plane_size = static_cast<std::int64_t>(camera.width) * camera.height;
    each_four(job, camera, [&](int in_tile, int in_image, int count) {
        for (int k = 0; k < kPlanes; ++k)
            copy_four(planes + k * plane_size + in_image, tile.planes[k] + in_tile, count);
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
    const std::int64_t plane_size = static_cast<std::int64_t>(camera.width) * camera.height;
    each_four(job, camera, [&](int in_tile, int in_image, int count) {
        Floats4 behind = Floats4{};
        for (int k = 0; k < kPlanes; ++k) {
            const std::int64_t at = k * plane_size + in_image;
            float drawn[kBlockWidth] = {0, 0, 0, 0};
            copy_four(tile.planes[k] + in_tile, plane_gradients + at, count);
            copy_four(drawn, planes + at, count);
            behind += load_four(tile.planes[k] + in_tile) * load_four(drawn);
        }
        store_four(tile.behind + in_tile, behind);
    });
    const Limits limits{std::log2(settings.alpha_cut), std::log2(kMaxAlpha)};
    for (int i = 0; i < job.count; ++i)
        pull_gaussian(projected[job.ids[i]], job, limits, &tile,
                      pair_gradients + static_cast<std::int64_t>(i) * kPairGradients);
}

}  // namespace splat::SPLAT_ISA
