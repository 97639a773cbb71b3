#include <array>

#include "bytes.hpp"
#include "rvl.hpp"

namespace rvl {
namespace {

constexpr int kTableBits = 12;

unsigned num_nibbles(std::uint32_t value) {
    unsigned count = 1;
    while (value >>= 3) ++count;
    return count;
}

// The nibbles of a number, the first one highest, right aligned; and how many bits that is.
struct Code {
    std::uint32_t nibbles;
    std::uint32_t bits;
};

Code code_of(std::uint32_t value) {
    Code code{0, 4 * num_nibbles(value)};
    for (unsigned left = code.bits; left; left -= 4, value >>= 3)
        code.nibbles = code.nibbles << 4 | (value & 7) | (left > 4 ? 8 : 0);
    return code;
}

// Differences of neighbours are nearly always small: one look-up instead of a loop.
const std::array<Code, 1 << kTableBits>& small_codes() {
    static const auto table = [] {
        std::array<Code, 1 << kTableBits> codes;
        for (std::uint32_t value = 0; value < codes.size(); ++value) codes[value] = code_of(value);
        return codes;
    }();
    return table;
}

class Writer {
  public:
    explicit Writer(std::uint8_t* out) : start_(out), out_(out) {}

    // At most 32 bits at a time. A whole word is stored whether full or not, so that no branch
    // depends on the data; the next store overwrites what was not full.
    void put(Code code) {
        pending_ |= static_cast<std::uint64_t>(code.nibbles) << (64 - used_ - code.bits);
        used_ += code.bits;
        store(out_, static_cast<std::uint32_t>(pending_ >> 32));
        const unsigned full = used_ >> 5;
        out_ += 4 * full;
        pending_ <<= 32 * full;
        used_ &= 31;
    }

    void put_length(std::uint64_t value) {
        do {
            const auto low = static_cast<std::uint32_t>(value & 7);
            value >>= 3;
            put({low | (value ? 8u : 0u), 4});
        } while (value);
    }

    std::size_t finish() {
        if (used_) {
            store(out_, static_cast<std::uint32_t>(pending_ >> 32));
            out_ += 4;
        }
        return static_cast<std::size_t>(out_ - start_);
    }

  private:
    std::uint8_t* start_;
    std::uint8_t* out_;
    std::uint64_t pending_ = 0;  // left aligned
    unsigned used_ = 0;          // bits of it, under 32 between calls
};

std::uint32_t zigzag(std::uint32_t value, std::uint32_t previous) {
    const auto delta = static_cast<std::int32_t>(value - previous);
    return static_cast<std::uint32_t>(delta) << 1 ^ static_cast<std::uint32_t>(delta >> 31);
}

bool is_zero(const std::uint8_t* at) { return load<std::uint16_t>(at) == 0; }

void put_deltas(Writer& writer, const std::uint8_t* at, const std::uint8_t* end,
                std::uint32_t& previous) {
    const auto& codes = small_codes();
    const auto code = [&codes](std::uint32_t value) {
        return value < codes.size() ? codes[value] : code_of(value);
    };
    for (; end - at >= 4; at += 4) {
        const std::uint32_t first = load<std::uint16_t>(at), second = load<std::uint16_t>(at + 2);
        const std::uint32_t a = zigzag(first, previous), b = zigzag(second, first);
        previous = second;
        if ((a | b) < codes.size()) {  // both fit into one word
            writer.put({codes[a].nibbles << codes[b].bits | codes[b].nibbles,
                        codes[a].bits + codes[b].bits});
        } else {
            writer.put(code(a));
            writer.put(code(b));
        }
    }
    if (at != end) {
        const std::uint32_t last = load<std::uint16_t>(at);
        writer.put(code(zigzag(last, previous)));
        previous = last;
    }
}

}  // namespace

std::size_t max_encoded_bytes(std::size_t num_pixels) {
    // Six nibbles a pixel at most; a run's two lengths fit into what its zeros save, but for runs
    // beyond 32767 pixels, of which few fit into an image. One word more is stored ahead.
    return 3 * num_pixels + num_pixels / 1024 + 64;
}

std::size_t encode(const std::uint8_t* pixels, std::size_t num_pixels, std::uint8_t* out) {
    const std::uint8_t* at = pixels;
    const std::uint8_t* const end = pixels + 2 * num_pixels;
    std::uint32_t previous = 0;
    Writer writer(out);
    while (at != end) {
        const std::uint8_t* const zeros = at;
        while (at != end && is_zero(at)) at += 2;
        const std::uint8_t* const measured = at;
        while (at != end && !is_zero(at)) at += 2;
        writer.put_length(static_cast<std::uint64_t>(measured - zeros) / 2);
        writer.put_length(static_cast<std::uint64_t>(at - measured) / 2);
        put_deltas(writer, measured, at, previous);
    }
    return writer.finish();
}

}  // namespace rvl
