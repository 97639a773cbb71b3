// OpenMP where there is one; else one thread.
#pragma once

#ifdef _OPENMP
#include <omp.h>
#endif

#include <chrono>

namespace splat {

static inline int thread_count(int wanted) {
#ifdef _OPENMP
    return wanted > 0 ? wanted : omp_get_max_threads();
#else
    (void)wanted;
    return 1;
#endif
}

static inline int thread_index() {
#ifdef _OPENMP
    return omp_get_thread_num();
#else
    return 0;
#endif
}

// Stands before a loop that threads share and adds the time of its scope to a sum. What a step
// takes beyond that sum is serial, and bounds what more threads can gain.
class InParallel {
  public:
    explicit InParallel(double* seconds) : seconds_(seconds) {}
    ~InParallel() {
        *seconds_ += std::chrono::duration<double>(Clock::now() - start_).count();
    }
    InParallel(const InParallel&) = delete;
    InParallel& operator=(const InParallel&) = delete;

  private:
    using Clock = std::chrono::steady_clock;
    double* seconds_;
    Clock::time_point start_ = Clock::now();
};

}  // namespace splat
