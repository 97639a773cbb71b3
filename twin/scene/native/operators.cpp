// The weights of the last drawing as a linear map, applied in blocks of channels.
#include <algorithm>

#include "rasteriser.hpp"
#include "threads.hpp"

namespace splat {

namespace {

constexpr int kDrawBlock = 32;  // channels whose tiles stay in the cache together
constexpr int kLiftBlock = 16;  // channels of one row per (Gaussian, tile) pair
constexpr int kNumLabels = 1 << 16;

}  // namespace

void Rasteriser::draw_features(const float* features, int num, float* planes) {
    const std::int64_t plane_size = static_cast<std::int64_t>(camera_.width) * camera_.height;
    tile_planes_.resize(static_cast<std::size_t>(threads_) * kDrawBlock * kTilePixels);
    for (int first = 0; first < num; first += kDrawBlock) {
        const FeatureBlock block{features + first, num, std::min(kDrawBlock, num - first)};
#pragma omp parallel for schedule(dynamic, 4) num_threads(threads_)
        for (int tile = 0; tile < num_tiles(); ++tile)
            kernels_.draw_tile_features(
                projected_.data(), drawn_job(tile), camera_, settings_, block,
                tile_planes_.data() + thread_index() * kDrawBlock * kTilePixels,
                planes + first * plane_size);
    }
}

void Rasteriser::lift(const float* planes, int num, float* features) {
    const std::int64_t plane_size = static_cast<std::int64_t>(camera_.width) * camera_.height;
    tile_planes_.resize(static_cast<std::size_t>(threads_) * kDrawBlock * kTilePixels);
    for (int first = 0; first < num; first += kLiftBlock) {
        const int channels = std::min(kLiftBlock, num - first);
        pair_rows_.resize(tile_ids_.size() * channels);
#pragma omp parallel for schedule(dynamic, 4) num_threads(threads_)
        for (int tile = 0; tile < num_tiles(); ++tile)
            kernels_.lift_tile(projected_.data(), drawn_job(tile), camera_, settings_,
                               planes + first * plane_size, channels,
                               tile_planes_.data() + thread_index() * kDrawBlock * kTilePixels,
                               begin_pair_rows(tile, channels));
#pragma omp parallel for schedule(static) num_threads(threads_)
        for (int index = 0; index < count_; ++index) {
            float* out = features + static_cast<std::int64_t>(index) * num + first;
            std::fill_n(out, channels, 0.0f);
            add_pair_rows(index, channels, out);
        }
    }
}

void Rasteriser::surface_depth(float* plane) {
#pragma omp parallel for schedule(dynamic, 4) num_threads(threads_)
    for (int tile = 0; tile < num_tiles(); ++tile)
        kernels_.surface_tile(projected_.data(), drawn_job(tile), camera_, settings_, plane);
}

namespace {

// Which labels a tile shows; ``slot_of`` is -1 everywhere between two tiles.
struct TileLabels {
    std::vector<int> slot_of = std::vector<int>(kNumLabels, -1);
    std::vector<std::uint16_t> labels;
    std::vector<int> slots;      // of each Gaussian of the tile
    std::vector<float> weights;  // one tile for each label

    void collect(const TileJob& job, const std::uint16_t* label_of) {
        for (const std::uint16_t label : labels) slot_of[label] = -1;
        labels.clear();
        slots.resize(job.count);
        for (int i = 0; i < job.count; ++i) {
            const std::uint16_t label = label_of[job.ids[i]];
            if (slot_of[label] < 0) {
                slot_of[label] = static_cast<int>(labels.size());
                labels.push_back(label);
            }
            slots[i] = slot_of[label];
        }
        weights.assign(labels.size() * kTilePixels, 0.0f);
    }

    // The label with the largest weight, of equals the smallest; 0 where there is no weight.
    void winner(int pixel, std::uint16_t* id, float* weight) const {
        *id = 0;
        *weight = 0;
        for (std::size_t slot = 0; slot < labels.size(); ++slot) {
            const float value = weights[slot * kTilePixels + pixel];
            if (value > *weight || (value == *weight && value > 0 && labels[slot] < *id)) {
                *id = labels[slot];
                *weight = value;
            }
        }
    }
};

}  // namespace

void Rasteriser::label_map(const std::uint16_t* labels, std::uint16_t* ids, float* weights) {
    std::vector<TileLabels> of_thread(threads_);
#pragma omp parallel for schedule(dynamic, 4) num_threads(threads_)
    for (int tile = 0; tile < num_tiles(); ++tile) {
        TileLabels& found = of_thread[thread_index()];
        const TileJob drawn = drawn_job(tile);
        found.collect(drawn, labels);
        kernels_.label_tile(projected_.data(), drawn, camera_, settings_, found.slots.data(),
                            found.weights.data());
        const int width = std::min(kTile, camera_.width - drawn.x0);
        const int height = std::min(kTile, camera_.height - drawn.y0);
        for (int y = 0; y < height; ++y)
            for (int x = 0; x < width; ++x) {
                const std::int64_t at =
                    static_cast<std::int64_t>(drawn.y0 + y) * camera_.width + drawn.x0 + x;
                found.winner(tile_index(x, y, kernels_.block_height), ids + at, weights + at);
            }
    }
}

}  // namespace splat
