// One step of fitting without leaving native code: draw, compare, pull back, Adam.
#pragma once

#include <cstdint>
#include <vector>

#include "rasteriser.hpp"
#include "similarity.hpp"

namespace splat {

// What a camera saw: planes of 8 bits, metres of depth (0: none), and what may be compared.
struct FitTarget {
    const std::uint8_t* planes;     // 3 x height x width
    const float* depth_m;           // height x width
    const std::uint8_t* is_static;  // height x width
    // 3 x 4, row-major: what is compared is the exposure times (red, green, blue, 1) as drawn.
    float exposure[12];
};

struct LossWeights {
    bool structural;  // L1 and SSIM, else the squared error
    float l1_share;   // of L1; the rest is SSIM's
    float depth;
};

struct StepResult {
    double loss, squared;        // squared: sum over static pixels and channels
    std::int64_t static_pixels;
    double gain[3];              // dL/d(diagonal of the exposure)
    double pose[kPoseEntries];   // dL/d[R | t]
    double draw_s, compare_s, pull_s, learn_s;
    double serial_s;             // of these, outside of the loops that threads share
};

// The six tables of a cloud, or of what belongs to each of their entries.
struct Tables {
    static constexpr int kCount = 6;
    float* table[kCount];  // means, quats, scales_log, opacities, colors, harmonics (or null)
};

struct Learning {
    Tables values, first, second;
    int num_harmonics;  // of each colour
    float rates[Tables::kCount];  // 0: the table is left as it is
    float beta1, beta2, epsilon;
    int step;  // counted from 1
};

class FitSession {
  public:
    FitSession(const Kernels& kernels, int threads)
        : kernels_(kernels), threads_(threads), rasteriser_(kernels, threads),
          similarity_(kernels, threads) {}

    StepResult step(int count, const Camera&, const Settings&, const FitTarget&,
                    const LossWeights&, const Learning&);

    // From the next step on; the result does not depend on it.
    void use_threads(int threads) {
        threads_ = threads;
        rasteriser_.use_threads(threads);
        similarity_.use_threads(threads);
    }

    const Rasteriser& rasteriser() const { return rasteriser_; }
    // Of the last step: what was drawn (5 planes), and the gradient on one of the six tables.
    const std::vector<float>& planes() const { return planes_; }
    const float* gradient(int table) const { return gradients_.data() + gradient_begin_[table]; }

  private:
    void start(int count, const Learning&, std::int64_t pixels);
    SplatGradients gradient_tables(bool with_harmonics);
    double compare(const FitTarget&, const LossWeights&, StepResult*);
    void mix_planes(const FitTarget&);
    void unmix_gradients(const FitTarget&);
    void compare_rows(const FitTarget&);
    void gradient_rows(const FitTarget&, const ColorWeights&, float depth_weight);
    void learn(int count, const Learning&);
    ColorRow color_row(const FitTarget&, int channel, int y) const;

    const Kernels& kernels_;
    [[maybe_unused]] int threads_;  // not used without OpenMP
    Rasteriser rasteriser_;
    Similarity similarity_;
    std::vector<float> planes_, plane_gradients_;
    std::vector<float> mixed_;  // colours after an exposure that mixes channels, else empty
    std::vector<float> compared_, wanted_;  // 3 x height x width
    std::vector<double> row_sums_;
    std::vector<std::int64_t> row_counts_;
    double parallel_s_ = 0;  // of the step that runs
    std::vector<float> gradients_;
    std::int64_t gradient_begin_[Tables::kCount + 1] = {0};
};

}  // namespace splat
