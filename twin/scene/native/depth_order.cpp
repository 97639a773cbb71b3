#include "depth_order.hpp"

#include <algorithm>
#include <cstring>

namespace splat {

namespace {

constexpr int kDigitBits = 11;
constexpr int kDigits = 1 << kDigitBits;
constexpr int kPasses = 3;
constexpr std::size_t kSamples = 64;  // keys of each stretch among which the cuts are chosen

int digit_of(std::uint64_t entry, int pass) {
    return static_cast<int>(entry >> (32 + pass * kDigitBits)) & (kDigits - 1);
}

// Takes the smaller of two heads without a branch that depths would make unpredictable.
std::uint64_t* merge_two(const std::uint64_t* a, const std::uint64_t* a_end,
                         const std::uint64_t* b, const std::uint64_t* b_end, std::uint64_t* out) {
    while (a != a_end && b != b_end) {
        const bool first = *a < *b;
        *out++ = first ? *a : *b;
        a += first;
        b += !first;
    }
    out = std::copy(a, a_end, out);
    return std::copy(b, b_end, out);
}

}  // namespace

void DepthOrder::begin(int stretches) {
    stretches_.resize(stretches);
    for (Stretch& stretch : stretches_) stretch.entries.clear();
}

void DepthOrder::add(int stretch, float depth, std::uint32_t index) {
    std::uint32_t key;  // depths are positive, so their bits sort like the numbers
    std::memcpy(&key, &depth, sizeof key);
    stretches_[stretch].entries.push_back(std::uint64_t{key} << 32 | index);
}

// Radix sort by depth, least digit first: stable, so equal depths keep the order of their indices.
void DepthOrder::sort(int number) {
    Stretch& stretch = stretches_[number];
    std::uint32_t starts[kPasses][kDigits + 1] = {};
    for (const std::uint64_t entry : stretch.entries)
        for (int pass = 0; pass < kPasses; ++pass) ++starts[pass][digit_of(entry, pass) + 1];
    stretch.other.resize(stretch.entries.size());
    for (int pass = 0; pass < kPasses; ++pass) {
        for (int digit = 0; digit < kDigits; ++digit)
            starts[pass][digit + 1] += starts[pass][digit];
        for (const std::uint64_t entry : stretch.entries)
            stretch.other[starts[pass][digit_of(entry, pass)]++] = entry;
        stretch.entries.swap(stretch.other);
    }
}

void DepthOrder::cut() {
    const int slices = stretches();
    samples_.clear();
    for (const Stretch& stretch : stretches_) {
        const std::size_t size = stretch.entries.size(), taken = std::min(kSamples, size);
        for (std::size_t i = 0; i < taken; ++i)
            samples_.push_back(stretch.entries[i * size / taken]);
    }
    std::sort(samples_.begin(), samples_.end());
    slice_begin_.assign(slices + 1, 0);
    for (Stretch& stretch : stretches_) {
        const auto begin = stretch.entries.begin(), end = stretch.entries.end();
        stretch.cuts.assign(slices + 1, 0);
        stretch.cuts[slices] = static_cast<int>(stretch.entries.size());
        for (int slice = 1; slice < slices; ++slice) {
            if (samples_.empty()) break;
            const std::uint64_t key = samples_[samples_.size() * slice / slices];
            stretch.cuts[slice] = static_cast<int>(std::lower_bound(begin, end, key) - begin);
        }
        for (int slice = 0; slice <= slices; ++slice) slice_begin_[slice] += stretch.cuts[slice];
    }
    for (auto& merged : merged_)
        if (slices > 1) merged.resize(count());
}

void DepthOrder::merge(int slice, std::uint32_t* order) {
    struct Piece {
        const std::uint64_t *begin, *end;
    };
    std::vector<Piece> pieces;
    for (const Stretch& stretch : stretches_) {
        const std::uint64_t* entries = stretch.entries.data();
        pieces.push_back({entries + stretch.cuts[slice], entries + stretch.cuts[slice + 1]});
    }
    const int begin = slice_begin_[slice];
    for (int round = 0; pieces.size() > 1; ++round) {
        std::uint64_t* out = merged_[round % 2].data() + begin;
        std::vector<Piece> wider;
        for (std::size_t i = 0; i < pieces.size(); i += 2) {
            const Piece& a = pieces[i];
            const Piece b = i + 1 < pieces.size() ? pieces[i + 1] : Piece{a.end, a.end};
            std::uint64_t* const start = out;
            out = merge_two(a.begin, a.end, b.begin, b.end, out);
            wider.push_back({start, out});
        }
        pieces.swap(wider);
    }
    std::transform(pieces[0].begin, pieces[0].end, order + begin,
                   [](std::uint64_t entry) { return static_cast<std::uint32_t>(entry); });
}

}  // namespace splat
