// Which tetrahedra share a block, and which copy of the kernels runs on this processor.
#include <algorithm>
#include <array>
#include <cstring>

#include "tets.hpp"

namespace soft {

std::vector<std::int32_t> block_order(const std::int32_t* tets, int num_tets, int num_nodes) {
    // List scheduling: a node that many tetrahedra still wait for is the bottleneck.
    std::vector<int> waiting(num_nodes, 0);
    for (int i = 0; i < 4 * num_tets; ++i) ++waiting[tets[i]];
    std::vector<std::int32_t> rest(num_tets), order;
    for (int t = 0; t < num_tets; ++t) rest[t] = t;
    std::vector<int> used(num_nodes, -1);
    for (int block = 0; !rest.empty(); ++block) {
        const auto urgency = [&](std::int32_t t) {
            int most = 0, sum = 0;
            for (int k = 0; k < 4; ++k) {
                most = std::max(most, waiting[tets[4 * t + k]]);
                sum += waiting[tets[4 * t + k]];
            }
            return std::array<int, 3>{-most, -sum, t};
        };
        std::sort(rest.begin(), rest.end(),
                  [&](std::int32_t a, std::int32_t b) { return urgency(a) < urgency(b); });
        std::vector<std::int32_t> left;
        int filled = 0;
        for (const std::int32_t t : rest) {
            const std::int32_t* ids = tets + 4 * t;
            const bool free = filled < kLanes && std::none_of(ids, ids + 4, [&](std::int32_t id) {
                return used[id] == block;
            });
            if (!free) {
                left.push_back(t);
                continue;
            }
            for (int k = 0; k < 4; ++k) used[ids[k]] = block;
            order.push_back(t);
            ++filled;
        }
        for (std::size_t n = order.size() - filled; n < order.size(); ++n)
            for (int k = 0; k < 4; ++k) --waiting[tets[4 * order[n] + k]];
        for (; filled < kLanes; ++filled) order.push_back(-1);
        rest.swap(left);
    }
    return order;
}

const Kernels* kernels_named(const char* name) {
    const bool automatic = std::strcmp(name, "auto") == 0;
#ifdef SOFT_HAS_X86
    if ((automatic || std::strcmp(name, "v3") == 0) && __builtin_cpu_supports("avx2") &&
        __builtin_cpu_supports("bmi2"))
        return &v3::kernels;
#endif
    return automatic || std::strcmp(name, "base") == 0 ? &base::kernels : nullptr;
}

}  // namespace soft
