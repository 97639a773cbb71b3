// How near the surface of a placed body comes to the zero level of a grid of distances.
//
// A surface is a tree of points: each has a radius within which everything below it lies, so a
// point at distance d cannot lead to less than d - radius, and most of the tree is never looked at
// (branch and bound; the children of the nearest point first). Plain double arithmetic in a fixed
// order: the same bits on every run. tests/parity/test_clearance_parity.py looks at every point.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <stdexcept>
#include <vector>

#include "lookup.hpp"

// A point of a surface with the distance found there, or a pair with its bound.
struct Visit {
    double distance;
    std::int32_t index;
};

constexpr double kShare = 0.02;
constexpr std::int64_t kMostCells = std::numeric_limits<std::int32_t>::max();

// Distances on a grid of voxels, which the caller keeps alive.
class Grid {
public:
    Grid(const float* rows, const std::int64_t* count, const double* origin, double voxel) {
        view_.rows = rows;
        view_.voxel = voxel;
        std::int64_t cells = 1;
        for (int axis = 0; axis < 3; ++axis) {
            view_.origin[axis] = origin[axis];
            if (count[axis] < 2) throw std::invalid_argument("a grid needs two voxels a side");
            if (count[axis] > kMostCells / cells)
                throw std::invalid_argument("a grid has at most two billion voxels");
            cells *= count[axis];
            view_.count[axis] = static_cast<std::int32_t>(count[axis]);
        }
    }

    // Trilinear; beyond the grid, e from its nearest point with d: sqrt(d^2 + e^2), or inside d + e.
    double at(const double* point) const {
        constexpr double kUnturned[9] = {1, 0, 0, 0, 1, 0, 0, 0, 1}, kHere[3] = {0, 0, 0};
        double distance = 0.0;
        lookup_(view_, kUnturned, kHere, point, 1, &distance);
        return distance;
    }

    // The same of many points that are turned and shifted.
    void at_all(const double* R, const double* t, const double* points, std::int32_t count,
                double* distances) const {
        for (std::int32_t begin = 0; begin < count; begin += kBatch)
            lookup_(view_, R, t, points + 3 * static_cast<std::ptrdiff_t>(begin),
                    std::min<std::int32_t>(kBatch, count - begin), distances + begin);
    }

private:
    GridView view_{};
    Lookup lookup_ = lookup();
};

// The surfaces of some bodies, which the caller keeps alive.
class Search {
public:
    Search(const Grid& grid, const double* points, const double* radius,
           const std::int32_t* children, std::int32_t count)
        : grid_(grid), points_(points), radius_(radius), children_(children), count_(count) {}

    // Smallest distance of the points below some roots, turned and shifted.
    double nearest(const double* turn, const double* shift, std::int32_t begin, std::int32_t end) {
        best_ = std::numeric_limits<double>::infinity();
        open_.clear();
        look(turn, shift, begin, end);
        while (!open_.empty()) {
            const Visit next = open_.back();
            open_.pop_back();
            if (!(next.distance - radius_[next.index] < certain())) continue;
            look(turn, shift, children_[2 * next.index], children_[2 * next.index + 1]);
        }
        return certain();
    }

private:
    // What the distance surely is not below; far away a little less than was found, so that a
    // long way from everything the search ends after a few points.
    double certain() const { return best_ > 0.0 ? best_ * (1.0 - kShare) : best_; }

    void look(const double* R, const double* t, std::int32_t begin, std::int32_t end) {
        if (begin < 0 || end > count_) throw std::out_of_range("a child is not there");
        found_.resize(static_cast<std::size_t>(end > begin ? end - begin : 0));
        grid_.at_all(R, t, points_ + 3 * static_cast<std::ptrdiff_t>(begin), end - begin, found_.data());
        for (const double distance : found_) best_ = std::min(best_, distance);
        // What cannot lead to less is left out at once: sorting it would cost more than finding it.
        const std::size_t first = open_.size();
        const double most = certain();
        for (std::int32_t index = begin; index < end; ++index) {
            const double distance = found_[static_cast<std::size_t>(index - begin)];
            if (children_[2 * index] < children_[2 * index + 1] && distance - radius_[index] < most)
                open_.push_back({distance, index});
        }
        // The nearest last: it is looked into next, and soonest makes the others needless.
        std::sort(open_.begin() + static_cast<std::ptrdiff_t>(first), open_.end(),
                  [](const Visit& a, const Visit& b) {
                      return a.distance != b.distance ? a.distance > b.distance
                                                      : a.index > b.index;
                  });
    }

    const Grid& grid_;
    const double* points_;
    const double* radius_;
    const std::int32_t* children_;
    std::int32_t count_;
    double best_ = 0.0;
    std::vector<Visit> open_;
    std::vector<double> found_;
};
