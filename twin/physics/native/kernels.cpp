// The two inner loops of soft bodies, compiled once per instruction set with the same rounding.
//
// XPBD (Macklin et al. 2016) whose constraint is the whole deformation gradient F of a tetrahedron
// and whose multipliers are the nine entries of its stress. A visit asks the material, here stable
// neo-Hookean (Smith et al. 2018, without the logarithm), for the stress P(F), and solves
//   dS + metric h^2 V dS N = P(F) - S,   N = sum_k w_k b_k b_k^T,
// for the change dS of the kept stress S; the nodes move by -w_k h^2 V dS b_k. Where nothing moves
// any more S equals P(F), whatever the number of visits: stiffness does not depend on the substep.
#include "tets.hpp"

namespace soft {
namespace SOFT_ISA {

namespace {

constexpr float kCrushed = 0.25f;       // below this share of its volume a tetrahedron stiffens
constexpr float kBarrier = 0.0f;        // by so many times lambda
constexpr float kVolumeShare = 0.5f;    // of the volume term's stiffness in the local step

struct Tets {
    Lanes3 p[4];
    Lanes w[4];
};

Tets load_nodes(const TetBlock& block, const float* nodes) {
    Tets tets;
    for (int k = 0; k < 4; ++k) gather(nodes, block.ids[k], tets.p[k], tets.w[k]);
    return tets;
}

// Moves the nodes by stress q acting for one substep, and stores them.
void move(const TetBlock& block, Tets& tets, const Lanes q[9], float* nodes) {
    const Lanes step = load(block.step_volume);
    Lanes3 sum{};
    for (int k = 0; k < 3; ++k) {
        const Lanes bx = load(block.b[3 * k]), by = load(block.b[3 * k + 1]),
                    bz = load(block.b[3 * k + 2]);
        const Lanes3 g{(q[0] * bx + q[1] * by + q[2] * bz) * step,
                       (q[3] * bx + q[4] * by + q[5] * bz) * step,
                       (q[6] * bx + q[7] * by + q[8] * bz) * step};
        tets.p[k + 1] = tets.p[k + 1] - g * tets.w[k + 1];
        sum = sum + g;
    }
    tets.p[0] = tets.p[0] + sum * tets.w[0];
    for (int k = 0; k < 4; ++k) scatter(nodes, block.ids[k], tets.p[k], tets.w[k]);
}

void apply_stress(TetBlock* blocks, int num_blocks, float* nodes) {
    for (int n = 0; n < num_blocks; ++n) {
        Tets tets = load_nodes(blocks[n], nodes);
        Lanes q[9];
        for (int k = 0; k < 9; ++k) q[k] = load(blocks[n].stress[k]);
        move(blocks[n], tets, q, nodes);
    }
}

// Stress against the change of shape in this substep: the symmetric part D of dF cof(F)^T, times
// cof(F). A turn costs nothing, and the power is D : D whatever F is, inside out included. It acts
// once and is not kept.
inline void add_viscosity(const TetBlock& block, const Tets& tets, const float* start,
                          const Lanes3 c[3], Lanes turned, Lanes q[9]) {
    const Lanes usual = Lanes{} + 3.0f;
    const Lanes larger = (turned > usual ? turned : usual) / usual;
    const Lanes scale = load(block.viscosity) / (larger * larger);
    Lanes3 moved[4];
    for (int k = 0; k < 4; ++k) {
        Lanes3 from;
        Lanes unused;
        gather(start, block.ids[k], from, unused);
        moved[k] = tets.p[k] - from;
    }
    const Lanes3 d1 = moved[1] - moved[0], d2 = moved[2] - moved[0], d3 = moved[3] - moved[0];
    Lanes3 d[3];
    for (int j = 0; j < 3; ++j)
        d[j] = d1 * load(block.b[j]) + d2 * load(block.b[3 + j]) + d3 * load(block.b[6 + j]);
    const Lanes xx = d[0].x * c[0].x + d[1].x * c[1].x + d[2].x * c[2].x;
    const Lanes yy = d[0].y * c[0].y + d[1].y * c[1].y + d[2].y * c[2].y;
    const Lanes zz = d[0].z * c[0].z + d[1].z * c[1].z + d[2].z * c[2].z;
    const Lanes xy = 0.5f * (d[0].x * c[0].y + d[1].x * c[1].y + d[2].x * c[2].y +
                             d[0].y * c[0].x + d[1].y * c[1].x + d[2].y * c[2].x);
    const Lanes yz = 0.5f * (d[0].y * c[0].z + d[1].y * c[1].z + d[2].y * c[2].z +
                             d[0].z * c[0].y + d[1].z * c[1].y + d[2].z * c[2].y);
    const Lanes zx = 0.5f * (d[0].z * c[0].x + d[1].z * c[1].x + d[2].z * c[2].x +
                             d[0].x * c[0].z + d[1].x * c[1].z + d[2].x * c[2].z);
    for (int j = 0; j < 3; ++j) {
        q[j] += scale * (xx * c[j].x + xy * c[j].y + zx * c[j].z);
        q[3 + j] += scale * (xy * c[j].x + yy * c[j].y + yz * c[j].z);
        q[6 + j] += scale * (zx * c[j].x + yz * c[j].y + zz * c[j].z);
    }
}

void relax(TetBlock* blocks, int num_blocks, float* nodes, const float* start, Material material) {
    const Lanes zero{};
    const Lanes mu = zero + material.mu, lambda = zero + material.lambda;
    const Lanes rest = zero + (1.0f + material.mu / material.lambda);
    const Lanes metric = zero + material.metric;
    const Lanes crushed = zero + kCrushed, barrier = lambda * kBarrier;
    for (int n = 0; n < num_blocks; ++n) {
        TetBlock& block = blocks[n];
        Tets tets = load_nodes(block, nodes);
        const Lanes3 d1 = tets.p[1] - tets.p[0], d2 = tets.p[2] - tets.p[0],
                     d3 = tets.p[3] - tets.p[0];
        Lanes3 f[3];  // columns of F
        for (int j = 0; j < 3; ++j)
            f[j] = d1 * load(block.b[j]) + d2 * load(block.b[3 + j]) + d3 * load(block.b[6 + j]);
        const Lanes3 c[3] = {cross(f[1], f[2]), cross(f[2], f[0]), cross(f[0], f[1])};
        const Lanes volume = dot(f[0], c[0]);
        const Lanes too_small = crushed - volume;
        const auto deep = too_small > zero;
        const Lanes pressure = lambda * (volume - rest) - (deep ? barrier * too_small : zero);
        const Lanes turned = dot(c[0], c[0]) + dot(c[1], c[1]) + dot(c[2], c[2]);
        const Lanes stiff =
            metric + ((deep ? lambda + barrier : lambda) * turned - lambda * 3.0f) * kVolumeShare;
        // Steps get shorter where the material is stiffer than the local matrix takes it to be.
        const Lanes shrink = stiff > metric ? metric / stiff : zero + 1.0f;
        Lanes3 e[3];  // columns of P(F) - S
        for (int j = 0; j < 3; ++j) {
            const Lanes3 kept{load(block.stress[j]), load(block.stress[3 + j]),
                              load(block.stress[6 + j])};
            e[j] = (f[j] * mu + c[j] * pressure - kept) * shrink;
        }
        const Lanes xx = load(block.z[0]), xy = load(block.z[1]), xz = load(block.z[2]),
                    yy = load(block.z[3]), yz = load(block.z[4]), zz = load(block.z[5]);
        const Lanes3 s[3] = {e[0] * xx + e[1] * xy + e[2] * xz, e[0] * xy + e[1] * yy + e[2] * yz,
                             e[0] * xz + e[1] * yz + e[2] * zz};
        Lanes q[9] = {s[0].x, s[1].x, s[2].x, s[0].y, s[1].y, s[2].y, s[0].z, s[1].z, s[2].z};
        const Lanes kept = load(block.kept);
        for (int k = 0; k < 9; ++k) store(block.stress[k], (load(block.stress[k]) + q[k]) * (kept * shrink));
        add_viscosity(block, tets, start, c, turned, q);
        move(block, tets, q, nodes);
    }
}

}  // namespace

const Kernels kernels{apply_stress, relax};

}  // namespace SOFT_ISA
}  // namespace soft
