// The loss of one row of pixels and its gradient: L1 or squared error of colour, L1 of depth.
#include "kernels_isa.hpp"
#include "lanes.hpp"

namespace splat::SPLAT_ISA {

void compare_row(const ColorRow& row, float* __restrict compared, float* __restrict wanted,
                 double* l1, double* squared) {
    const float gain = row.gain;
    const float* __restrict drawn = row.drawn;
    const std::uint8_t *__restrict seen = row.seen, *__restrict is_static = row.is_static;
    for (int i = 0; i < row.width; ++i) {
        const float value = gain * drawn[i], target = seen[i] * (1.0f / 255.0f);
        compared[i] = value;
        wanted[i] = is_static[i] ? target : value;
    }
    Floats sum_l1 = Floats{}, sum_squared = Floats{};
    for (int i = 0; i < row.width; i += kLanes) {
        const int left = row.width - i;
        const Floats difference = load_some(compared + i, left) - load_some(wanted + i, left);
        sum_l1 += positive(difference);
        sum_squared += difference * difference;
    }
    *l1 += sum(sum_l1);
    *squared += sum(sum_squared);
}

float color_gradient_row(const ColorRow& row, const float* compared, const float* wanted,
                         const ColorWeights& weights, float* gradient) {
    Floats d_gain = Floats{};
    for (int i = 0; i < row.width; i += kLanes) {
        const int left = row.width - i;
        const Floats difference = load_some(compared + i, left) - load_some(wanted + i, left);
        const Floats sign = keep(difference > 0.0f, all(weights.l1)) -
                            keep(difference < 0.0f, all(weights.l1));
        const Floats on_compared = sign + difference * (2.0f * weights.squared) -
                                   load_some(gradient + i, left) * weights.similarity;
        d_gain += on_compared * load_some(row.drawn + i, left);
        store_some(gradient + i, on_compared * row.gain, left);
    }
    return sum(d_gain);
}

float depth_gradient_row(const DepthRow& row, float* d_drawn, float* d_alpha) {
    for (int i = 0; i < row.width; ++i)
        d_drawn[i] = row.is_static[i] ? row.measured_m[i] : 0.0f;  // overwritten below
    Floats total = Floats{};
    for (int i = 0; i < row.width; i += kLanes) {
        const int left = row.width - i;
        const Floats depth = load_some(d_drawn + i, left);
        const Ints valid = depth > 0.0f;
        const Floats inverse = keep(valid, 1.0f / depth);
        const Floats residual = keep(valid, load_some(row.drawn + i, left) * inverse -
                                                load_some(row.alpha + i, left));
        const Floats sign = keep(residual > 0.0f, all(row.weight)) -
                            keep(residual < 0.0f, all(row.weight));
        total += positive(residual);
        store_some(d_drawn + i, sign * inverse, left);
        store_some(d_alpha + i, keep(valid, -sign), left);
    }
    return sum(total);
}

}  // namespace splat::SPLAT_ISA
