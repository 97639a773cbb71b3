// Exponential and logarithm that the compiler can put in line; relative error about 3e-7.
#pragma once

#include <cstdint>

namespace splat::SPLAT_ISA {

constexpr float kLog2E = 1.4426950408889634f;

// 2^x, held at 2^-126 and 2^126; NaN stays NaN.
static inline float exp2_of(float x) {
    const float held = x < -126.0f ? -126.0f : (x > 126.0f ? 126.0f : x);
    const float magic = 12582912.0f;  // 1.5 * 2^23: adding it rounds to a whole number
    const float shifted = held + magic;
    const float f = held - (shifted - magic);
    float p = f * 1.3276460598e-3f + 9.6755412435e-3f;
    p = p * f + 5.5507133087e-2f;
    p = p * f + 2.4022119726e-1f;
    p = p * f + 6.9314696704e-1f;
    p = p * f + 1.0000000717f;
    std::uint32_t bits, power;
    __builtin_memcpy(&bits, &p, sizeof bits);
    __builtin_memcpy(&power, &shifted, sizeof power);
    bits += power << 23;
    __builtin_memcpy(&p, &bits, sizeof p);
    return x == x ? p : x;
}

static inline float exp_of(float x) { return exp2_of(x * kLog2E); }

// Of positive normal numbers, by the series of the inverse hyperbolic tangent.
static inline float log2_of(float x) {
    std::uint32_t bits;
    __builtin_memcpy(&bits, &x, sizeof bits);
    float whole = static_cast<float>(static_cast<std::int32_t>(bits >> 23) - 127);
    bits = (bits & 0x007fffffu) | 0x3f800000u;
    float m;
    __builtin_memcpy(&m, &bits, sizeof m);
    const bool large = m > 1.41421356f;
    m = large ? 0.5f * m : m;
    whole += large ? 1.0f : 0.0f;
    const float t = (m - 1.0f) / (m + 1.0f), t2 = t * t;
    float series = t2 * 0.320598898f + 0.412198583f;
    series = series * t2 + 0.577078016f;
    series = series * t2 + 0.961796694f;
    series = series * t2 + 2.885390082f;
    return whole + t * series;
}

}  // namespace splat::SPLAT_ISA
