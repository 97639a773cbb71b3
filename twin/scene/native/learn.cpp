// Structural similarity with its gradient, and Adam: the loops of fitting besides drawing.
#include <cmath>
#include <cstdint>

#include "kernels_isa.hpp"

namespace splat::SPLAT_ISA {

namespace {

constexpr int kRadius = kBlurRadius;  // Wang et al. 2004: an 11 x 11 Gaussian window, sigma 1.5 px
constexpr float kC1 = 0.01f * 0.01f, kC2 = 0.03f * 0.03f;

struct Window {
    float tap[kRadius + 1];  // centre and one side
    Window() {
        float total = 0;
        for (int i = 0; i <= kRadius; ++i) {
            tap[i] = std::exp(-i * i / (2 * 1.5f * 1.5f));
            total += i == 0 ? tap[i] : 2 * tap[i];
        }
        for (float& value : tap) value /= total;
    }
};

// out[x] = sum_k tap_k (rows[k][x] + rows[-k][x]); ``rows`` points at the middle of 11 pointers.
void weigh(const float* const* rows, float* __restrict out, int width, const Window& window) {
    const float *r0 = rows[0], *a1 = rows[1], *b1 = rows[-1], *a2 = rows[2], *b2 = rows[-2];
    const float *a3 = rows[3], *b3 = rows[-3], *a4 = rows[4], *b4 = rows[-4];
    const float *a5 = rows[5], *b5 = rows[-5];
    const float t0 = window.tap[0], t1 = window.tap[1], t2 = window.tap[2];
    const float t3 = window.tap[3], t4 = window.tap[4], t5 = window.tap[5];
    for (int x = 0; x < width; ++x)
        out[x] = t0 * r0[x] + t1 * (a1[x] + b1[x]) + t2 * (a2[x] + b2[x]) +
                 t3 * (a3[x] + b3[x]) + t4 * (a4[x] + b4[x]) + t5 * (a5[x] + b5[x]);
}

}  // namespace

void blur(const float* in, float* out, float* scratch, int width, int height) {
    static const Window window;
    const std::int64_t size = static_cast<std::int64_t>(width) * height;
    float* zeros = scratch + size;     // a row outside the image
    float* padded = zeros + width;     // one row with five zeros on each side
    __builtin_memset(zeros, 0, sizeof(float) * (2 * width + 2 * kRadius));
    const float* rows[2 * kRadius + 1];
    for (int k = 0; k < 2 * kRadius + 1; ++k) rows[k] = padded + k;
    for (int y = 0; y < height; ++y) {
        const std::int64_t at = static_cast<std::int64_t>(y) * width;
        __builtin_memcpy(padded + kRadius, in + at, sizeof(float) * width);
        weigh(rows + kRadius, scratch + at, width, window);
    }
    for (int y = 0; y < height; ++y) {
        for (int k = -kRadius; k <= kRadius; ++k) {
            const bool outside = y + k < 0 || y + k >= height;
            rows[k + kRadius] = outside ? zeros : scratch + static_cast<std::int64_t>(y + k) * width;
        }
        weigh(rows + kRadius, out + static_cast<std::int64_t>(y) * width, width, window);
    }
}

double similarity(const float* mean_x, const float* mean_y, const float* mean_xx,
                  const float* mean_yy, const float* mean_xy, float* d_mean_x, float* d_mean_xx,
                  float* d_mean_xy, int count) {
    double total = 0;
    constexpr int kBlock = 256;  // float loops inside, one double sum per block
    for (int begin = 0; begin < count; begin += kBlock) {
        const int end = begin + kBlock < count ? begin + kBlock : count;
        float values[kBlock];
        for (int i = begin; i < end; ++i) {
            const float mx = mean_x[i], my = mean_y[i];
            const float a1 = 2 * mx * my + kC1, a2 = 2 * (mean_xy[i] - mx * my) + kC2;
            const float b1 = mx * mx + my * my + kC1;
            const float b2 = mean_xx[i] - mx * mx + mean_yy[i] - my * my + kC2;
            const float inverse = 1.0f / (b1 * b2);
            const float value = a1 * a2 * inverse;
            values[i - begin] = value;
            const float d_xx = -value / b2;
            d_mean_xx[i] = d_xx;
            d_mean_xy[i] = 2 * a1 * inverse;
            d_mean_x[i] = 2 * my * (a2 - a1) * inverse - 2 * mx * value / b1 - 2 * mx * d_xx;
        }
        for (int i = begin; i < end; ++i) total += values[i - begin];
    }
    return total;
}

void adam(float* values, const float* gradients, float* first, float* second,
          const AdamRates& rates, int count) {
    const float scale = rates.rate / rates.correction1;
    const float inverse2 = 1.0f / rates.correction2;
    for (int i = 0; i < count; ++i) {
        const float g = gradients[i];
        first[i] = rates.beta1 * first[i] + (1 - rates.beta1) * g;
        second[i] = rates.beta2 * second[i] + (1 - rates.beta2) * g * g;
        values[i] -= scale * first[i] / (std::sqrt(second[i] * inverse2) + rates.epsilon);
    }
}

#define SPLAT_TEXT_OF(name) #name
#define SPLAT_TEXT(name) SPLAT_TEXT_OF(name)

extern const Kernels kernels = {SPLAT_TEXT(SPLAT_ISA), project,    unproject_gradients,
                                draw_tile,             draw_tile_gradients, blur,
                                similarity,            adam};

}  // namespace splat::SPLAT_ISA
