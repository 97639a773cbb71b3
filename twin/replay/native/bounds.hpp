// Which pairs of placed bodies may be near: each is at least as far apart as the spheres and the
// boxes that hold its bodies. The same bits on every run; tests/parity/test_clearance_parity.py has
// the formula in NumPy.
#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <stdexcept>
#include <vector>

#include "grid_search.hpp"

namespace nb = nanobind;
using namespace nb::literals;

using Vector = nb::ndarray<const double, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Points = nb::ndarray<const double, nb::shape<-1, 3>, nb::c_contig, nb::device::cpu>;
using Turns = nb::ndarray<const double, nb::shape<-1, 3, 3>, nb::c_contig, nb::device::cpu>;
using Ranges = nb::ndarray<const std::int32_t, nb::shape<-1, 2>, nb::c_contig, nb::device::cpu>;
using Answers = nb::ndarray<double, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Order = nb::ndarray<std::int32_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;

// Lower bounds of the signed distances of pairs, nearest first.
class Bounds {
public:
    Bounds(const Points& centres, const Points& halves, const Vector& radii, const Ranges& pairs)
        : centres_(centres.data(), centres.data() + 3 * centres.shape(0)),
          halves_(halves.data(), halves.data() + 3 * halves.shape(0)),
          radii_(radii.data(), radii.data() + radii.shape(0)),
          pairs_(pairs.data(), pairs.data() + 2 * pairs.shape(0)), placed_(centres_.size()) {
        if (halves_.size() != centres_.size() || 3 * radii_.size() != centres_.size())
            throw std::invalid_argument("centres, halves and radii differ in number");
        for (const std::int32_t body : pairs_)
            if (body < 0 || static_cast<std::size_t>(body) >= radii_.size())
                throw std::out_of_range("a body of a pair is not there");
    }

    void nearest_first(const Turns& R, const Points& t, const Answers& bounds, const Order& order) {
        const std::size_t count = radii_.size(), num_pairs = pairs_.size() / 2;
        if (R.shape(0) != count || t.shape(0) != count || bounds.shape(0) != num_pairs ||
            order.shape(0) != num_pairs)
            throw std::invalid_argument("poses or answers differ in number");
        for (std::size_t body = 0; body < count; ++body) {
            const double *turn = R.data() + 9 * body, *c = &centres_[3 * body];
            for (int i = 0; i < 3; ++i)
                placed_[3 * body + i] = turn[3 * i] * c[0] + turn[3 * i + 1] * c[1] +
                                        turn[3 * i + 2] * c[2] + t.data()[3 * body + i];
        }
        found_.clear();
        for (std::size_t pair = 0; pair < num_pairs; ++pair)
            found_.push_back({apart(R.data(), pairs_[2 * pair], pairs_[2 * pair + 1]),
                              static_cast<std::int32_t>(pair)});
        std::sort(found_.begin(), found_.end(), [](const Visit& a, const Visit& b) {
            return a.distance != b.distance ? a.distance < b.distance : a.index < b.index;
        });
        for (std::size_t pair = 0; pair < num_pairs; ++pair) {
            bounds.data()[pair] = found_[pair].distance;
            order.data()[pair] = found_[pair].index;
        }
    }

private:
    double apart(const double* R, std::int32_t one, std::int32_t other) const {
        const double *A = R + 9 * one, *B = R + 9 * other;
        double way[3], M[3][3];
        for (int i = 0; i < 3; ++i) way[i] = placed_[3 * other + i] - placed_[3 * one + i];
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 3; ++j)
                M[i][j] = A[i] * B[j] + A[3 + i] * B[3 + j] + A[6 + i] * B[6 + j];
        const double *half_a = &halves_[3 * one], *half_b = &halves_[3 * other];
        // What the other's box and sphere leave free beside the own box, in the own frame; and
        // the other way round.
        double box_a[3], ball_a[3], box_b[3], ball_b[3];
        for (int i = 0; i < 3; ++i) {
            const double along_a = std::fabs(A[i] * way[0] + A[3 + i] * way[1] + A[6 + i] * way[2]);
            const double along_b = std::fabs(B[i] * way[0] + B[3 + i] * way[1] + B[6 + i] * way[2]);
            ball_a[i] = along_a - half_a[i];
            ball_b[i] = along_b - half_b[i];
            box_a[i] = ball_a[i] - std::fabs(M[i][0]) * half_b[0] -
                       std::fabs(M[i][1]) * half_b[1] - std::fabs(M[i][2]) * half_b[2];
            box_b[i] = ball_b[i] - std::fabs(M[0][i]) * half_a[0] -
                       std::fabs(M[1][i]) * half_a[1] - std::fabs(M[2][i]) * half_a[2];
        }
        const double length =
            std::sqrt(way[0] * way[0] + way[1] * way[1] + way[2] * way[2]);
        double best = length - radii_[one] - radii_[other];
        best = std::max(best, signed_length(ball_a) - radii_[other]);
        best = std::max(best, signed_length(ball_b) - radii_[one]);
        best = std::max(best, signed_length(box_a));
        return std::max(best, signed_length(box_b));
    }

    // Of the parts that are positive; the largest when none is.
    static double signed_length(const double* gap) {
        const double largest = std::max(gap[0], std::max(gap[1], gap[2]));
        if (!(largest > 0.0)) return largest;
        double sum = 0.0;
        for (int i = 0; i < 3; ++i) sum += gap[i] > 0.0 ? gap[i] * gap[i] : 0.0;
        return std::sqrt(sum);
    }

    std::vector<double> centres_, halves_, radii_;
    std::vector<std::int32_t> pairs_;
    std::vector<double> placed_;
    std::vector<Visit> found_;
};
