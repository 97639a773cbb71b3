// Structural similarity (Wang et al. 2004: 11 x 11 Gaussian window, sigma 1.5 px) and its gradient.
//
// Zero padding, so that the adjoint of the blur is the blur. A strip of columns runs down the image
// through rings of eleven blurred rows that stay in the nearest cache: means of x, y, x^2 + y^2 and
// xy give the similarity of the row five above, its derivatives by the means are blurred again and
// give the gradient of the row ten above.
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

// Rows hold columns from ten (pixels) or five (means, derivatives before they are blurred) to the
// left of the strip on, so that a blurred row begins five columns further right than its source.
struct Strip {
    const float *x, *y;
    int width, height;
    int x0, columns;           // of the gradient
    int blocks, wide_blocks;   // vectors of a row of gradients, of means
    const float* tap;
    float means[kMeans][kTaps][kStripRow];
    float derivatives[kDerivatives][kTaps][kStripRow];
    float row[kMeans][kStripRow];  // before it is blurred along
};

// Values of a row of the image from ``column`` on, zero outside.
Floats load_inside(const float* row, int column, int width) {
    if (column >= 0 && column + kLanes <= width) return load(row + column);
    Floats value = Floats{};
    for (int i = 0; i < kLanes; ++i)
        if (column + i >= 0 && column + i < width) value[i] = row[column + i];
    return value;
}

int slot_of(int row) { return (row + 2 * kTaps) % kTaps; }  // rows begin at -10

void blur_along(const float* row, float* out, int blocks, const float* t) {
    for (int i = 0; i < blocks; ++i) {
        const float* at = row + i * kLanes + kBlurRadius;
        Floats total = load(at) * t[0];
        for (int k = 1; k <= kBlurRadius; ++k) total += (load(at - k) + load(at + k)) * t[k];
        store(out + i * kLanes, total);
    }
}

struct Column {
    const float* rows[kTaps];
    Column(const float (*ring)[kStripRow], int middle) {
        for (int k = 0; k < kTaps; ++k) rows[k] = ring[slot_of(middle + k - kBlurRadius)];
    }
    Floats blurred(int at, const float* t) const {
        Floats total = load(rows[kBlurRadius] + at) * t[0];
        for (int k = 1; k <= kBlurRadius; ++k)
            total += (load(rows[kBlurRadius - k] + at) + load(rows[kBlurRadius + k] + at)) * t[k];
        return total;
    }
};

void push_pixels(int row, Strip* strip) {
    const int slot = slot_of(row);
    if (row < 0 || row >= strip->height) {
        for (auto& ring : strip->means) __builtin_memset(ring[slot], 0, sizeof ring[slot]);
        return;
    }
    const std::int64_t start = static_cast<std::int64_t>(row) * strip->width;
    const int left = strip->x0 - 2 * kBlurRadius;
    const int source_blocks = (strip->columns + 4 * kBlurRadius + kLanes - 1) / kLanes;
    for (int i = 0; i < source_blocks; ++i) {
        const int at = i * kLanes;
        const Floats x = load_inside(strip->x + start, left + at, strip->width);
        const Floats y = load_inside(strip->y + start, left + at, strip->width);
        store(strip->row[kX] + at, x);
        store(strip->row[kY] + at, y);
        store(strip->row[kSquares] + at, x * x + y * y);
        store(strip->row[kProduct] + at, x * y);
    }
    for (int map = 0; map < kMeans; ++map)
        blur_along(strip->row[map], strip->means[map][slot], strip->wide_blocks, strip->tap);
}

// Which lanes lie in first..last, the first of them being ``at``.
Ints between(int at, int first, int last) {
    Ints lane;
    for (int i = 0; i < kLanes; ++i) lane[i] = i;
    lane += at;
    return (lane >= first) & (lane < last);
}

// Returns the sum of the similarity over one row, and blurs its derivatives along it.
double push_similarity(int row, Strip* strip) {
    const int slot = slot_of(row);
    if (row < 0 || row >= strip->height) {
        for (auto& ring : strip->derivatives) __builtin_memset(ring[slot], 0, sizeof ring[slot]);
        return 0;
    }
    const Column xs(strip->means[kX], row), ys(strip->means[kY], row);
    const Column squares(strip->means[kSquares], row), products(strip->means[kProduct], row);
    const float* t = strip->tap;
    const int left = strip->x0 - kBlurRadius;
    Floats total = Floats{};
    for (int i = 0; i < strip->wide_blocks; ++i) {
        const int at = i * kLanes;
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
        total += keep(between(left + at, strip->x0, strip->x0 + strip->columns), value);
        const Ints inside = between(left + at, 0, strip->width);
        store(strip->row[kByX] + at, keep(inside, by_x));
        store(strip->row[kBySquares] + at, keep(inside, by_squares));
        store(strip->row[kByProduct] + at, keep(inside, by_product));
    }
    for (int map = 0; map < kDerivatives; ++map)
        blur_along(strip->row[map], strip->derivatives[map][slot], strip->blocks, t);
    return sum(total);
}

void write_gradient(int row, const Strip& strip, float scale, float* gradient) {
    const Column by_x(strip.derivatives[kByX], row);
    const Column by_squares(strip.derivatives[kBySquares], row);
    const Column by_product(strip.derivatives[kByProduct], row);
    const std::int64_t start = static_cast<std::int64_t>(row) * strip.width + strip.x0;
    for (int i = 0; i < strip.blocks; ++i) {
        const int at = i * kLanes, left = strip.columns - at;
        const Floats x = load_some(strip.x + start + at, left);
        const Floats y = load_some(strip.y + start + at, left);
        const Floats d = by_x.blurred(at, strip.tap) +
                         2.0f * x * by_squares.blurred(at, strip.tap) +
                         y * by_product.blurred(at, strip.tap);
        store_some(gradient + start + at, d * scale, left);
    }
}

}  // namespace

double similarity_strip(const float* x, const float* y, float* gradient, float scale, int width,
                        int height, int x0) {
    static const Window window;
    Strip strip;  // rows of the rings are written before they are read
    strip.x = x, strip.y = y, strip.width = width, strip.height = height, strip.x0 = x0;
    strip.columns = width - x0 < kStripColumns ? width - x0 : kStripColumns;
    strip.blocks = (strip.columns + kLanes - 1) / kLanes;
    strip.wide_blocks = (strip.columns + 2 * kBlurRadius + kLanes - 1) / kLanes;
    strip.tap = window.tap;
    __builtin_memset(strip.row, 0, sizeof strip.row);
    double total = 0;
    for (int row = -2 * kBlurRadius; row < height + 2 * kBlurRadius; ++row) {
        push_pixels(row, &strip);
        if (row < 0) continue;
        total += push_similarity(row - kBlurRadius, &strip);
        const int done = row - 2 * kBlurRadius;
        if (done >= 0) write_gradient(done, strip, scale, gradient);
    }
    return total;
}

}  // namespace splat::SPLAT_ISA
