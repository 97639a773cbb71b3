// Which copy of the kernels runs on this processor.
#include <cstring>

#include "rasteriser.hpp"

namespace splat {

namespace {

#ifdef SPLAT_HAS_X86
bool runs_v3() {
    return __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") &&
           __builtin_cpu_supports("bmi2");
}

bool runs_v4() {
    return runs_v3() && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") &&
           __builtin_cpu_supports("avx512cd") && __builtin_cpu_supports("avx512dq") &&
           __builtin_cpu_supports("avx512vl");
}
#endif

}  // namespace

const Kernels* kernels_named(const char* name) {
    const bool automatic = std::strcmp(name, "auto") == 0;
    const auto wanted = [&](const char* isa) { return automatic || std::strcmp(name, isa) == 0; };
#ifdef SPLAT_HAS_X86
    if (wanted("v4") && runs_v4()) return &v4::kernels;
    if (wanted("v3") && runs_v3()) return &v3::kernels;
    if (!__builtin_cpu_supports("sse4.2")) return nullptr;
#endif
    return wanted("base") ? &base::kernels : nullptr;
}

}  // namespace splat
