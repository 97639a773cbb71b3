// Distances at the points of a grid, trilinear in between.
#pragma once

#include "bounds.hpp"

using Values = nb::ndarray<const float, nb::ndim<3>, nb::c_contig, nb::device::cpu>;

class Grid {
public:
    Grid(const Values& values, const Vector& origin, double voxel)
        : rows_(values.data()), voxel_(voxel) {
        for (int axis = 0; axis < 3; ++axis) {
            count_[axis] = static_cast<std::int64_t>(values.shape(axis));
            origin_[axis] = origin.data()[axis];
            if (count_[axis] < 2) throw std::invalid_argument("a grid needs two voxels a side");
        }
    }

    // Trilinear; beyond the grid as if all solid were inside of it (see GridLookup.at).
    double at(const double* point) const {
        std::int64_t cell[3];
        double share[3], beyond = 0.0;
        for (int axis = 0; axis < 3; ++axis) {
            const double place = (point[axis] - origin_[axis]) / voxel_;
            const double last = static_cast<double>(count_[axis] - 1);
            // Written so that what is no number ends up inside of the grid.
            const double held = place > 0.0 ? (place < last ? place : last) : 0.0;
            cell[axis] = std::min(static_cast<std::int64_t>(held), count_[axis] - 2);
            share[axis] = held - static_cast<double>(cell[axis]);
            beyond += (place - held) * (place - held);
        }
        const std::int64_t step_x = count_[1] * count_[2], step_y = count_[2];
        const float* c = rows_ + cell[0] * step_x + cell[1] * step_y + cell[2];
        const auto along_z = [&](std::int64_t from) {
            const double low = c[from], high = c[from + 1];
            return low + (high - low) * share[2];
        };
        const auto along_y = [&](std::int64_t from) {
            const double low = along_z(from), high = along_z(from + step_y);
            return low + (high - low) * share[1];
        };
        const double low = along_y(0), high = along_y(step_x);
        const double value = low + (high - low) * share[0];
        if (!(beyond > 0.0)) return value;
        const double far = std::sqrt(beyond) * voxel_;
        return value > 0.0 ? std::sqrt(value * value + far * far) : value + far;
    }

private:
    const float* rows_;
    double voxel_;
    std::int64_t count_[3];
    double origin_[3];
};
