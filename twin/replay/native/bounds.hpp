// Which pairs of placed bodies may be near: each is at least as far apart as the spheres and the
// boxes that hold its bodies. Where somebody asks for what is near only, a pair is left out too when
// a plane parts the hulls of its corners by more than that, most often the one that did last time.
// The same pairs remain whatever was asked before, but for those that are as far as was asked to
// within kMeasured. tests/parity/test_clearance_parity.py has the formula of the bounds in NumPy.
#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <stdexcept>
#include <vector>

#include "twin/robot/native/grid_search.hpp"
#include "twin/robot/native/separation.hpp"

namespace nb = nanobind;
using namespace nb::literals;

using Vector = nb::ndarray<const double, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Points = nb::ndarray<const double, nb::shape<-1, 3>, nb::c_contig, nb::device::cpu>;
using Turns = nb::ndarray<const double, nb::shape<-1, 3, 3>, nb::c_contig, nb::device::cpu>;
using Ranges = nb::ndarray<const std::int32_t, nb::shape<-1, 2>, nb::c_contig, nb::device::cpu>;
using Answers = nb::ndarray<double, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Order = nb::ndarray<std::int32_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;

// Corners of a convex body in its own frame, filled up to whole lanes by repeating the last one.
class Corners {
public:
    Corners(const double* points, std::size_t count) {
        if (count == 0) return;
        for (std::size_t i = 0; i < (count + kLanes - 1) / kLanes * kLanes; ++i) {
            const double* p = points + 3 * std::min(i, count - 1);
            x_.push_back(p[0]);
            y_.push_back(p[1]);
            z_.push_back(p[2]);
        }
    }

    bool empty() const { return x_.empty(); }

    // The corner that lies farthest along a direction.
    Vec farthest(Vec d) const {
        double best[kLanes];
        std::size_t block[kLanes] = {};
        for (std::size_t lane = 0; lane < kLanes; ++lane)
            best[lane] = d.x * x_[lane] + d.y * y_[lane] + d.z * z_[lane];
        for (std::size_t begin = kLanes; begin < x_.size(); begin += kLanes)
            for (std::size_t lane = 0; lane < kLanes; ++lane) {
                const std::size_t i = begin + lane;
                const double along = d.x * x_[i] + d.y * y_[i] + d.z * z_[i];
                block[lane] = along > best[lane] ? begin : block[lane];
                best[lane] = along > best[lane] ? along : best[lane];
            }
        std::size_t lane = 0;
        for (std::size_t other = 1; other < kLanes; ++other)
            if (best[other] > best[lane]) lane = other;
        const std::size_t found = block[lane] + lane;
        return {x_[found], y_[found], z_[found]};
    }

private:
    static constexpr std::size_t kLanes = 8;
    std::vector<double> x_, y_, z_;
};

// Lower bounds of the signed distances of pairs, nearest first.
class Bounds {
public:
    // Each body's corners are a range of `corners`; none: only its box and sphere are known.
    Bounds(const Points& centres, const Points& halves, const Vector& radii, const Points& corners,
           const Ranges& ranges, const Ranges& pairs)
        : centres_(centres.data(), centres.data() + 3 * centres.shape(0)),
          halves_(halves.data(), halves.data() + 3 * halves.shape(0)),
          radii_(radii.data(), radii.data() + radii.shape(0)),
          pairs_(pairs.data(), pairs.data() + 2 * pairs.shape(0)), placed_(centres_.size()),
          guesses_(pairs.shape(0)) {
        if (halves_.size() != centres_.size() || 3 * radii_.size() != centres_.size() ||
            ranges.shape(0) != radii_.size())
            throw std::invalid_argument("centres, halves, radii and corners differ in number");
        for (const std::int32_t body : pairs_)
            if (body < 0 || static_cast<std::size_t>(body) >= radii_.size())
                throw std::out_of_range("a body of a pair is not there");
        for (std::size_t body = 0; body < radii_.size(); ++body) {
            const std::int32_t *range = ranges.data() + 2 * body, begin = range[0], end = range[1];
            if (begin < 0 || end < begin || static_cast<std::size_t>(end) > corners.shape(0))
                throw std::out_of_range("a corner of a body is not there");
            corners_.emplace_back(corners.data() + 3 * static_cast<std::ptrdiff_t>(begin),
                                  static_cast<std::size_t>(end - begin));
        }
    }

    // Those that are not above `up_to` come first, in order; says how many they are.
    std::size_t nearest_first(const Turns& R, const Points& t, const Answers& bounds,
                              const Order& order, double up_to) {
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
        for (std::size_t pair = 0; pair < num_pairs; ++pair) {
            const double least = apart(R.data(), pairs_[2 * pair], pairs_[2 * pair + 1], up_to);
            // What is no number is asked about.
            if (least > up_to || parted(R.data(), t.data(), pair, up_to)) continue;
            found_.push_back({least, static_cast<std::int32_t>(pair)});
        }
        std::sort(found_.begin(), found_.end(), [](const Visit& a, const Visit& b) {
            return a.distance != b.distance ? a.distance < b.distance : a.index < b.index;
        });
        for (std::size_t place = 0; place < found_.size(); ++place) {
            bounds.data()[place] = found_[place].distance;
            order.data()[place] = found_[place].index;
        }
        return found_.size();
    }

private:
    // Whether a plane between the hulls of a pair keeps them farther apart than that.
    bool parted(const double* R, const double* t, std::size_t pair, double up_to) {
        // What is measured may differ from the truth by less: no pair is left out that would be
        // found to be as near as was asked.
        constexpr double kMeasured = 3e-6;
        const auto one = static_cast<std::size_t>(pairs_[2 * pair]);
        const auto other = static_cast<std::size_t>(pairs_[2 * pair + 1]);
        if (!std::isfinite(up_to) || corners_[one].empty() || corners_[other].empty()) return false;
        const Pose first = pose_of(R + 9 * one, t + 3 * one);
        const Pose second = pose_of(R + 9 * other, t + 3 * other);
        Vec& guess = guesses_[pair];
        if (!(dot(guess, guess) > 0.0)) {
            const double *a = &placed_[3 * one], *b = &placed_[3 * other];
            guess = {a[0] - b[0], a[1] - b[1], a[2] - b[2]};
        }
        const double enough = up_to + kMeasured;
        const Separation found = separation(
            [&](Vec d) {
                return first.apply(corners_[one].farthest(first.turn_back(d))) -
                       second.apply(corners_[other].farthest(second.turn_back(-1.0 * d)));
            },
            enough, enough, guess);
        return found.least >= enough;
    }

    static Pose pose_of(const double* turn, const double* shift) {
        Pose pose;
        std::copy(turn, turn + 9, pose.R);
        pose.t = {shift[0], shift[1], shift[2]};
        return pose;
    }

    // A bound above `up_to` need not be the best one.
    double apart(const double* R, std::int32_t one, std::int32_t other, double up_to) const {
        const double *A = R + 9 * one, *B = R + 9 * other;
        double way[3], M[3][3];
        for (int i = 0; i < 3; ++i) way[i] = placed_[3 * other + i] - placed_[3 * one + i];
        const double length =
            std::sqrt(way[0] * way[0] + way[1] * way[1] + way[2] * way[2]);
        double best = length - radii_[one] - radii_[other];
        if (best > up_to) return best;
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
    std::vector<Corners> corners_;
    // Of each pair, the direction that said most of its distance when it was last asked.
    std::vector<Vec> guesses_;
    std::vector<Visit> found_;
};
