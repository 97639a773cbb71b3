// Vectors of floats as the compiler's own vector types: AVX2, SSE2 and NEON from one source.
#pragma once

#include <cstdint>

namespace splat::SPLAT_ISA {

#if defined(__AVX2__)
constexpr int kLanes = 8;
#else
constexpr int kLanes = 4;
#endif

typedef float Floats __attribute__((vector_size(4 * kLanes)));
typedef std::int32_t Ints __attribute__((vector_size(4 * kLanes)));

static inline Floats all(float value) { return Floats{} + value; }

static inline Floats load(const float* at) {
    Floats value;
    __builtin_memcpy(&value, at, sizeof value);
    return value;
}

static inline void store(float* at, Floats value) { __builtin_memcpy(at, &value, sizeof value); }

// Keep value where mask is -1, else 0.
static inline Floats keep(Ints mask, Floats value) { return (Floats)((Ints)value & mask); }

static inline Floats smaller(Floats x, Floats y) { return x < y ? x : y; }

static inline float sum(Floats value) {
    float total = 0;
    for (int i = 0; i < kLanes; ++i) total += value[i];
    return total;
}

// 2^x for x in [-126, 126]; relative error 8e-8 (least-squares fit on [-1/2, 1/2]).
static inline Floats exp2(Floats x) {
    const float magic = 12582912.0f;  // 1.5 * 2^23: adding it rounds to a whole number
    const Floats shifted = x + magic;
    const Floats f = x - (shifted - magic);
    Floats p = f * 1.3276460598e-3f + 9.6755412435e-3f;
    p = p * f + 5.5507133087e-2f;
    p = p * f + 2.4022119726e-1f;
    p = p * f + 6.9314696704e-1f;
    p = p * f + 1.0000000717f;
    return (Floats)((Ints)p + ((Ints)shifted << 23));
}

}  // namespace splat::SPLAT_ISA
