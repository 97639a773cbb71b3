// OpenMP where there is one; else one thread.
#pragma once

#ifdef _OPENMP
#include <omp.h>
#endif

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

}  // namespace splat
