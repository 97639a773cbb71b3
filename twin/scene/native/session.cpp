// Sums are taken per row and the rows added in order: the same bits for any number of threads.
#include "session.hpp"

#include <algorithm>
#include <chrono>
#include <cmath>

#include "threads.hpp"

namespace splat {

namespace {

constexpr int kColumns[Tables::kCount - 1] = {3, 4, 3, 1, 3};
constexpr std::int64_t kLearnBlock = 1 << 13;

struct LearnBlock {
    int table;
    std::int64_t at;
    int size;
};

int columns_of(int table, const Learning& learning) {
    return table == Tables::kCount - 1 ? 3 * learning.num_harmonics : kColumns[table];
}

// Whether the exposure is more than a factor for each channel.
bool mixes(const FitTarget& target) {
    for (int i = 0; i < 12; ++i)
        if (i % 5 != 0 && target.exposure[i] != 0) return true;
    return false;
}

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
            gradient_begin_[table] + (there ? std::int64_t{columns_of(table, learning)} * count : 0);
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
    const Splats splats{table[0], table[1], table[2],
                        table[3], table[4], table[5], learning.num_harmonics};
    StepResult result{};
    const auto begin = std::chrono::steady_clock::now();
    auto clock = begin;
    parallel_s_ = -rasteriser_.parallel_s();
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
    parallel_s_ += rasteriser_.parallel_s();
    result.serial_s = std::chrono::duration<double>(clock - begin).count() - parallel_s_;
    return result;
}

ColorRow FitSession::color_row(const FitTarget& target, int channel, int y) const {
    const Camera& camera = rasteriser_.camera();
    const std::int64_t row = static_cast<std::int64_t>(y) * camera.width;
    const std::int64_t at = static_cast<std::int64_t>(channel) * camera.width * camera.height + row;
    const bool mixed = !mixed_.empty();
    return {(mixed ? mixed_ : planes_).data() + at, target.planes + at, target.is_static + row,
            mixed ? 1.0f : target.exposure[5 * channel], camera.width};
}

// Colours as they would come out with an exposure that mixes channels; none where it does not.
void FitSession::mix_planes(const FitTarget& target) {
    const Camera& camera = rasteriser_.camera();
    const std::int64_t width = camera.width, pixels = width * camera.height;
    mixed_.resize(mixes(target) ? 3 * pixels : 0);
    if (mixed_.empty()) return;
    const InParallel timed(&parallel_s_);
#pragma omp parallel for schedule(static) num_threads(threads_)
    for (int y = 0; y < camera.height; ++y) {
        const float* red = planes_.data() + y * width;
        const float *green = red + pixels, *blue = green + pixels;
        for (int channel = 0; channel < 3; ++channel) {
            const float* row = target.exposure + 4 * channel;
            float* out = mixed_.data() + channel * pixels + y * width;
            for (std::int64_t x = 0; x < width; ++x)
                out[x] = row[0] * red[x] + row[1] * green[x] + row[2] * blue[x] + row[3];
        }
    }
}

// Carries gradients on mixed colours back to those drawn, and to the diagonal of the exposure.
void FitSession::unmix_gradients(const FitTarget& target) {
    if (mixed_.empty()) return;
    const Camera& camera = rasteriser_.camera();
    const std::int64_t width = camera.width, pixels = width * camera.height;
    const float* e = target.exposure;
    const InParallel timed(&parallel_s_);
#pragma omp parallel for schedule(static) num_threads(threads_)
    for (int y = 0; y < camera.height; ++y) {
        float* red = plane_gradients_.data() + y * width;
        float *green = red + pixels, *blue = green + pixels;
        const float* drawn = planes_.data() + y * width;
        double sums[3] = {0, 0, 0};
        for (std::int64_t x = 0; x < width; ++x) {
            const float on[3] = {red[x], green[x], blue[x]};
            for (int channel = 0; channel < 3; ++channel)
                sums[channel] += on[channel] * drawn[channel * pixels + x];
            red[x] = e[0] * on[0] + e[4] * on[1] + e[8] * on[2];
            green[x] = e[1] * on[0] + e[5] * on[1] + e[9] * on[2];
            blue[x] = e[2] * on[0] + e[6] * on[1] + e[10] * on[2];
        }
        for (int channel = 0; channel < 3; ++channel)
            row_sums_[channel * camera.height + y] = sums[channel];
    }
}

// Fills the images to compare and the sums of their differences, row by row.
void FitSession::compare_rows(const FitTarget& target) {
    const Camera& camera = rasteriser_.camera();
    const int height = camera.height;
    row_counts_.assign(2 * height, 0);
    row_sums_.assign(6 * height, 0.0);
    const InParallel timed(&parallel_s_);
#pragma omp parallel for schedule(static) num_threads(threads_)
    for (int y = 0; y < height; ++y) {
        std::int64_t is_static = 0, measured = 0;
        const std::int64_t row = static_cast<std::int64_t>(y) * camera.width;
        for (int x = 0; x < camera.width; ++x) {
            is_static += target.is_static[row + x] != 0;
            measured += target.is_static[row + x] != 0 && target.depth_m[row + x] > 0;
        }
        row_counts_[2 * y] = is_static;
        row_counts_[2 * y + 1] = measured;
        for (int channel = 0; channel < 3; ++channel) {
            const std::int64_t task = static_cast<std::int64_t>(channel) * height + y;
            kernels_.compare_row(color_row(target, channel, y),
                                 compared_.data() + task * camera.width,
                                 wanted_.data() + task * camera.width, &row_sums_[2 * task],
                                 &row_sums_[2 * task + 1]);
        }
    }
}

// Turns the gradient of the similarity into that of the loss, and adds that of depth.
void FitSession::gradient_rows(const FitTarget& target, const ColorWeights& weights,
                               float depth_weight) {
    const Camera& camera = rasteriser_.camera();
    const int height = camera.height;
    const std::int64_t pixels = static_cast<std::int64_t>(camera.width) * height;
    row_sums_.assign(4 * height, 0.0);
    const InParallel timed(&parallel_s_);
#pragma omp parallel for schedule(static) num_threads(threads_)
    for (int y = 0; y < height; ++y) {
        const std::int64_t row = static_cast<std::int64_t>(y) * camera.width;
        for (int channel = 0; channel < 3; ++channel) {
            const std::int64_t at = channel * pixels + row;
            row_sums_[channel * height + y] = kernels_.color_gradient_row(
                color_row(target, channel, y), compared_.data() + at, wanted_.data() + at, weights,
                plane_gradients_.data() + at);
        }
        float* on_depth = plane_gradients_.data() + 3 * pixels + row;
        const float* drawn = planes_.data() + 3 * pixels + row;
        const DepthRow depth{drawn,        drawn + pixels, target.depth_m + row,
                             target.is_static + row, depth_weight, camera.width};
        row_sums_[3 * height + y] =
            kernels_.depth_gradient_row(depth, on_depth, on_depth + pixels);
    }
}

double FitSession::compare(const FitTarget& target, const LossWeights& weights,
                           StepResult* result) {
    const Camera& camera = rasteriser_.camera();
    const int height = camera.height, tasks = 3 * height;
    const double entries = 3.0 * camera.width * height;
    mix_planes(target);
    compare_rows(target);
    std::int64_t measured = 0;
    for (int y = 0; y < height; ++y) {
        result->static_pixels += row_counts_[2 * y];
        measured += row_counts_[2 * y + 1];
    }
    double l1 = 0;
    for (int task = 0; task < tasks; ++task) {
        l1 += row_sums_[2 * task];
        result->squared += row_sums_[2 * task + 1];
    }
    double loss = result->squared / entries;
    ColorWeights row_weights{0.0f, static_cast<float>(1.0 / entries), 0.0f};
    if (weights.structural) {
        const double before_s = similarity_.parallel_s();
        const double similarity =
            similarity_.mean(compared_.data(), wanted_.data(), plane_gradients_.data(),
                             camera.width, height);
        parallel_s_ += similarity_.parallel_s() - before_s;
        loss = weights.l1_share * l1 / entries + (1.0 - weights.l1_share) * (1.0 - similarity);
        row_weights = {static_cast<float>(weights.l1_share / entries), 0.0f,
                       1.0f - weights.l1_share};
    } else {
        std::fill_n(plane_gradients_.begin(), 3 * static_cast<std::int64_t>(camera.width) * height,
                    0.0f);
    }
    const double depth_share = measured == 0 ? 0.0 : weights.depth / static_cast<double>(measured);
    gradient_rows(target, row_weights, static_cast<float>(depth_share));
    unmix_gradients(target);
    for (int task = 0; task < tasks; ++task) result->gain[task / height] += row_sums_[task];
    double depth = 0;
    for (int y = 0; y < height; ++y) depth += row_sums_[tasks + y];
    return loss + depth_share * depth;
}

// Blocks of all tables are one list of tasks: waking threads for each table costs more than Adam.
void FitSession::learn(int count, const Learning& learning) {
    std::vector<LearnBlock> blocks;
    for (int table = 0; table < Tables::kCount; ++table) {
        if (learning.rates[table] == 0 || learning.values.table[table] == nullptr) continue;
        const std::int64_t size = std::int64_t{columns_of(table, learning)} * count;
        for (std::int64_t at = 0; at < size; at += kLearnBlock)
            blocks.push_back({table, at, static_cast<int>(std::min(kLearnBlock, size - at))});
    }
    const auto correction = [&](float beta) {
        return static_cast<float>(1 - std::pow(double{beta}, learning.step));
    };
    const float correction1 = correction(learning.beta1), correction2 = correction(learning.beta2);
    const InParallel timed(&parallel_s_);
#pragma omp parallel for schedule(static) num_threads(threads_)
    for (std::size_t i = 0; i < blocks.size(); ++i) {
        const auto [table, at, size] = blocks[i];
        const AdamRates rates{learning.rates[table], learning.beta1, learning.beta2,
                              learning.epsilon,      correction1,    correction2};
        kernels_.adam(learning.values.table[table] + at, gradient(table) + at,
                      learning.first.table[table] + at, learning.second.table[table] + at, rates,
                      size);
    }
}

}  // namespace splat
