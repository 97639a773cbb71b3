#include "kernels.hpp"

namespace motion::base {
extern const Kernels table;
}
#ifdef MOTION_HAS_X86
namespace motion::v3 {
extern const Kernels table;
}
namespace motion::v4 {
extern const Kernels table;
}
#endif

// What this processor can do, asked once.
const Kernels& kernels() {
#ifdef MOTION_HAS_X86
    if (__builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512vl") &&
        __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512bw"))
        return motion::v4::table;
    if (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma")) return motion::v3::table;
#endif
    return motion::base::table;
}
