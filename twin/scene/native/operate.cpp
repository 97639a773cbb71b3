// The drawn image as a linear map of what the Gaussians carry: planes = A values, with A the
// weights of the last drawing. Here A, its transpose and sums by label, one tile at a time; and the
// depth of the surface, which is no linear map.
#include "tile.hpp"

namespace splat::SPLAT_ISA {

namespace {

// Weights of one Gaussian in a tile; only blocks within its reach are filled.
struct alignas(64) Weights {
    float light[kTilePixels];
    float weight[kTilePixels];
};

Reach fill_weights(const Projected& g, const TileJob& job, float log2_cut, Weights* tile) {
    const Reach reach = reach_of(g, job);
    const Grid grid = block_grid();
    for (int y = reach.y0; y < reach.y1; ++y) {
        const RowShape shape = row_shape(g, job, y, grid);
        for (int x = reach.x0; x < reach.x1; ++x) {
            const int at = block_at(y, x);
            const Floats alpha = alpha_of(log2_alpha(g, shape, offsets(g, job, x, grid)), log2_cut);
            const Floats light = load(tile->light + at);
            const Floats weight = alpha * light;
            store(tile->light + at, light - weight);
            store(tile->weight + at, weight);
        }
    }
    return reach;
}

template <class Visit>
void each_block(const Reach& reach, Visit visit) {
    for (int y = reach.y0; y < reach.y1; ++y)
        for (int x = reach.x0; x < reach.x1; ++x) visit(block_at(y, x));
}

}  // namespace

void draw_tile_features(const Projected* projected, const TileJob& job, const Camera& camera,
                        const Settings& settings, const FeatureBlock& block, float* tile_planes,
                        float* planes) {
    Weights tile;
    start_light(job, camera, tile.light);
    __builtin_memset(tile_planes, 0, sizeof(float) * block.count * kTilePixels);
    const float log2_cut = std::log2(settings.alpha_cut);
    for (int i = 0; i < job.count; ++i) {
        const Reach reach = fill_weights(projected[job.ids[i]], job, log2_cut, &tile);
        const float* row = block.values + static_cast<std::int64_t>(job.ids[i]) * block.stride;
        for (int k = 0; k < block.count; ++k) {
            float* plane = tile_planes + k * kTilePixels;
            const float value = row[k];
            each_block(reach, [&](int at) {
                store(plane + at, load(plane + at) + load(tile.weight + at) * value);
            });
        }
    }
    const std::int64_t plane_size = static_cast<std::int64_t>(camera.width) * camera.height;
    each_four(job, camera, [&](int in_tile, int in_image, int count) {
        for (int k = 0; k < block.count; ++k)
            copy_four(planes + k * plane_size + in_image, tile_planes + k * kTilePixels + in_tile,
                      count);
    });
}

void lift_tile(const Projected* projected, const TileJob& job, const Camera& camera,
               const Settings& settings, const float* planes, int num_planes, float* tile_planes,
               float* pair_sums) {
    Weights tile;
    start_light(job, camera, tile.light);
    __builtin_memset(tile_planes, 0, sizeof(float) * num_planes * kTilePixels);
    const std::int64_t plane_size = static_cast<std::int64_t>(camera.width) * camera.height;
    each_four(job, camera, [&](int in_tile, int in_image, int count) {
        for (int k = 0; k < num_planes; ++k)
            copy_four(tile_planes + k * kTilePixels + in_tile, planes + k * plane_size + in_image,
                      count);
    });
    const float log2_cut = std::log2(settings.alpha_cut);
    for (int i = 0; i < job.count; ++i) {
        const Reach reach = fill_weights(projected[job.ids[i]], job, log2_cut, &tile);
        float* row = pair_sums + static_cast<std::int64_t>(i) * num_planes;
        for (int k = 0; k < num_planes; ++k) {
            const float* plane = tile_planes + k * kTilePixels;
            Floats total = Floats{};
            each_block(reach, [&](int at) { total += load(tile.weight + at) * load(plane + at); });
            row[k] = sum(total);
        }
    }
}

void label_tile(const Projected* projected, const TileJob& job, const Camera& camera,
                const Settings& settings, const int* slots, float* label_weights) {
    Weights tile;
    start_light(job, camera, tile.light);
    const float log2_cut = std::log2(settings.alpha_cut);
    for (int i = 0; i < job.count; ++i) {
        const Reach reach = fill_weights(projected[job.ids[i]], job, log2_cut, &tile);
        float* plane = label_weights + static_cast<std::int64_t>(slots[i]) * kTilePixels;
        each_block(reach,
                   [&](int at) { store(plane + at, load(plane + at) + load(tile.weight + at)); });
    }
}

namespace {

struct alignas(64) SurfaceTile {
    float light[kTilePixels], median[kTilePixels];
    float off[kTilePixels], weight[kTilePixels];  // sums over what lies near the median
};

// Front to back, ``visit(block, light before, light after, depth)``.
template <class Visit>
void each_depth(const Projected* projected, const TileJob& job, float log2_cut, float* light,
                Visit visit) {
    const Grid grid = block_grid();
    for (int i = 0; i < job.count; ++i) {
        const Projected& g = projected[job.ids[i]];
        const Reach reach = reach_of(g, job);
        for (int y = reach.y0; y < reach.y1; ++y) {
            const RowShape shape = row_shape(g, job, y, grid);
            const Floats row_depth = g.depth + g.depth_y * shape.dy;
            for (int x = reach.x0; x < reach.x1; ++x) {
                const int at = block_at(y, x);
                const Floats dx = offsets(g, job, x, grid);
                const Floats alpha = alpha_of(log2_alpha(g, shape, dx), log2_cut);
                const Floats before = load(light + at), after = before - alpha * before;
                store(light + at, after);
                visit(at, before, after, row_depth + g.depth_x * dx);
            }
        }
    }
}

}  // namespace

void surface_tile(const Projected* projected, const TileJob& job, const Camera& camera,
                  const Settings& settings, float* plane) {
    SurfaceTile tile;
    __builtin_memset(&tile, 0, sizeof tile);
    const float log2_cut = std::log2(settings.alpha_cut);
    start_light(job, camera, tile.light);
    each_depth(projected, job, log2_cut, tile.light,
               [&](int at, Floats before, Floats after, Floats depth) {
                   const Ints here = (before > 0.5f) & (after <= 0.5f);
                   store(tile.median + at, here ? depth : load(tile.median + at));
               });
    start_light(job, camera, tile.light);
    each_depth(projected, job, log2_cut, tile.light,
               [&](int at, Floats before, Floats after, Floats depth) {
                   const Floats off = depth - load(tile.median + at);
                   const Ints near = positive(off) <= kSurfaceBand * load(tile.median + at);
                   const Floats weight = keep(near, before - after);
                   store(tile.off + at, load(tile.off + at) + weight * off);
                   store(tile.weight + at, load(tile.weight + at) + weight);
               });
    for (int at = 0; at < kTilePixels; at += kLanes) {
        const Floats median = load(tile.median + at), weight = load(tile.weight + at);
        const Ints there = (median > 0.0f) & (weight > 0.0f);
        store(tile.median + at, median + keep(there, load(tile.off + at) / weight));
    }
    each_four(job, camera, [&](int in_tile, int in_image, int count) {
        copy_four(plane + in_image, tile.median + in_tile, count);
    });
}

}  // namespace splat::SPLAT_ISA
