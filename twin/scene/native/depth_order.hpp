// Gaussians front to back, sorted by several threads.
#pragma once

#include <cstdint>
#include <vector>

namespace splat {

// Each stretch of Gaussians is sorted by one thread; the sorted stretches are then cut at common
// depths, and each thread merges one slice of all of them. Keys are depth above and index below, so
// no two are equal and there is one order, whatever the number of stretches.
class DepthOrder {
  public:
    // Forgets the last order. ``stretches`` is also the number of slices.
    void begin(int stretches);
    int stretches() const { return static_cast<int>(stretches_.size()); }

    // One thread each: adds a Gaussian (indices in increasing order), then sorts what was added.
    void add(int stretch, float depth, std::uint32_t index);
    void sort(int stretch);

    // Between the two: chooses where to cut.
    void cut();

    // One thread each: merges a slice; ``order`` has room for ``count()``, the slice fills
    // slice_begin(slice) to slice_begin(slice + 1).
    void merge(int slice, std::uint32_t* order);
    int slice_begin(int slice) const { return slice_begin_[slice]; }
    int count() const { return slice_begin_.back(); }

  private:
    struct alignas(64) Stretch {  // threads write to neighbours at the same time
        std::vector<std::uint64_t> entries, other;
        std::vector<int> cuts;  // where each slice begins in entries, and the end
    };

    std::vector<Stretch> stretches_;
    std::vector<std::uint64_t> samples_;
    std::vector<int> slice_begin_ = {0};
    std::vector<std::uint64_t> merged_[2];
};

}  // namespace splat
