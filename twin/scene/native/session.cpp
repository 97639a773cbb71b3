// Sums are taken per row and the rows added in order: the same bits for any number of threads.
#include "session.hpp"

#include <algorithm>
#include <chrono>
#include <cmath>

namespace splat {

namespace {

constexpr int kColumns[Tables::kCount] = {3, 4, 3, 1, 3, 3 * kHarmonics};
constexpr std::int64_t kLearnBlock = 1 << 14;

double seconds_since(std::chrono::steady_clock::time_point* start) {
    const auto now = std::chrono::steady_clock::now();
    const double seconds = std::chrono::duration<double>(now - *start).count();
    *start = now;
    return seconds;
}

}  // namespace

void FitSession::start(int count, const Learning& learning, std::int64_t pixels) {
    planes_.resize(kPlanes * pixels);
    plane_gradients_.resize(kPlanes * pixels);
    compared_.resize(3 * pixels);
    wanted_.resize(3 * pixels);
    for (int table = 0; table < Tables::kCount; ++table) {
        const bool there = learning.values.table[table] != nullptr;
        gradient_begin_[table + 1] =
            gradient_begin_[table] + (there ? std::int64_t{kColumns[table]} * count : 0);
    }
    gradients_.resize(gradient_begin_[Tables::kCount]);
}

SplatGradients FitSession::gradient_tables(bool with_harmonics) {
    float* begin = gradients_.data();
    const auto table = [&](int index) { return begin + gradient_begin_[index]; };
    return {table(0), table(1), table(2), table(3), table(4), with_harmonics ? table(5) : nullptr};
}

StepResult FitSession::step(int count, const Camera& camera, const Settings& settings,
                            const FitTarget& target, const LossWeights& weights,
                            const Learning& learning) {
    const std::int64_t pixels = static_cast<std::int64_t>(camera.width) * camera.height;
    float* const* table = learning.values.table;
    const Splats splats{table[0], table[1], table[2], table[3], table[4], table[5]};
    StepResult result{};
    auto clock = std::chrono::steady_clock::now();
    start(count, learning, pixels);
    rasteriser_.draw(splats, count, camera, settings, planes_.data());
    result.draw_s = seconds_since(&clock);
    result.loss = compare(target, weights, &result);
    result.compare_s = seconds_since(&clock);
    rasteriser_.pull(splats, planes_.data(), plane_gradients_.data(),
                     gradient_tables(splats.harmonics != nullptr), result.pose);
    result.pull_s = seconds_since(&clock);
    learn(count, learning);
    result.learn_s = seconds_since(&clock);
    return result;
}

ColorRow FitSession::color_row(const FitTarget& target, int channel, int y) const {
    const Camera& camera = rasteriser_.camera();
    const std::int64_t row = static_cast<std::int64_t>(y) * camera.width;
    const std::int64_t at = static_cast<std::int64_t>(channel) * camera.width * camera.height + row;
    return {planes_.data() + at, target.planes + at, target.is_static + row,
            target.gain[channel], camera.width};
}

double FitSession::compare(const FitTarget& target, const LossWeights& weights,
                           StepResult* result) {
    const Camera& camera = rasteriser_.camera();
    row_counts_.assign(2 * camera.height, 0);
#pragma omp parallel for schedule(static) num_threads(threads_)
    for (int y = 0; y < camera.height; ++y) {
        std::int64_t is_static = 0, measured = 0;
        const std::int64_t row = static_cast<std::int64_t>(y) * camera.width;
        for (int x = 0; x < camera.width; ++x) {
            is_static += target.is_static[row + x] != 0;
            measured += target.is_static[row + x] != 0 && target.depth_m[row + x] > 0;
        }
        row_counts_[2 * y] = is_static;
        row_counts_[2 * y + 1] = measured;
    }
    std::int64_t measured = 0;
    for (int y = 0; y < camera.height; ++y) {
        result->static_pixels += row_counts_[2 * y];
        measured += row_counts_[2 * y + 1];
    }
    const double photometric = compare_colors(target, weights, result);
    return photometric + compare_depth(target, weights, measured);
}

double FitSession::compare_colors(const FitTarget& target, const LossWeights& weights,
                                  StepResult* result) {
    const Camera& camera = rasteriser_.camera();
    const int height = camera.height, tasks = 3 * height;
    const double entries = 3.0 * camera.width * height;
    row_sums_.assign(2 * tasks, 0.0);
#pragma omp parallel for schedule(static) num_threads(threads_)
    for (int task = 0; task < tasks; ++task) {
        const std::int64_t at = static_cast<std::int64_t>(task) * camera.width;
        kernels_.compare_row(color_row(target, task / height, task % height),
                             compared_.data() + at, wanted_.data() + at, &row_sums_[2 * task],
                             &row_sums_[2 * task + 1]);
    }
    double l1 = 0;
    for (int task = 0; task < tasks; ++task) {
        l1 += row_sums_[2 * task];
        result->squared += row_sums_[2 * task + 1];
    }
    double loss = result->squared / entries;
    ColorWeights row_weights{0.0f, static_cast<float>(1.0 / entries), 0.0f};
    if (weights.structural) {
        const double similarity =
            similarity_.mean(compared_.data(), wanted_.data(), plane_gradients_.data(),
                             camera.width, height);
        loss = weights.l1_share * l1 / entries + (1.0 - weights.l1_share) * (1.0 - similarity);
        row_weights = {static_cast<float>(weights.l1_share / entries), 0.0f,
                       1.0f - weights.l1_share};
    } else {
        std::fill_n(plane_gradients_.begin(), 3 * static_cast<std::int64_t>(camera.width) * height,
                    0.0f);
    }
#pragma omp parallel for schedule(static) num_threads(threads_)
    for (int task = 0; task < tasks; ++task) {
        const std::int64_t at = static_cast<std::int64_t>(task) * camera.width;
        row_sums_[task] = kernels_.color_gradient_row(
            color_row(target, task / height, task % height), compared_.data() + at,
            wanted_.data() + at, row_weights, plane_gradients_.data() + at);
    }
    for (int task = 0; task < tasks; ++task) result->gain[task / height] += row_sums_[task];
    return loss;
}

double FitSession::compare_depth(const FitTarget& target, const LossWeights& weights,
                                 std::int64_t measured) {
    const Camera& camera = rasteriser_.camera();
    const std::int64_t pixels = static_cast<std::int64_t>(camera.width) * camera.height;
    float* on_depth = plane_gradients_.data() + 3 * pixels;
    if (weights.depth == 0 || measured == 0) {
        std::fill_n(on_depth, 2 * pixels, 0.0f);
        return 0;
    }
    const float weight = weights.depth / static_cast<float>(measured);
#pragma omp parallel for schedule(static) num_threads(threads_)
    for (int y = 0; y < camera.height; ++y) {
        const std::int64_t at = static_cast<std::int64_t>(y) * camera.width;
        const float* drawn = planes_.data() + 3 * pixels + at;
        const DepthRow row{drawn, drawn + pixels, target.depth_m + at, target.is_static + at,
                           weight, camera.width};
        row_sums_[y] = kernels_.depth_gradient_row(row, on_depth + at, on_depth + pixels + at);
    }
    double total = 0;
    for (int y = 0; y < camera.height; ++y) total += row_sums_[y];
    return weights.depth * total / static_cast<double>(measured);
}

void FitSession::learn(int count, const Learning& learning) {
    for (int table = 0; table < Tables::kCount; ++table) {
        if (learning.rates[table] == 0 || learning.values.table[table] == nullptr) continue;
        const AdamRates rates{
            learning.rates[table],
            learning.beta1,
            learning.beta2,
            learning.epsilon,
            static_cast<float>(1 - std::pow(double(learning.beta1), learning.step)),
            static_cast<float>(1 - std::pow(double(learning.beta2), learning.step))};
        const std::int64_t size = std::int64_t{kColumns[table]} * count;
        float* values = learning.values.table[table];
        float *first = learning.first.table[table], *second = learning.second.table[table];
        const float* gradients = gradient(table);
#pragma omp parallel for schedule(static) num_threads(threads_)
        for (std::int64_t at = 0; at < size; at += kLearnBlock)
            kernels_.adam(values + at, gradients + at, first + at, second + at, rates,
                          static_cast<int>(std::min(kLearnBlock, size - at)));
    }
}

}  // namespace splat
