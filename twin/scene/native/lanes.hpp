// Vectors of floats as the compiler's own vector types: AVX-512, AVX2, SSE and NEON from one source.
#pragma once

#include <cstdint>

namespace splat::SPLAT_ISA {

#if defined(__AVX512F__)
constexpr int kLanes = 16;
#elif defined(__AVX2__)
constexpr int kLanes = 8;
#else
constexpr int kLanes = 4;
#endif

typedef float Floats __attribute__((vector_size(4 * kLanes)));
typedef std::int32_t Ints __attribute__((vector_size(4 * kLanes)));
typedef std::uint32_t Uints __attribute__((vector_size(4 * kLanes)));
typedef float Floats4 __attribute__((vector_size(16)));
typedef std::int32_t Ints4 __attribute__((vector_size(16)));

static inline Floats all(float value) { return Floats{} + value; }

static inline Floats load(const float* at) {
    Floats value;
    __builtin_memcpy(&value, at, sizeof value);
    return value;
}
static inline void store(float* at, Floats value) { __builtin_memcpy(at, &value, sizeof value); }

// The first ``count`` lanes (at most all of them), zeros beyond.
static inline Floats load_some(const float* at, int count) {
    if (count >= kLanes) return load(at);
    Floats value = Floats{};
    for (int i = 0; i < count; ++i) value[i] = at[i];
    return value;
}

static inline void store_some(float* at, Floats value, int count) {
    if (count >= kLanes) return store(at, value);
    for (int i = 0; i < count; ++i) at[i] = value[i];
}

// Keep value where mask is -1, else 0.
static inline Floats keep(Ints mask, Floats value) { return (Floats)((Ints)value & mask); }

static inline Floats smaller(Floats x, Floats y) { return x < y ? x : y; }

static inline Floats positive(Floats x) { return (Floats)((Ints)x & 0x7fffffff); }

static inline Floats4 folded(Floats value) {
    float lanes[kLanes];
    store(lanes, value);
    Floats4 total;
    __builtin_memcpy(&total, lanes, sizeof total);
    for (int i = 4; i < kLanes; i += 4) {
        Floats4 part;
        __builtin_memcpy(&part, lanes + i, sizeof part);
        total += part;
    }
    return total;
}

static inline float sum(Floats value) {
    const Floats4 four = folded(value);
    return (four[0] + four[2]) + (four[1] + four[3]);
}

#if defined(__clang__)
#define SPLAT_PICK(x, y, i, j, k, l) __builtin_shufflevector(x, y, i, j, k, l)
#else
#define SPLAT_PICK(x, y, i, j, k, l) __builtin_shuffle(x, y, Ints4{i, j, k, l})
#endif

// The sums over the lanes of four vectors at once, added in the order of ``sum``.
static inline Floats4 four_sums(Floats a, Floats b, Floats c, Floats d) {
    const Floats4 p = folded(a), q = folded(b), r = folded(c), s = folded(d);
    const Floats4 pq = SPLAT_PICK(p, q, 0, 4, 1, 5) + SPLAT_PICK(p, q, 2, 6, 3, 7);
    const Floats4 rs = SPLAT_PICK(r, s, 0, 4, 1, 5) + SPLAT_PICK(r, s, 2, 6, 3, 7);
    return SPLAT_PICK(pq, rs, 0, 1, 4, 5) + SPLAT_PICK(pq, rs, 2, 3, 6, 7);
}

// 2^x for x in [-126, 126]; relative error 8e-8 (least-squares fit on [-1/2, 1/2]). Beyond, any
// number: callers drop it. The exponent is added without signs, for there it may wrap around.
static inline Floats exp2(Floats x) {
    const float magic = 12582912.0f;  // 1.5 * 2^23: adding it rounds to a whole number
    const Floats shifted = x + magic;
    const Floats f = x - (shifted - magic);
    Floats p = f * 1.3276460598e-3f + 9.6755412435e-3f;
    p = p * f + 5.5507133087e-2f;
    p = p * f + 2.4022119726e-1f;
    p = p * f + 6.9314696704e-1f;
    p = p * f + 1.0000000717f;
    return (Floats)((Uints)p + ((Uints)shifted << 23));
}

}  // namespace splat::SPLAT_ISA
