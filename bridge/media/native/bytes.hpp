// Little-endian numbers at any address, whatever the processor.
#pragma once

#include <cstdint>
#include <cstring>

namespace rvl {

#if defined(__BYTE_ORDER__) && __BYTE_ORDER__ == __ORDER_BIG_ENDIAN__
inline std::uint16_t from_little(std::uint16_t x) { return __builtin_bswap16(x); }
inline std::uint32_t from_little(std::uint32_t x) { return __builtin_bswap32(x); }
inline std::uint64_t from_little(std::uint64_t x) { return __builtin_bswap64(x); }
#else
inline std::uint16_t from_little(std::uint16_t x) { return x; }
inline std::uint32_t from_little(std::uint32_t x) { return x; }
inline std::uint64_t from_little(std::uint64_t x) { return x; }
#endif

template <class Number>
Number load(const std::uint8_t* at) {
    Number value;
    std::memcpy(&value, at, sizeof value);
    return from_little(value);
}

template <class Number>
void store(std::uint8_t* at, Number value) {
    value = from_little(value);
    std::memcpy(at, &value, sizeof value);
}

}  // namespace rvl
