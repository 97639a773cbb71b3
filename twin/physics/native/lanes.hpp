// Eight floats at a time, in GCC's and Clang's own vector types: the compiler picks the instructions.
// Everything is static: these headers are compiled once per instruction set, and of an inline
// function that several files share the linker keeps any one copy, whatever it was compiled for.
#pragma once

#include <cstdint>
#include <cstring>

namespace soft {

constexpr int kLanes = 8;

typedef float Lanes __attribute__((vector_size(32)));
typedef float Four __attribute__((vector_size(16)));

// Compilers before GCC 12 have another name for choosing lanes, and none for joining vectors.
#if defined(__clang__) || __GNUC__ >= 12
#define SOFT_PICK(a, b, ...) __builtin_shufflevector(a, b, __VA_ARGS__)
#define SOFT_PICK_FOUR(a, b, ...) __builtin_shufflevector(a, b, __VA_ARGS__)

static inline Lanes join(Four low, Four high) {
    return __builtin_shufflevector(low, high, 0, 1, 2, 3, 4, 5, 6, 7);
}
static inline Four low_half(Lanes a) { return __builtin_shufflevector(a, a, 0, 1, 2, 3); }
static inline Four high_half(Lanes a) { return __builtin_shufflevector(a, a, 4, 5, 6, 7); }
#else
typedef std::int32_t Ints __attribute__((vector_size(32)));
typedef std::int32_t FourInts __attribute__((vector_size(16)));
#define SOFT_PICK(a, b, ...) __builtin_shuffle(a, b, Ints{__VA_ARGS__})
#define SOFT_PICK_FOUR(a, b, ...) __builtin_shuffle(a, b, FourInts{__VA_ARGS__})

static inline Lanes join(Four low, Four high) {
    return Lanes{low[0], low[1], low[2], low[3], high[0], high[1], high[2], high[3]};
}
static inline Four low_half(Lanes a) { return Four{a[0], a[1], a[2], a[3]}; }
static inline Four high_half(Lanes a) { return Four{a[4], a[5], a[6], a[7]}; }
#endif

struct Lanes3 {
    Lanes x, y, z;
};

static inline Lanes load(const float* from) {
    Lanes lanes;
    std::memcpy(&lanes, from, sizeof(lanes));
    return lanes;
}

static inline void store(float* to, Lanes lanes) { std::memcpy(to, &lanes, sizeof(lanes)); }

static inline Four load_four(const float* from) {
    Four four;
    std::memcpy(&four, from, sizeof(four));
    return four;
}

// Rows of x, y, z, w at eight places become four vectors.
static inline void gather(const float* rows, const std::int32_t* ids, Lanes3& p, Lanes& w) {
    Four r[kLanes];
    for (int k = 0; k < kLanes; ++k) r[k] = load_four(rows + 4 * ids[k]);
    const Lanes a = join(r[0], r[4]);
    const Lanes b = join(r[1], r[5]);
    const Lanes c = join(r[2], r[6]);
    const Lanes d = join(r[3], r[7]);
    const Lanes ab = SOFT_PICK(a, b, 0, 8, 1, 9, 4, 12, 5, 13);
    const Lanes cd = SOFT_PICK(c, d, 0, 8, 1, 9, 4, 12, 5, 13);
    const Lanes ab2 = SOFT_PICK(a, b, 2, 10, 3, 11, 6, 14, 7, 15);
    const Lanes cd2 = SOFT_PICK(c, d, 2, 10, 3, 11, 6, 14, 7, 15);
    p.x = SOFT_PICK(ab, cd, 0, 1, 8, 9, 4, 5, 12, 13);
    p.y = SOFT_PICK(ab, cd, 2, 3, 10, 11, 6, 7, 14, 15);
    p.z = SOFT_PICK(ab2, cd2, 0, 1, 8, 9, 4, 5, 12, 13);
    w = SOFT_PICK(ab2, cd2, 2, 3, 10, 11, 6, 7, 14, 15);
}

// The inverse of `gather`.
static inline void scatter(float* rows, const std::int32_t* ids, const Lanes3& p, Lanes w) {
    const Lanes xy = SOFT_PICK(p.x, p.y, 0, 8, 1, 9, 4, 12, 5, 13);
    const Lanes xy2 = SOFT_PICK(p.x, p.y, 2, 10, 3, 11, 6, 14, 7, 15);
    const Lanes zw = SOFT_PICK(p.z, w, 0, 8, 1, 9, 4, 12, 5, 13);
    const Lanes zw2 = SOFT_PICK(p.z, w, 2, 10, 3, 11, 6, 14, 7, 15);
    const Lanes r[4] = {SOFT_PICK(xy, zw, 0, 1, 8, 9, 4, 5, 12, 13),
                        SOFT_PICK(xy, zw, 2, 3, 10, 11, 6, 7, 14, 15),
                        SOFT_PICK(xy2, zw2, 0, 1, 8, 9, 4, 5, 12, 13),
                        SOFT_PICK(xy2, zw2, 2, 3, 10, 11, 6, 7, 14, 15)};
    for (int k = 0; k < 4; ++k) {
        const Four low = low_half(r[k]);
        const Four high = high_half(r[k]);
        std::memcpy(rows + 4 * ids[k], &low, sizeof(low));
        std::memcpy(rows + 4 * ids[k + 4], &high, sizeof(high));
    }
}

static inline Lanes3 cross(const Lanes3& a, const Lanes3& b) {
    return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}

static inline Lanes dot(const Lanes3& a, const Lanes3& b) { return a.x * b.x + a.y * b.y + a.z * b.z; }

static inline Lanes3 operator-(const Lanes3& a, const Lanes3& b) {
    return {a.x - b.x, a.y - b.y, a.z - b.z};
}

static inline Lanes3 operator+(const Lanes3& a, const Lanes3& b) {
    return {a.x + b.x, a.y + b.y, a.z + b.z};
}

static inline Lanes3 operator*(const Lanes3& a, Lanes s) { return {a.x * s, a.y * s, a.z * s}; }

}  // namespace soft
