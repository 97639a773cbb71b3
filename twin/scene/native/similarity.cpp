#include "similarity.hpp"

#include <cstdint>

#include "threads.hpp"

namespace splat {

double Similarity::mean(const float* rendered, const float* target, float* gradient, int width,
                        int height) {
    constexpr int kChannels = 3;
    const std::int64_t size = static_cast<std::int64_t>(width) * height;
    const int strips = (width + kStripColumns - 1) / kStripColumns, tasks = kChannels * strips;
    const float scale = 1.0f / (kChannels * size);
    sums_.resize(tasks);
    {
        const InParallel timed(&parallel_s_);
#pragma omp parallel for schedule(dynamic, 1) num_threads(threads_)
        for (int task = 0; task < tasks; ++task) {
            const std::int64_t plane = size * (task / strips);
            sums_[task] = kernels_.similarity_strip(rendered + plane, target + plane,
                                                    gradient + plane, scale, width, height,
                                                    task % strips * kStripColumns);
        }
    }
    double total = 0;
    for (const double value : sums_) total += value;
    return total * scale;
}

}  // namespace splat
