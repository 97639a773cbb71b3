// Tetrahedra that resist deformation, eight to a block; no two of a block share a node.
#pragma once

#include <cstdint>
#include <vector>

#include "lanes.hpp"

namespace soft {

struct Material {
    float mu, lambda;     // of the stable neo-Hookean energy, not Lame's [Pa]
    float metric;         // stiffness the local step assumes [Pa]
};

struct alignas(32) TetBlock {
    std::int32_t ids[4][kLanes];
    float b[9][kLanes];        // inverse of the edge matrix at rest, row by row [1/m]
    float z[6][kLanes];        // xx, xy, xz, yy, yz, zz of the local step's 3 x 3 matrix
    float stress[9][kLanes];   // first Piola-Kirchhoff stress kept from visit to visit [Pa]
    float viscosity[kLanes];   // stress that takes away a change of shape within a substep [Pa]
    float kept[kLanes];        // share of the stress that the next substep begins with
    float step_volume[kLanes]; // rest volume times the square of the substep [m^3 s^2]
};

struct Kernels {
    // Moves the nodes by what the kept stress does in one substep.
    void (*apply_stress)(TetBlock* blocks, int num_blocks, float* nodes);
    // One visit of every block: stress and nodes come nearer to the material's law.
    void (*relax)(TetBlock* blocks, int num_blocks, float* nodes, const float* start,
                  Material material);
};

namespace base {
extern const Kernels kernels;
}
namespace v3 {
extern const Kernels kernels;
}

// "auto", "base" or "v3"; null where this processor cannot run it.
const Kernels* kernels_named(const char* name);

// Orders tetrahedra into blocks, the busiest nodes first; -1 fills the last lanes of a block.
std::vector<std::int32_t> block_order(const std::int32_t* tets, int num_tets, int num_nodes);

}  // namespace soft
