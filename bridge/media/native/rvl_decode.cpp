#include <array>
#include <cstring>
#include <memory>

#include "bytes.hpp"
#include "rvl.hpp"

namespace rvl {
namespace {

constexpr unsigned kMaxLengthBits = 44;  // eleven nibbles; no encoder writes a longer run
constexpr unsigned kMaxDeltaBits = 24;   // six nibbles hold the 17 bits of a difference
constexpr unsigned kTableBits = 12;
constexpr std::uint64_t kLastNibble = 0x0888888888888888u;  // of the 15 that a window holds

unsigned first_set(std::uint64_t bits) {
#if defined(__GNUC__)
    return static_cast<unsigned>(__builtin_ctzll(bits));
#else
    unsigned count = 0;
    for (; !(bits & 1); bits >>= 1) ++count;
    return count;
#endif
}

std::uint64_t lowest(unsigned bits) { return (std::uint64_t{1} << bits) - 1; }

// Drops the top bit of eight nibbles and closes the gaps.
std::uint32_t join_nibbles(std::uint32_t x) {
    x = (x & 0x07070707u) | (x & 0x70707070u) >> 1;
    x = (x & 0x003f003fu) | (x & 0x3f003f00u) >> 2;
    return (x & 0xfffu) | (x & 0xfff0000u) >> 4;
}

std::uint32_t difference(std::uint32_t nibbles) {
    const std::uint32_t zigzag = join_nibbles(nibbles);
    return zigzag >> 1 ^ (0u - (zigzag & 1));
}

// The difference that starts a row of three nibbles, if it ends there.
const std::array<std::uint32_t, 1 << kTableBits>& short_differences() {
    static const auto table = [] {
        std::array<std::uint32_t, 1 << kTableBits> differences;
        for (std::uint32_t row = 0; row < differences.size(); ++row) {
            const std::uint64_t ends = ~row & kLastNibble;
            differences[row] = difference(row & static_cast<std::uint32_t>(ends ^ (ends - 1)));
        }
        return differences;
    }();
    return table;
}

class Reader {
  public:
    // Puts all nibbles in order, the first one lowest, so that a window can start at any of them.
    Reader(const std::uint8_t* stream, std::size_t num_words)
        : nibbles_(new std::uint8_t[4 * num_words + sizeof(std::uint64_t)]), end_(8 * num_words) {
        for (std::size_t word = 0; word < num_words; ++word) {
            std::uint32_t x = load<std::uint32_t>(stream + 4 * word);
            x = x >> 16 | x << 16;
            x = (x >> 8 & 0x00ff00ffu) | (x & 0x00ff00ffu) << 8;
            x = (x >> 4 & 0x0f0f0f0fu) | (x & 0x0f0f0f0fu) << 4;
            store(nibbles_.get() + 4 * word, x);
        }
        std::memset(nibbles_.get() + 4 * num_words, 0, sizeof(std::uint64_t));
    }

    bool length(std::size_t& value) {
        const std::uint64_t ends = ~window() & kLastNibble;
        if (!ends) return false;
        const unsigned bits = first_set(ends) + 1;
        const std::uint64_t nibbles = window() & lowest(bits);
        value = join_nibbles(static_cast<std::uint32_t>(nibbles)) |
                static_cast<std::size_t>(join_nibbles(static_cast<std::uint32_t>(nibbles >> 32)))
                    << 24;
        return bits <= kMaxLengthBits && advance(bits);
    }

    Result deltas(std::uint16_t* out, std::size_t count, std::uint32_t& previous) {
        const auto& table = short_differences();
        std::uint32_t value = previous, seen = 0;
        const auto put = [&](std::uint32_t delta) {
            value += delta;
            seen |= value;
            *out++ = static_cast<std::uint16_t>(value);
        };
        while (count) {
            const std::uint64_t row = window(), ends = ~row & kLastNibble;
            const std::uint64_t ends2 = ends & (ends - 1), ends3 = ends2 & (ends2 - 1),
                                ends4 = ends3 & (ends3 - 1);
            unsigned used = 0;
            if (count >= 4 && ends4) {
                // Where numbers end does not depend on what they are: the processor works on
                // four at once. Lengths are multiples of 4, so that one comparison serves all.
                const unsigned a = first_set(ends) + 1, b = first_set(ends2) + 1,
                               c = first_set(ends3) + 1, d = first_set(ends4) + 1;
                if ((a | (b - a) | (c - b) | (d - c)) <= kTableBits) {
                    put(table[row & lowest(kTableBits)]);
                    put(table[row >> a & lowest(kTableBits)]);
                    put(table[row >> b & lowest(kTableBits)]);
                    put(table[row >> c & lowest(kTableBits)]);
                    count -= 4;
                    used = d;
                }
            }
            for (std::uint64_t left = used ? 0 : ends; left && count; left &= left - 1, --count) {
                const unsigned end = first_set(left) + 1;
                if (end - used > kMaxDeltaBits) return Result::out_of_range;
                put(difference(static_cast<std::uint32_t>((row & lowest(end)) >> used)));
                used = end;
            }
            if (!used) return Result::out_of_range;
            if (!advance(used)) return Result::ends_early;
        }
        previous = value;
        return seen >> 16 ? Result::out_of_range : Result::ok;
    }

  private:
    std::uint64_t window() const {
        return load<std::uint64_t>(nibbles_.get() + at_ / 2) >> 4 * (at_ & 1);
    }

    bool advance(unsigned bits) {
        at_ += bits / 4;
        return at_ <= end_;
    }

    std::unique_ptr<std::uint8_t[]> nibbles_;
    std::size_t end_;
    std::size_t at_ = 0;  // at most `end_` whenever a window is taken
};

}  // namespace

Result decode(const std::uint8_t* stream, std::size_t num_bytes, std::uint16_t* pixels,
              std::size_t num_pixels) {
    Reader reader(stream, num_bytes / 4);
    std::uint32_t previous = 0;
    while (num_pixels) {
        std::size_t zeros, measured;
        if (!reader.length(zeros) || !reader.length(measured)) return Result::ends_early;
        if (zeros > num_pixels || measured > num_pixels - zeros) return Result::ends_early;
        std::memset(pixels, 0, 2 * zeros);
        pixels += zeros;
        const Result result = reader.deltas(pixels, measured, previous);
        if (result != Result::ok) return result;
        pixels += measured;
        num_pixels -= zeros + measured;
    }
    return Result::ok;
}

}  // namespace rvl
