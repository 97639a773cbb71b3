#include "kernels.hpp"

namespace base {
extern const Kernels table;
}
#ifdef MOTION_HAS_X86
namespace v3 {
extern const Kernels table;
}
namespace v4 {
extern const Kernels table;
}
#endif

// What this processor can do, asked once.
const Kernels& kernels() {
#ifdef MOTION_HAS_X86
    if (__builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512vl") &&
        __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512bw"))
        return v4::table;
    if (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma")) return v3::table;
#endif
    return base::table;
}
