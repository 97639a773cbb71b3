// Keeps the buffers of one rasteriser between the forward and the backward pass.
#pragma once

#include <cstdint>
#include <vector>

#include "depth_order.hpp"
#include "kernels.hpp"

namespace splat {

// Chooses the copy of the kernels: "auto" asks the processor. Returns nullptr for unknown names,
// and for those that this processor cannot run.
const Kernels* kernels_named(const char* name);

class Rasteriser {
  public:
    Rasteriser(const Kernels& kernels, int threads) : kernels_(kernels), threads_(threads) {}

    void use_threads(int threads) { threads_ = threads; }

    // Fills ``planes`` (5 x height x width): red, green, blue, sum w depth, sum w.
    void draw(const Splats&, int count, const Camera&, const Settings&, float* planes);

    // Draws more Gaussians into the last ``draw``, of which some may be hidden (one flag each, or
    // null): the bits of drawing all at once. Tiles that none of them touches are copied from the
    // planes of that call, ``under``.
    void draw_over(const Splats&, int count, const bool* hidden, const float* under,
                   float* planes);

    // Gradients of the last ``draw``; inputs and planes must be those of that call. ``d_pose`` is
    // with respect to the 3 x 4 matrix [R | t].
    void pull(const Splats&, const float* planes, const float* plane_gradients,
              const SplatGradients& out, double* d_pose);

    // The weights w of the last ``draw`` as a linear map. A: features (count x num) to planes
    // (num x height x width); its transpose; and the label with the largest sum of weights.
    void draw_features(const float* features, int num, float* planes);
    void lift(const float* planes, int num, float* features);
    void label_map(const std::uint16_t* labels, std::uint16_t* ids, float* weights);

    // Depth of the opaque surface of the last ``draw`` (height x width); 0 where there is none.
    void surface_depth(float* plane);

    // Whether each Gaussian could touch the last image.
    bool visible(int index) const { return projected_[index].half_x >= 0; }
    int count() const { return count_; }
    const Camera& camera() const { return camera_; }
    std::int64_t num_pairs() const { return static_cast<std::int64_t>(tile_ids_.size()); }
    // Time spent so far in loops that threads share, in ``draw`` and ``pull``.
    double parallel_s() const { return parallel_s_; }

  private:
    struct TileRange {
        int x0, y0, x1, y1;  // ends excluded
    };
    TileRange tiles_of(const Projected&) const;
    void project(const Splats&);
    void project_block(const Splats&, int begin, int end);
    void sort_over(const Splats&, int count);
    std::vector<int> changed_tiles(const bool* hidden) const;
    void sort_and_count();
    void begin_tiles();
    void fill_tiles();
    TileJob job(int tile) const;
    TileJob drawn_job(int tile) const;
    float* begin_pair_rows(int tile, int row_floats);
    void add_pair_rows(int index, int row_floats, float* sums) const;
    void gather_gradients(const Splats&, const SplatGradients&, int block);
    int num_tiles() const { return tiles_x_ * tiles_y_; }

    const Kernels& kernels_;
    [[maybe_unused]] int threads_;  // not used without OpenMP
    int count_ = 0;
    int tiles_x_ = 0, tiles_y_ = 0;
    Camera camera_{};
    Settings settings_{};
    std::vector<Projected> projected_;
    std::vector<TileRange> ranges_;
    std::vector<std::uint32_t> order_;                    // visible Gaussians, front to back
    DepthOrder depth_order_;
    std::vector<std::int64_t> tile_begin_;
    std::vector<std::uint32_t> tile_ids_;
    std::vector<std::int64_t> next_;        // where each slice of order_ writes in each tile
    DepthOrder depth_order_over_;
    std::vector<std::vector<std::uint32_t>> over_;  // per tile: what ``draw_over`` adds
    std::vector<int> drawn_;                // per tile: Gaussians drawn before it was opaque
    std::vector<std::int64_t> slot_begin_;  // per Gaussian: its pairs in slots_
    std::vector<std::int64_t> slots_;       // where those pairs stand in tile_ids_
    std::vector<float> pair_rows_;
    std::vector<float> tile_planes_;  // working memory of each thread
    std::vector<float> pose_sums_;    // of each block of Gaussians
    double parallel_s_ = 0;
};

}  // namespace splat
