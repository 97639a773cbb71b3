// Projection, depth order, tiles, and the backward pass.
//
// Every result has the same bits for any number of threads: a tile is drawn by one thread, each
// (Gaussian, tile) pair owns a row of a buffer, and the rows of one Gaussian are then added in
// tile order. No atomics.
#include "rasteriser.hpp"

#include <algorithm>
#include <cstring>

#include "threads.hpp"

namespace splat {

namespace {

constexpr int kProjectBlock = 2048;
constexpr int kGatherBlock = 128;  // Gaussians whose gradients are gathered together
constexpr int kDigitBits = 11;
constexpr int kDigits = 1 << kDigitBits;
constexpr int kPasses = 3;

}  // namespace

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

void Rasteriser::project(const Splats& splats) {
    projected_.resize(count_);
    ranges_.resize(count_);
    slot_begin_.resize(count_ + 1);
    slot_begin_[0] = 0;
#pragma omp parallel for schedule(static) num_threads(threads_)
    for (int begin = 0; begin < count_; begin += kProjectBlock) {
        const int end = std::min(begin + kProjectBlock, count_);
        kernels_.project(splats, camera_, settings_, projected_.data(), begin, end);
        for (int i = begin; i < end; ++i) {
            ranges_[i] = visible(i) ? tiles_of(projected_[i]) : TileRange{0, 0, 0, 0};
            slot_begin_[i + 1] = static_cast<std::int64_t>(ranges_[i].x1 - ranges_[i].x0) *
                                 (ranges_[i].y1 - ranges_[i].y0);
        }
    }
    for (int i = 0; i < count_; ++i) slot_begin_[i + 1] += slot_begin_[i];
}

// Radix sort, least digit first: stable, so equal depths keep the order of their indices.
void Rasteriser::sort_by_depth() {
    std::uint32_t starts[kPasses][kDigits + 1] = {};
    entries_.clear();
    for (int i = 0; i < count_; ++i) {
        if (slot_begin_[i + 1] == slot_begin_[i]) continue;
        std::uint32_t key;  // depths are positive, so their bits sort like the numbers
        std::memcpy(&key, &projected_[i].depth, sizeof key);
        entries_.push_back(std::uint64_t{key} << 32 | static_cast<std::uint32_t>(i));
        for (int pass = 0; pass < kPasses; ++pass)
            ++starts[pass][((key >> (pass * kDigitBits)) & (kDigits - 1)) + 1];
    }
    other_entries_.resize(entries_.size());
    for (int pass = 0; pass < kPasses; ++pass) {
        const int shift = 32 + pass * kDigitBits;
        for (int digit = 0; digit < kDigits; ++digit)
            starts[pass][digit + 1] += starts[pass][digit];
        for (const std::uint64_t entry : entries_)
            other_entries_[starts[pass][(entry >> shift) & (kDigits - 1)]++] = entry;
        entries_.swap(other_entries_);
    }
    order_.resize(entries_.size());
    std::transform(entries_.begin(), entries_.end(), order_.begin(),
                   [](std::uint64_t entry) { return static_cast<std::uint32_t>(entry); });
}

// Each thread takes a stretch of the depth order; what it writes follows what those in front of it
// write into the same tile, so that the stretches do not show in the result.
void Rasteriser::fill_tiles() {
    const int tiles = num_tiles(), num_order = static_cast<int>(order_.size());
    const int stretches = std::max(1, std::min(threads_, num_order / kProjectBlock));
    const auto stretch_begin = [&](int stretch) {
        return static_cast<int>(static_cast<std::int64_t>(num_order) * stretch / stretches);
    };
    next_.assign(static_cast<std::size_t>(tiles) * stretches, 0);
#pragma omp parallel for schedule(static, 1) num_threads(threads_)
    for (int stretch = 0; stretch < stretches; ++stretch) {
        std::int64_t* counts = next_.data() + static_cast<std::int64_t>(stretch) * tiles;
        for (int i = stretch_begin(stretch); i < stretch_begin(stretch + 1); ++i) {
            const TileRange& range = ranges_[order_[i]];
            for (int y = range.y0; y < range.y1; ++y)
                for (int x = range.x0; x < range.x1; ++x) ++counts[y * tiles_x_ + x];
        }
    }
    tile_begin_.resize(tiles + 1);
    std::int64_t total = 0;
    for (int tile = 0; tile < tiles; ++tile) {
        tile_begin_[tile] = total;
        for (int stretch = 0; stretch < stretches; ++stretch) {
            const std::int64_t count = next_[static_cast<std::int64_t>(stretch) * tiles + tile];
            next_[static_cast<std::int64_t>(stretch) * tiles + tile] = total;
            total += count;
        }
    }
    tile_begin_[tiles] = total;
    tile_ids_.resize(total);
    slots_.resize(total);
#pragma omp parallel for schedule(static, 1) num_threads(threads_)
    for (int stretch = 0; stretch < stretches; ++stretch) {
        std::int64_t* next = next_.data() + static_cast<std::int64_t>(stretch) * tiles;
        for (int i = stretch_begin(stretch); i < stretch_begin(stretch + 1); ++i) {
            const std::uint32_t index = order_[i];
            const TileRange& range = ranges_[index];
            std::int64_t slot = slot_begin_[index];
            for (int y = range.y0; y < range.y1; ++y)
                for (int x = range.x0; x < range.x1; ++x) {
                    const std::int64_t at = next[y * tiles_x_ + x]++;
                    tile_ids_[at] = index;
                    slots_[slot++] = at;
                }
        }
    }
}

TileJob Rasteriser::job(int tile) const {
    return TileJob{(tile % tiles_x_) * kTile, (tile / tiles_x_) * kTile,
                   tile_ids_.data() + tile_begin_[tile],
                   static_cast<int>(tile_begin_[tile + 1] - tile_begin_[tile])};
}

TileJob Rasteriser::drawn_job(int tile) const {
    TileJob drawn = job(tile);
    drawn.count = drawn_[tile];
    return drawn;
}

void Rasteriser::draw(const Splats& splats, int count, const Camera& camera,
                      const Settings& settings, float* planes) {
    count_ = count;
    camera_ = camera;
    settings_ = settings;
    tiles_x_ = (camera.width + kTile - 1) / kTile;
    tiles_y_ = (camera.height + kTile - 1) / kTile;
    project(splats);
    sort_by_depth();
    fill_tiles();
    drawn_.resize(num_tiles());
#pragma omp parallel for schedule(dynamic, 4) num_threads(threads_)
    for (int tile = 0; tile < num_tiles(); ++tile)
        drawn_[tile] =
            kernels_.draw_tile(projected_.data(), job(tile), camera_, settings_, planes);
}

// The rows of a tile's pairs; those that were not drawn are zero.
float* Rasteriser::begin_pair_rows(int tile, int row_floats) {
    float* rows = pair_rows_.data() + tile_begin_[tile] * row_floats;
    const std::int64_t undrawn = tile_begin_[tile + 1] - tile_begin_[tile] - drawn_[tile];
    std::memset(rows + static_cast<std::int64_t>(drawn_[tile]) * row_floats, 0,
                static_cast<std::size_t>(undrawn) * row_floats * sizeof(float));
    return rows;
}

void Rasteriser::add_pair_rows(int index, int row_floats, float* sums) const {
    for (std::int64_t slot = slot_begin_[index]; slot < slot_begin_[index + 1]; ++slot) {
        const float* row = pair_rows_.data() + slots_[slot] * row_floats;
        for (int k = 0; k < row_floats; ++k) sums[k] += row[k];
    }
}

void Rasteriser::pull(const Splats& splats, const float* planes, const float* plane_gradients,
                      const SplatGradients& out, double* d_pose) {
    pair_rows_.resize(tile_ids_.size() * kPairGradients);
#pragma omp parallel for schedule(dynamic, 4) num_threads(threads_)
    for (int tile = 0; tile < num_tiles(); ++tile)
        kernels_.draw_tile_gradients(projected_.data(), drawn_job(tile), camera_, settings_,
                                     planes, plane_gradients,
                                     begin_pair_rows(tile, kPairGradients));
    const int num_blocks = (count_ + kGatherBlock - 1) / kGatherBlock;
    pose_sums_.resize(static_cast<std::size_t>(num_blocks) * kPoseEntries);
#pragma omp parallel for schedule(static) num_threads(threads_)
    for (int block = 0; block < num_blocks; ++block) {
        float sums[kGatherBlock * kPairGradients] = {0}, shown[kGatherBlock];
        const int begin = block * kGatherBlock, end = std::min(begin + kGatherBlock, count_);
        for (int index = begin; index < end; ++index) {
            shown[index - begin] = slot_begin_[index] < slot_begin_[index + 1] ? 1.0f : 0.0f;
            add_pair_rows(index, kPairGradients, sums + (index - begin) * kPairGradients);
        }
        kernels_.unproject_gradients(
            splats, camera_, sums, shown, out,
            pose_sums_.data() + static_cast<std::int64_t>(block) * kPoseEntries, begin, end);
    }
    std::fill(d_pose, d_pose + kPoseEntries, 0.0);
    for (std::size_t i = 0; i < pose_sums_.size(); ++i) d_pose[i % kPoseEntries] += pose_sums_[i];
}

}  // namespace splat
