// Keeps the buffers of one rasteriser between the forward and the backward pass.
#pragma once

#include <cstdint>
#include <vector>

#include "kernels.hpp"

namespace splat {

// Chooses the copy of the kernels: "auto" asks the processor. Returns nullptr for unknown names.
const Kernels* kernels_named(const char* name);

class Rasteriser {
  public:
    Rasteriser(const Kernels& kernels, int threads) : kernels_(kernels), threads_(threads) {}

    // Fills ``planes`` (5 x height x width): red, green, blue, sum w depth, sum w.
    void draw(const Splats&, int count, const Camera&, const Settings&, float* planes);

    // Gradients of the last ``draw``; inputs and planes must be those of that call.
    void pull(const Splats&, const float* planes, const float* plane_gradients,
              const SplatGradients& out);

    // Whether each Gaussian touched the last image.
    bool visible(int index) const { return projected_[index].half_x >= 0; }
    int count() const { return count_; }
    const Camera& camera() const { return camera_; }
    std::int64_t num_pairs() const { return static_cast<std::int64_t>(tile_ids_.size()); }

  private:
    struct TileRange {
        int x0, y0, x1, y1;  // ends excluded
    };
    TileRange tiles_of(const Projected&) const;
    void sort_by_depth();
    void fill_tiles();
    TileJob job(int tile) const;

    const Kernels& kernels_;
    int threads_;
    int count_ = 0;
    int tiles_x_ = 0, tiles_y_ = 0;
    Camera camera_{};
    Settings settings_{};
    std::vector<Projected> projected_;
    std::vector<std::uint32_t> order_, order_scratch_;  // visible Gaussians, front to back
    std::vector<std::uint32_t> keys_, keys_scratch_;
    std::vector<std::int64_t> tile_begin_;
    std::vector<std::uint32_t> tile_ids_;
    std::vector<int> drawn_;                // per tile: Gaussians drawn before it was opaque
    std::vector<std::int64_t> slot_begin_;  // per entry of order_: its pairs in slots_
    std::vector<std::int64_t> slots_;       // where those pairs stand in tile_ids_
    std::vector<float> pair_gradients_;
};

}  // namespace splat
