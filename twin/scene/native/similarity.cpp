// SSIM (Wang et al. 2004) with zero padding, so that its adjoint is the same blur.
#include "similarity.hpp"

#include <cstdint>

namespace splat {

namespace {

constexpr int kChannels = 3;
enum Map { kX, kY, kXX, kYY, kXY, kGradX, kGradXX, kGradXY, kMaps };

}  // namespace

double Similarity::mean(const float* rendered, const float* target, float* gradient, int width,
                        int height) {
    const std::int64_t size = static_cast<std::int64_t>(width) * height;
    const int tasks = kChannels * 5;
    const std::int64_t room = blur_scratch(width, height);
    maps_.resize(size * kChannels * kMaps + 2 * room * tasks);
    const auto map = [&](int channel, int which) {
        return maps_.data() + size * (channel * kMaps + which);
    };
    const auto scratch = [&](int task, int which) {
        return maps_.data() + size * kChannels * kMaps + room * (2 * task + which);
    };
#pragma omp parallel for schedule(dynamic, 1) num_threads(threads_)
    for (int task = 0; task < tasks; ++task) {
        const int channel = task / 5, which = task % 5;
        const float* x = rendered + size * channel;
        const float* y = target + size * channel;
        const float* left = which == kY || which == kYY ? y : x;
        const float* right = which == kXX ? x : y;
        float* product = scratch(task, 0);
        if (which >= kXX)
            for (std::int64_t i = 0; i < size; ++i) product[i] = left[i] * right[i];
        kernels_.blur(which >= kXX ? product : left, map(channel, which), scratch(task, 1), width,
                      height);
    }
    double total[kChannels];
#pragma omp parallel for schedule(dynamic, 1) num_threads(threads_)
    for (int channel = 0; channel < kChannels; ++channel)
        total[channel] = kernels_.similarity(
            map(channel, kX), map(channel, kY), map(channel, kXX), map(channel, kYY),
            map(channel, kXY), map(channel, kGradX), map(channel, kGradXX), map(channel, kGradXY),
            static_cast<int>(size));
#pragma omp parallel for schedule(dynamic, 1) num_threads(threads_)
    for (int task = 0; task < 3 * kChannels; ++task)
        kernels_.blur(map(task / 3, kGradX + task % 3), scratch(task, 0), scratch(task, 1), width,
                      height);
    const float scale = 1.0f / (kChannels * size);
#pragma omp parallel for schedule(dynamic, 1) num_threads(threads_)
    for (int channel = 0; channel < kChannels; ++channel) {
        const float* x = rendered + size * channel;
        const float* y = target + size * channel;
        const float* d_x = scratch(3 * channel, 0);
        const float* d_xx = scratch(3 * channel + 1, 0);
        const float* d_xy = scratch(3 * channel + 2, 0);
        for (std::int64_t i = 0; i < size; ++i)
            gradient[size * channel + i] = scale * (d_x[i] + 2 * x[i] * d_xx[i] + y[i] * d_xy[i]);
    }
    return (total[0] + total[1] + total[2]) * scale;
}

}  // namespace splat
