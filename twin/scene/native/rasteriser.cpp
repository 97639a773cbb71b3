// Projection, depth order, tiles, and the backward pass.
//
// Every result has the same bits for any number of threads: a tile is drawn by one thread, each
// (Gaussian, tile) pair owns a row of a buffer, and the rows of one Gaussian are then added in
// tile order. No atomics.
#include "rasteriser.hpp"

#include <algorithm>
#include <iterator>

#include "threads.hpp"

namespace splat {

namespace {

constexpr int kProjectBlock = 2048;
constexpr int kGatherBlock = 128;  // Gaussians whose gradients are gathered together

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

void Rasteriser::project_block(const Splats& splats, int begin, int end) {
    kernels_.project(splats, camera_, settings_, projected_.data(), begin, end);
    for (int i = begin; i < end; ++i) {
        ranges_[i] = visible(i) ? tiles_of(projected_[i]) : TileRange{0, 0, 0, 0};
        slot_begin_[i + 1] = static_cast<std::int64_t>(ranges_[i].x1 - ranges_[i].x0) *
                             (ranges_[i].y1 - ranges_[i].y0);
    }
}

// A stretch is every so-manieth block, because neighbours in memory are neighbours in the scene and
// would be seen, and have to be sorted, together.
void Rasteriser::project(const Splats& splats) {
    projected_.resize(count_);
    ranges_.resize(count_);
    slot_begin_.resize(count_ + 1);
    slot_begin_[0] = 0;
    const int stretches = std::max(1, std::min(threads_, count_ / kProjectBlock));
    depth_order_.begin(stretches);
    {
        const InParallel timed(&parallel_s_);
#pragma omp parallel for schedule(static, 1) num_threads(threads_)
        for (int stretch = 0; stretch < stretches; ++stretch) {
            for (int begin = stretch * kProjectBlock; begin < count_;
                 begin += stretches * kProjectBlock) {
                const int end = std::min(begin + kProjectBlock, count_);
                project_block(splats, begin, end);
                for (int i = begin; i < end; ++i)
                    if (slot_begin_[i + 1] > 0) depth_order_.add(stretch, projected_[i].depth, i);
            }
            depth_order_.sort(stretch);
        }
    }
    for (int i = 0; i < count_; ++i) slot_begin_[i + 1] += slot_begin_[i];
    depth_order_.cut();
}

// Each thread takes a slice of the depth order and counts what it will write into each tile.
void Rasteriser::sort_and_count() {
    const int tiles = num_tiles(), slices = depth_order_.stretches();
    order_.resize(depth_order_.count());
    next_.assign(static_cast<std::size_t>(tiles) * slices, 0);
    const InParallel timed(&parallel_s_);
#pragma omp parallel for schedule(static, 1) num_threads(threads_)
    for (int slice = 0; slice < slices; ++slice) {
        depth_order_.merge(slice, order_.data());
        std::int64_t* counts = next_.data() + static_cast<std::int64_t>(slice) * tiles;
        for (int i = depth_order_.slice_begin(slice); i < depth_order_.slice_begin(slice + 1);
             ++i) {
            const TileRange& range = ranges_[order_[i]];
            for (int y = range.y0; y < range.y1; ++y)
                for (int x = range.x0; x < range.x1; ++x) ++counts[y * tiles_x_ + x];
        }
    }
}

// What a slice writes into a tile follows what those in front of it write there, so that the slices
// do not show in the result.
void Rasteriser::begin_tiles() {
    const int tiles = num_tiles(), slices = depth_order_.stretches();
    tile_begin_.resize(tiles + 1);
    std::int64_t total = 0;
    for (int tile = 0; tile < tiles; ++tile) {
        tile_begin_[tile] = total;
        for (int slice = 0; slice < slices; ++slice) {
            const std::int64_t at = static_cast<std::int64_t>(slice) * tiles + tile;
            const std::int64_t count = next_[at];
            next_[at] = total;
            total += count;
        }
    }
    tile_begin_[tiles] = total;
    tile_ids_.resize(total);
    slots_.resize(total);
}

void Rasteriser::fill_tiles() {
    const int tiles = num_tiles(), slices = depth_order_.stretches();
    const InParallel timed(&parallel_s_);
#pragma omp parallel for schedule(static, 1) num_threads(threads_)
    for (int slice = 0; slice < slices; ++slice) {
        std::int64_t* next = next_.data() + static_cast<std::int64_t>(slice) * tiles;
        for (int i = depth_order_.slice_begin(slice); i < depth_order_.slice_begin(slice + 1);
             ++i) {
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
    sort_and_count();
    begin_tiles();
    fill_tiles();
    drawn_.resize(num_tiles());
    const InParallel timed(&parallel_s_);
#pragma omp parallel for schedule(dynamic, 4) num_threads(threads_)
    for (int tile = 0; tile < num_tiles(); ++tile)
        drawn_[tile] =
            kernels_.draw_tile(projected_.data(), job(tile), camera_, settings_, planes);
}

// Projects what comes over the last ``draw``, and lists for each tile what touches it by depth.
void Rasteriser::sort_over(const Splats& splats, int count) {
    projected_.resize(count_ + count);
    Projected* const added = projected_.data() + count_;
#pragma omp parallel for schedule(static) num_threads(threads_)
    for (int begin = 0; begin < count; begin += kProjectBlock)
        kernels_.project(splats, camera_, settings_, added, begin,
                         std::min(begin + kProjectBlock, count));
    depth_order_over_.begin(1);
    for (int i = 0; i < count; ++i)
        if (visible(count_ + i)) depth_order_over_.add(0, added[i].depth, i);
    depth_order_over_.sort(0);
    depth_order_over_.cut();
    std::vector<std::uint32_t> order(depth_order_over_.count());
    depth_order_over_.merge(0, order.data());
    over_.resize(num_tiles());
    for (auto& ids : over_) ids.clear();
    for (const std::uint32_t i : order) {
        const TileRange range = tiles_of(added[i]);
        for (int y = range.y0; y < range.y1; ++y)
            for (int x = range.x0; x < range.x1; ++x)
                over_[y * tiles_x_ + x].push_back(count_ + i);
    }
}

std::vector<int> Rasteriser::changed_tiles(const bool* hidden) const {
    std::vector<char> touched(num_tiles(), 0);
    for (int i = 0; hidden != nullptr && i < count_; ++i)
        if (hidden[i])
            for (int y = ranges_[i].y0; y < ranges_[i].y1; ++y)
                for (int x = ranges_[i].x0; x < ranges_[i].x1; ++x) touched[y * tiles_x_ + x] = 1;
    std::vector<int> tiles;
    for (int tile = 0; tile < num_tiles(); ++tile)
        if (touched[tile] || !over_[tile].empty()) tiles.push_back(tile);
    return tiles;
}

void Rasteriser::draw_over(const Splats& splats, int count, const bool* hidden, const float* under,
                           float* planes) {
    sort_over(splats, count);
    std::copy_n(under, static_cast<std::int64_t>(kPlanes) * camera_.width * camera_.height, planes);
    const std::vector<int> tiles = changed_tiles(hidden);
#pragma omp parallel for schedule(dynamic, 4) num_threads(threads_)
    for (int i = 0; i < static_cast<int>(tiles.size()); ++i) {
        TileJob merged = job(tiles[i]);
        const std::vector<std::uint32_t>& over = over_[tiles[i]];
        std::vector<std::uint32_t> rest, ids(merged.count + over.size());
        std::copy_if(merged.ids, merged.ids + merged.count, std::back_inserter(rest),
                     [&](std::uint32_t id) { return hidden == nullptr || !hidden[id]; });
        // Of equal depths those below come first, as their indices would.
        const auto end = std::merge(
            rest.begin(), rest.end(), over.begin(), over.end(), ids.begin(),
            [&](std::uint32_t a, std::uint32_t b) {
                return projected_[a].depth < projected_[b].depth;
            });
        merged.ids = ids.data();
        merged.count = static_cast<int>(end - ids.begin());
        kernels_.draw_tile(projected_.data(), merged, camera_, settings_, planes);
    }
}

// The rows of a tile's pairs; those that were not drawn are zero.
float* Rasteriser::begin_pair_rows(int tile, int row_floats) {
    float* rows = pair_rows_.data() + tile_begin_[tile] * row_floats;
    const std::int64_t undrawn = tile_begin_[tile + 1] - tile_begin_[tile] - drawn_[tile];
    std::fill_n(rows + static_cast<std::int64_t>(drawn_[tile]) * row_floats, undrawn * row_floats,
                0.0f);
    return rows;
}

void Rasteriser::add_pair_rows(int index, int row_floats, float* sums) const {
    for (std::int64_t slot = slot_begin_[index]; slot < slot_begin_[index + 1]; ++slot) {
        const float* row = pair_rows_.data() + slots_[slot] * row_floats;
        for (int k = 0; k < row_floats; ++k) sums[k] += row[k];
    }
}

// Adds up what the tiles say about a block of Gaussians and pulls it through the projection.
void Rasteriser::gather_gradients(const Splats& splats, const SplatGradients& out, int block) {
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

void Rasteriser::pull(const Splats& splats, const float* planes, const float* plane_gradients,
                      const SplatGradients& out, double* d_pose) {
    pair_rows_.resize(tile_ids_.size() * kPairGradients);
    const int num_blocks = (count_ + kGatherBlock - 1) / kGatherBlock;
    pose_sums_.resize(static_cast<std::size_t>(num_blocks) * kPoseEntries);
    {
        const InParallel timed(&parallel_s_);
#pragma omp parallel for schedule(dynamic, 4) num_threads(threads_)
        for (int tile = 0; tile < num_tiles(); ++tile)
            kernels_.draw_tile_gradients(projected_.data(), drawn_job(tile), camera_, settings_,
                                         planes, plane_gradients,
                                         begin_pair_rows(tile, kPairGradients));
#pragma omp parallel for schedule(static) num_threads(threads_)
        for (int block = 0; block < num_blocks; ++block)
            gather_gradients(splats, out, block);
    }
    std::fill(d_pose, d_pose + kPoseEntries, 0.0);
    for (std::size_t i = 0; i < pose_sums_.size(); ++i) d_pose[i % kPoseEntries] += pose_sums_[i];
}

}  // namespace splat
