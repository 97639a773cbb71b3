// Adam, and the table of this instruction set's copies of all kernels.
#include "tile.hpp"

namespace splat::SPLAT_ISA {

void adam(float* __restrict values, const float* __restrict gradients, float* __restrict first,
          float* __restrict second, const AdamRates& rates, int count) {
    const float scale = rates.rate / rates.correction1;
    const float inverse2 = 1.0f / rates.correction2;
    for (int i = 0; i < count; ++i) {
        const float g = gradients[i];
        first[i] = rates.beta1 * first[i] + (1 - rates.beta1) * g;
        second[i] = rates.beta2 * second[i] + (1 - rates.beta2) * g * g;
        values[i] -= scale * first[i] / (std::sqrt(second[i] * inverse2) + rates.epsilon);
    }
}

#define SPLAT_TEXT_OF(name) #name
#define SPLAT_TEXT(name) SPLAT_TEXT_OF(name)

extern const Kernels kernels = {SPLAT_TEXT(SPLAT_ISA),
                                kTall,
                                project,
                                unproject_gradients,
                                draw_tile,
                                draw_tile_gradients,
                                draw_tile_features,
                                lift_tile,
                                label_tile,
                                surface_tile,
                                similarity_strip,
                                compare_row,
                                color_gradient_row,
                                depth_gradient_row,
                                adam};

}  // namespace splat::SPLAT_ISA
