#include "similarity.hpp"

#include <algorithm>
#include <cstdint>

#include "threads.hpp"

namespace splat {

namespace {

constexpr int kChannels = 3;
// Rows of a band; ten more on each side are blurred again. Fixed, so that sums never change.
constexpr int kBandRows = 80;

}  // namespace

double Similarity::mean(const float* rendered, const float* target, float* gradient, int width,
                        int height) {
    const std::int64_t size = static_cast<std::int64_t>(width) * height;
    const std::int64_t room = similarity_scratch(width);
    const int bands = (height + kBandRows - 1) / kBandRows, tasks = kChannels * bands;
    const float scale = 1.0f / (kChannels * size);
    scratch_.resize(room * threads_);
    sums_.resize(tasks);
#pragma omp parallel for schedule(dynamic, 1) num_threads(threads_)
    for (int task = 0; task < tasks; ++task) {
        const std::int64_t plane = size * (task / bands);
        const int begin = task % bands * kBandRows;
        sums_[task] = kernels_.similarity_band(
            rendered + plane, target + plane, gradient + plane, scale,
            scratch_.data() + room * thread_index(), width, height, begin,
            std::min(begin + kBandRows, height));
    }
    double total = 0;
    for (const double value : sums_) total += value;
    return total * scale;
}

}  // namespace splat
