// Structural similarity (Wang et al. 2004: 11 x 11 Gaussian window, sigma 1.5 px) and its gradient.
//
// Zero padding, so that the adjoint of the blur is the blur. A band of rows streams through rings
// of eleven blurred rows that stay in the cache: means of x, y, x^2 + y^2 and xy give the
// similarity of the row five above, its derivatives by the means are blurred again and give the
// gradient of the row ten above.
#include <cmath>

#include "kernels_isa.hpp"
#include "lanes.hpp"

namespace splat::SPLAT_ISA {

namespace {

constexpr int kTaps = 2 * kBlurRadius + 1;
constexpr float kC1 = 0.01f * 0.01f, kC2 = 0.03f * 0.03f;
enum Mean { kX, kY, kSquares, kProduct, kMeans };
enum Derivative { kByX, kBySquares, kByProduct, kDerivatives };

struct Window {
    float tap[kBlurRadius + 1];  // centre and one side
    Window() {
        float total = 0;
        for (int i = 0; i <= kBlurRadius; ++i) {
            tap[i] = std::exp(-i * i / (2 * 1.5f * 1.5f));
            total += i == 0 ? tap[i] : 2 * tap[i];
        }
        for (float& value : tap) value /= total;
    }
};

struct Band {
    const float *x, *y;
    int width, height;
    int blocks;  // vectors in a row
    int stride;  // floats of a row in the rings
    const float* tap;
    float *means, *derivatives;  // rings: map by slot by column
    float* padded;               // rows with a margin on both sides, zero there
};

float* ring_row(float* ring, int map, int row, const Band& band) {
    const int slot = (row + 2 * kTaps) % kTaps;  // rows start at -10
    return ring + static_cast<std::int64_t>(map * kTaps + slot) * band.stride;
}

float* padded_row(const Band& band, int map) {
    return band.padded + static_cast<std::int64_t>(map) * (band.stride + 16) + 16;
}

void blur_along(const float* row, float* out, const Band& band) {
    const float* t = band.tap;
    for (int i = 0; i < band.blocks; ++i) {
        const float* at = row + i * kLanes;
        Floats total = load(at) * t[0];
        for (int k = 1; k <= kBlurRadius; ++k) total += (load(at - k) + load(at + k)) * t[k];
        store(out + i * kLanes, total);
    }
}

struct Column {
    const float* rows[kTaps];
    Column(float* ring, int map, int middle, const Band& band) {
        for (int k = 0; k < kTaps; ++k)
            rows[k] = ring_row(ring, map, middle + k - kBlurRadius, band);
    }
    Floats blurred(int at, const float* t) const {
        Floats total = load(rows[kBlurRadius] + at) * t[0];
        for (int k = 1; k <= kBlurRadius; ++k)
            total += (load(rows[kBlurRadius - k] + at) + load(rows[kBlurRadius + k] + at)) * t[k];
        return total;
    }
};

void clear(float* ring, int num_maps, int row, const Band& band) {
    for (int map = 0; map < num_maps; ++map)
        __builtin_memset(ring_row(ring, map, row, band), 0, sizeof(float) * band.stride);
}

void push_pixels(int row, const Band& band) {
    if (row < 0 || row >= band.height) return clear(band.means, kMeans, row, band);
    const std::int64_t start = static_cast<std::int64_t>(row) * band.width;
    for (int i = 0; i < band.blocks; ++i) {
        const int at = i * kLanes, left = band.width - at;
        const Floats x = load_some(band.x + start + at, left);
        const Floats y = load_some(band.y + start + at, left);
        store(padded_row(band, kX) + at, x);
        store(padded_row(band, kY) + at, y);
        store(padded_row(band, kSquares) + at, x * x + y * y);
        store(padded_row(band, kProduct) + at, x * y);
    }
    for (int map = 0; map < kMeans; ++map)
        blur_along(padded_row(band, map), ring_row(band.means, map, row, band), band);
}

// Returns the sum of the similarity over one row, and blurs its derivatives along it.
double push_similarity(int row, const Band& band) {
    if (row < 0 || row >= band.height) {
        clear(band.derivatives, kDerivatives, row, band);
        return 0;
    }
    const Column xs(band.means, kX, row, band), ys(band.means, kY, row, band);
    const Column squares(band.means, kSquares, row, band);
    const Column products(band.means, kProduct, row, band);
    const float* t = band.tap;
    Floats total = Floats{};
    for (int i = 0; i < band.blocks; ++i) {
        const int at = i * kLanes, left = band.width - at;
        const Floats mx = xs.blurred(at, t), my = ys.blurred(at, t);
        const Floats mean_squares = mx * mx + my * my;
        const Floats a1 = 2.0f * mx * my + kC1;
        const Floats a2 = 2.0f * (products.blurred(at, t) - mx * my) + kC2;
        const Floats b1 = mean_squares + kC1;
        const Floats b2 = squares.blurred(at, t) - mean_squares + kC2;
        const Floats inverse = 1.0f / (b1 * b2);
        const Floats value = a1 * a2 * inverse;
        const Floats by_squares = -value * b1 * inverse;
        const Floats by_product = 2.0f * a1 * inverse;
        const Floats by_x =
            2.0f * (my * (a2 - a1) * inverse - mx * (value * b2 * inverse + by_squares));
        const Ints inside = first_lanes(left);
        total += keep(inside, value);
        store(padded_row(band, kByX) + at, keep(inside, by_x));
        store(padded_row(band, kBySquares) + at, keep(inside, by_squares));
        store(padded_row(band, kByProduct) + at, keep(inside, by_product));
    }
    for (int map = 0; map < kDerivatives; ++map)
        blur_along(padded_row(band, map), ring_row(band.derivatives, map, row, band), band);
    return sum(total);
}

void write_gradient(int row, const Band& band, float scale, float* gradient) {
    const Column by_x(band.derivatives, kByX, row, band);
    const Column by_squares(band.derivatives, kBySquares, row, band);
    const Column by_product(band.derivatives, kByProduct, row, band);
    const std::int64_t start = static_cast<std::int64_t>(row) * band.width;
    for (int i = 0; i < band.blocks; ++i) {
        const int at = i * kLanes, left = band.width - at;
        const Floats x = load_some(band.x + start + at, left);
        const Floats y = load_some(band.y + start + at, left);
        const Floats d = by_x.blurred(at, band.tap) + 2.0f * x * by_squares.blurred(at, band.tap) +
                         y * by_product.blurred(at, band.tap);
        store_some(gradient + start + at, d * scale, left);
    }
}

}  // namespace

double similarity_band(const float* x, const float* y, float* gradient, float scale,
                       float* scratch, int width, int height, int y0, int y1) {
    static const Window window;
    Band band{x, y, width, height, (width + kLanes - 1) / kLanes, (width + 15) / 16 * 16 + 16,
              window.tap, scratch, nullptr, nullptr};
    band.derivatives = band.means + static_cast<std::int64_t>(kMeans) * kTaps * band.stride;
    band.padded = band.derivatives + static_cast<std::int64_t>(kDerivatives) * kTaps * band.stride;
    __builtin_memset(band.padded, 0, sizeof(float) * kMeans * (band.stride + 16));
    double total = 0;
    for (int row = y0 - 2 * kBlurRadius; row < y1 + 2 * kBlurRadius; ++row) {
        push_pixels(row, band);
        const int middle = row - kBlurRadius;
        if (middle < y0 - kBlurRadius) continue;
        const double value = push_similarity(middle, band);
        if (middle >= y0 && middle < y1) total += value;
        const int done = row - 2 * kBlurRadius;
        if (done >= y0) write_gradient(done, band, scale, gradient);
    }
    return total;
}

}  // namespace splat::SPLAT_ISA
