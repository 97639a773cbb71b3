// Eight floats at a time, in GCC's and Clang's own vector types: the compiler picks the instructions.
#pragma once

#include <cstdint>
#include <cstring>

namespace soft {

constexpr int kLanes = 8;

typedef float Lanes __attribute__((vector_size(32)));
typedef float Four __attribute__((vector_size(16)));

struct Lanes3 {
    Lanes x, y, z;
};

inline Lanes load(const float* from) {
    Lanes lanes;
    std::memcpy(&lanes, from, sizeof(lanes));
    return lanes;
}

inline void store(float* to, Lanes lanes) { std::memcpy(to, &lanes, sizeof(lanes)); }

inline Four load_four(const float* from) {
    Four four;
    std::memcpy(&four, from, sizeof(four));
    return four;
}

// Rows of x, y, z, w at eight places become four vectors.
inline void gather(const float* rows, const std::int32_t* ids, Lanes3& p, Lanes& w) {
    Four r[kLanes];
    for (int k = 0; k < kLanes; ++k) r[k] = load_four(rows + 4 * ids[k]);
    const Lanes a = __builtin_shufflevector(r[0], r[4], 0, 1, 2, 3, 4, 5, 6, 7);
    const Lanes b = __builtin_shufflevector(r[1], r[5], 0, 1, 2, 3, 4, 5, 6, 7);
    const Lanes c = __builtin_shufflevector(r[2], r[6], 0, 1, 2, 3, 4, 5, 6, 7);
    const Lanes d = __builtin_shufflevector(r[3], r[7], 0, 1, 2, 3, 4, 5, 6, 7);
    const Lanes ab = __builtin_shufflevector(a, b, 0, 8, 1, 9, 4, 12, 5, 13);
    const Lanes cd = __builtin_shufflevector(c, d, 0, 8, 1, 9, 4, 12, 5, 13);
    const Lanes ab2 = __builtin_shufflevector(a, b, 2, 10, 3, 11, 6, 14, 7, 15);
    const Lanes cd2 = __builtin_shufflevector(c, d, 2, 10, 3, 11, 6, 14, 7, 15);
    p.x = __builtin_shufflevector(ab, cd, 0, 1, 8, 9, 4, 5, 12, 13);
    p.y = __builtin_shufflevector(ab, cd, 2, 3, 10, 11, 6, 7, 14, 15);
    p.z = __builtin_shufflevector(ab2, cd2, 0, 1, 8, 9, 4, 5, 12, 13);
    w = __builtin_shufflevector(ab2, cd2, 2, 3, 10, 11, 6, 7, 14, 15);
}

// The inverse of `gather`.
inline void scatter(float* rows, const std::int32_t* ids, const Lanes3& p, Lanes w) {
    const Lanes xy = __builtin_shufflevector(p.x, p.y, 0, 8, 1, 9, 4, 12, 5, 13);
    const Lanes xy2 = __builtin_shufflevector(p.x, p.y, 2, 10, 3, 11, 6, 14, 7, 15);
    const Lanes zw = __builtin_shufflevector(p.z, w, 0, 8, 1, 9, 4, 12, 5, 13);
    const Lanes zw2 = __builtin_shufflevector(p.z, w, 2, 10, 3, 11, 6, 14, 7, 15);
    const Lanes r[4] = {__builtin_shufflevector(xy, zw, 0, 1, 8, 9, 4, 5, 12, 13),
                        __builtin_shufflevector(xy, zw, 2, 3, 10, 11, 6, 7, 14, 15),
                        __builtin_shufflevector(xy2, zw2, 0, 1, 8, 9, 4, 5, 12, 13),
                        __builtin_shufflevector(xy2, zw2, 2, 3, 10, 11, 6, 7, 14, 15)};
    for (int k = 0; k < 4; ++k) {
        const Four low = __builtin_shufflevector(r[k], r[k], 0, 1, 2, 3);
        const Four high = __builtin_shufflevector(r[k], r[k], 4, 5, 6, 7);
        std::memcpy(rows + 4 * ids[k], &low, sizeof(low));
        std::memcpy(rows + 4 * ids[k + 4], &high, sizeof(high));
    }
}

inline Lanes3 cross(const Lanes3& a, const Lanes3& b) {
    return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}

inline Lanes dot(const Lanes3& a, const Lanes3& b) { return a.x * b.x + a.y * b.y + a.z * b.z; }

inline Lanes3 operator-(const Lanes3& a, const Lanes3& b) {
    return {a.x - b.x, a.y - b.y, a.z - b.z};
}

inline Lanes3 operator+(const Lanes3& a, const Lanes3& b) {
    return {a.x + b.x, a.y + b.y, a.z + b.z};
}

inline Lanes3 operator*(const Lanes3& a, Lanes s) { return {a.x * s, a.y * s, a.z * s}; }

}  // namespace soft
