// Structural similarity with its gradient, and Adam: the loops of fitting besides drawing.
#include <cmath>

#include "kernels_isa.hpp"

namespace splat::SPLAT_ISA {

namespace {

constexpr int kRadius = 5;  // Wang et al. 2004: an 11 x 11 Gaussian window, sigma 1.5 px
constexpr float kC1 = 0.01f * 0.01f, kC2 = 0.03f * 0.03f;

struct Window {
    float tap[2 * kRadius + 1];
    Window() {
        float total = 0;
        for (int i = -kRadius; i <= kRadius; ++i)
            total += tap[i + kRadius] = std::exp(-i * i / (2 * 1.5f * 1.5f));
        for (float& value : tap) value /= total;
    }
};

void blur_row(const float* in, float* out, int width, const Window& window) {
    for (int x = 0; x < width; ++x) out[x] = window.tap[kRadius] * in[x];
    for (int k = 1; k <= kRadius && k < width; ++k) {
        const float tap = window.tap[kRadius + k];
        for (int x = 0; x < width - k; ++x) out[x] += tap * in[x + k];
        for (int x = k; x < width; ++x) out[x] += tap * in[x - k];
    }
}

}  // namespace

void blur(const float* in, float* out, float* scratch, int width, int height) {
    static const Window window;
    for (int y = 0; y < height; ++y)
        blur_row(in + y * width, scratch + y * width, width, window);
    for (int y = 0; y < height; ++y) {
        float* row = out + y * width;
        for (int x = 0; x < width; ++x) row[x] = 0;
        for (int k = -kRadius; k <= kRadius; ++k) {
            if (y + k < 0 || y + k >= height) continue;
            const float* from = scratch + (y + k) * width;
            const float tap = window.tap[k + kRadius];
            for (int x = 0; x < width; ++x) row[x] += tap * from[x];
        }
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

}  // namespace splat::SPLAT_ISA

namespace splat::SPLAT_ISA {

#define SPLAT_TEXT_OF(name) #name
#define SPLAT_TEXT(name) SPLAT_TEXT_OF(name)

extern const Kernels kernels = {SPLAT_TEXT(SPLAT_ISA), project,    unproject_gradients,
                                draw_tile,             draw_tile_gradients, blur,
                                similarity,            adam};

}  // namespace splat::SPLAT_ISA
