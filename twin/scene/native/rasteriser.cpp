// Order by depth, deal to tiles, draw, and gather gradients: the same bits for any thread count.
//
// Tiles write disjoint pixels, and every (Gaussian, tile) pair owns a row of the gradient buffer;
// the rows of one Gaussian are then added in tile order. No atomics.
#include "rasteriser.hpp"

#include <algorithm>
#include <cstring>

namespace splat {

namespace {

constexpr int kProjectBlock = 2048;
constexpr int kDigitBits = 11;
constexpr int kDigits = 1 << kDigitBits;

}  // namespace

const Kernels* kernels_named(const char* name) {
    const bool automatic = std::strcmp(name, "auto") == 0;
#ifdef SPLAT_HAS_V3
    const bool has_v3 = __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma");
    if (has_v3 && (automatic || std::strcmp(name, "v3") == 0)) return &v3::kernels;
#endif
    return automatic || std::strcmp(name, "base") == 0 ? &base::kernels : nullptr;
}

Rasteriser::TileRange Rasteriser::tiles_of(const Projected& g) const {
    const auto tile = [](float pixel, int limit) {
        const float at = pixel / kTile;
        return at <= 0 ? 0 : (at >= limit ? limit : static_cast<int>(at));
    };
    TileRange range;
    range.x0 = tile(g.u - g.half_x, tiles_x_);
    range.y0 = tile(g.v - g.half_y, tiles_y_);
    range.x1 = std::min(tile(g.u + g.half_x, tiles_x_) + 1, tiles_x_);
    range.y1 = std::min(tile(g.v + g.half_y, tiles_y_) + 1, tiles_y_);
    return range;
}

// Radix sort, least digit first: stable, so equal depths keep the order of their indices.
void Rasteriser::sort_by_depth() {
    order_.clear();
    keys_.clear();
    for (int i = 0; i < count_; ++i) {
        if (!visible(i)) continue;
        std::uint32_t key;  // depths are positive, so their bits sort like the numbers
        std::memcpy(&key, &projected_[i].depth, sizeof key);
        order_.push_back(static_cast<std::uint32_t>(i));
        keys_.push_back(key);
    }
    const std::size_t n = order_.size();
    order_scratch_.resize(n);
    keys_scratch_.resize(n);
    for (int shift = 0; shift < 32; shift += kDigitBits) {
        std::uint32_t starts[kDigits + 1] = {0};
        for (const std::uint32_t key : keys_) ++starts[((key >> shift) & (kDigits - 1)) + 1];
        for (int digit = 0; digit < kDigits; ++digit) starts[digit + 1] += starts[digit];
        for (std::size_t i = 0; i < n; ++i) {
            const std::uint32_t to = starts[(keys_[i] >> shift) & (kDigits - 1)]++;
            order_scratch_[to] = order_[i];
            keys_scratch_[to] = keys_[i];
        }
        order_.swap(order_scratch_);
        keys_.swap(keys_scratch_);
    }
}

void Rasteriser::fill_tiles() {
    tile_begin_.assign(static_cast<std::size_t>(tiles_x_) * tiles_y_ + 1, 0);
    slot_begin_.resize(order_.size() + 1);
    slot_begin_[0] = 0;
    for (std::size_t i = 0; i < order_.size(); ++i) {
        const TileRange range = tiles_of(projected_[order_[i]]);
        for (int y = range.y0; y < range.y1; ++y)
            for (int x = range.x0; x < range.x1; ++x) ++tile_begin_[y * tiles_x_ + x + 1];
        slot_begin_[i + 1] = slot_begin_[i] + static_cast<std::int64_t>(range.x1 - range.x0) *
                                                  (range.y1 - range.y0);
    }
    for (std::size_t tile = 1; tile < tile_begin_.size(); ++tile)
        tile_begin_[tile] += tile_begin_[tile - 1];
    tile_ids_.resize(tile_begin_.back());
    slots_.resize(tile_begin_.back());
    std::vector<std::int64_t> next(tile_begin_.begin(), tile_begin_.end() - 1);
    for (std::size_t i = 0; i < order_.size(); ++i) {
        const TileRange range = tiles_of(projected_[order_[i]]);
        std::int64_t slot = slot_begin_[i];
        for (int y = range.y0; y < range.y1; ++y)
            for (int x = range.x0; x < range.x1; ++x) {
                const std::int64_t at = next[y * tiles_x_ + x]++;
                tile_ids_[at] = order_[i];
                slots_[slot++] = at;
            }
    }
}

TileJob Rasteriser::job(int tile) const {
    return TileJob{(tile % tiles_x_) * kTile, (tile / tiles_x_) * kTile,
                   tile_ids_.data() + tile_begin_[tile],
                   static_cast<int>(tile_begin_[tile + 1] - tile_begin_[tile])};
}

void Rasteriser::draw(const Splats& splats, int count, const Camera& camera,
                      const Settings& settings, float* planes) {
    count_ = count;
    camera_ = camera;
    settings_ = settings;
    tiles_x_ = (camera.width + kTile - 1) / kTile;
    tiles_y_ = (camera.height + kTile - 1) / kTile;
    projected_.resize(count);
#pragma omp parallel for schedule(static) num_threads(threads_)
    for (int begin = 0; begin < count; begin += kProjectBlock)
        kernels_.project(splats, camera, settings, projected_.data(), begin,
                         std::min(begin + kProjectBlock, count));
    sort_by_depth();
    fill_tiles();
    const int num_tiles = tiles_x_ * tiles_y_;
    drawn_.resize(num_tiles);
#pragma omp parallel for schedule(dynamic, 4) num_threads(threads_)
    for (int tile = 0; tile < num_tiles; ++tile)
        drawn_[tile] =
            kernels_.draw_tile(projected_.data(), job(tile), camera_, settings_, planes);
}

void Rasteriser::pull(const Splats& splats, const float* planes, const float* plane_gradients,
                      const SplatGradients& out) {
    const std::size_t n = count_;
    std::memset(out.means, 0, 3 * n * sizeof(float));
    std::memset(out.quats, 0, 4 * n * sizeof(float));
    std::memset(out.scales_log, 0, 3 * n * sizeof(float));
    std::memset(out.opacities, 0, n * sizeof(float));
    std::memset(out.colors, 0, 3 * n * sizeof(float));
    pair_gradients_.resize(tile_ids_.size() * kPairGradients);
    const int num_tiles = tiles_x_ * tiles_y_;
#pragma omp parallel for schedule(dynamic, 4) num_threads(threads_)
    for (int tile = 0; tile < num_tiles; ++tile) {
        TileJob drawn = job(tile);
        float* rows = pair_gradients_.data() + tile_begin_[tile] * kPairGradients;
        std::memset(rows + static_cast<std::int64_t>(drawn_[tile]) * kPairGradients, 0,
                    static_cast<std::size_t>(drawn.count - drawn_[tile]) * kPairGradients *
                        sizeof(float));
        drawn.count = drawn_[tile];
        kernels_.draw_tile_gradients(projected_.data(), drawn, camera_, settings_, planes,
                                     plane_gradients, rows);
    }
    const int num_visible = static_cast<int>(order_.size());
#pragma omp parallel for schedule(static) num_threads(threads_)
    for (int i = 0; i < num_visible; ++i) {
        float sums[kPairGradients] = {0};
        for (std::int64_t slot = slot_begin_[i]; slot < slot_begin_[i + 1]; ++slot) {
            const float* row = pair_gradients_.data() + slots_[slot] * kPairGradients;
            for (int k = 0; k < kPairGradients; ++k) sums[k] += row[k];
        }
        const int index = static_cast<int>(order_[i]);
        kernels_.unproject_gradients(splats, camera_, projected_[index], sums, out, index);
    }
}

}  // namespace splat
