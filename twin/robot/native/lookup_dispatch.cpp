#include "lookup.hpp"

namespace lookups::base {
extern const Lookup table;
}
#ifdef GRID_HAS_X86
namespace lookups::v3 {
extern const Lookup table;
}
namespace lookups::v4 {
extern const Lookup table;
}
#endif

// What this processor can do.
Lookup lookup() {
#ifdef GRID_HAS_X86
    if (__builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512vl") &&
        __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512bw"))
        return lookups::v4::table;
    if (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma")) return lookups::v3::table;
#endif
    return lookups::base::table;
}
