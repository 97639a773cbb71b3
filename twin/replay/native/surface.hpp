// How near one body's points come to grids and boxes, for thousands of poses of the body: what
// candidate poses are chosen by. Every point is looked at; the same bits on every run.
// tests/parity/test_clearance_parity.py has both formulas in NumPy.
#pragma once

#include "bounds.hpp"
#include "twin/robot/native/grid_search.hpp"

using Values = nb::ndarray<const float, nb::ndim<3>, nb::c_contig, nb::device::cpu>;
using Distances = nb::ndarray<double, nb::ndim<2>, nb::c_contig, nb::device::cpu>;

inline Grid grid_of(const Values& values, const Vector& origin, double voxel) {
    std::int64_t sides[3];
    for (int axis = 0; axis < 3; ++axis) sides[axis] = static_cast<std::int64_t>(values.shape(axis));
    return Grid(values.data(), sides, origin.data(), voxel);
}

// Coordinates of a body's points, each in a row of its own, so that a pose is applied to many.
class Surface {
public:
    explicit Surface(const Points& points)
        : count_(points.shape(0)), own_(3 * count_), placed_(3 * count_) {
        for (std::size_t i = 0; i < count_; ++i)
            for (std::size_t axis = 0; axis < 3; ++axis)
                own_[axis * count_ + i] = points.data()[3 * i + axis];
    }

    std::size_t size() const { return count_; }

    // R p + t of all points; x, y and z one after the other.
    const double* place(const double* R, const double* t) {
        const double *x = own_.data(), *y = x + count_, *z = y + count_;
        for (std::size_t axis = 0; axis < 3; ++axis) {
            const double a = R[3 * axis], b = R[3 * axis + 1], c = R[3 * axis + 2], d = t[axis];
            double* row = placed_.data() + axis * count_;
            for (std::size_t i = 0; i < count_; ++i) row[i] = a * x[i] + b * y[i] + c * z[i] + d;
        }
        return placed_.data();
    }

private:
    std::size_t count_;
    std::vector<double> own_, placed_;
};

inline void surface_to_grid(const Values& values, const Vector& origin, double voxel,
                            const Turns& R, const Points& t, const Points& points,
                            const Answers& answers) {
    const std::size_t count = R.shape(0);
    if (origin.shape(0) != 3 || t.shape(0) != count || answers.shape(0) != count)
        throw std::invalid_argument("poses and answers differ in number");
    const Grid grid = grid_of(values, origin, voxel);
    Surface surface(points);
    const std::size_t size = surface.size();
    for (std::size_t pose = 0; pose < count; ++pose) {
        const double* placed = surface.place(R.data() + 9 * pose, t.data() + 3 * pose);
        double best = std::numeric_limits<double>::infinity();
        for (std::size_t i = 0; i < size; ++i) {
            const double point[3] = {placed[i], placed[size + i], placed[2 * size + i]};
            best = std::min(best, grid.at(point));
        }
        answers.data()[pose] = best;
    }
}

// Signed distance of points to a box whose middle is the origin: outside, the way to its nearest
// point; inside, how deep.
inline double nearest_to_box(const double* placed, std::size_t size, const double* half) {
    double outside = std::numeric_limits<double>::infinity();
    double inside = std::numeric_limits<double>::infinity();
    for (std::size_t i = 0; i < size; ++i) {
        const double x = std::fabs(placed[i]) - half[0];
        const double y = std::fabs(placed[size + i]) - half[1];
        const double z = std::fabs(placed[2 * size + i]) - half[2];
        const double a = x > 0.0 ? x : 0.0, b = y > 0.0 ? y : 0.0, c = z > 0.0 ? z : 0.0;
        const double xy = x > y ? x : y, deepest = xy > z ? xy : z;
        const double apart = a * a + b * b + c * c;
        outside = apart < outside ? apart : outside;
        inside = deepest < inside ? deepest : inside;
    }
    return inside < 0.0 ? inside : std::sqrt(outside);
}

inline void surface_to_boxes(const Turns& turns, const Points& centres, const Points& halves,
                             const Turns& R, const Points& t, const Points& points,
                             const Distances& answers) {
    const std::size_t count = R.shape(0), boxes = turns.shape(0);
    if (answers.shape(0) != count || answers.shape(1) != boxes || t.shape(0) != count ||
        centres.shape(0) != boxes || halves.shape(0) != boxes)
        throw std::invalid_argument("poses, boxes and answers differ in number");
    Surface surface(points);
    for (std::size_t pose = 0; pose < count; ++pose) {
        const double *body = R.data() + 9 * pose, *at = t.data() + 3 * pose;
        for (std::size_t box = 0; box < boxes; ++box) {
            // Pose of the body in the box: B^T R and B^T (t - c).
            const double *B = turns.data() + 9 * box, *c = centres.data() + 3 * box;
            const double way[3] = {at[0] - c[0], at[1] - c[1], at[2] - c[2]};
            double turn[9], shift[3];
            for (std::size_t i = 0; i < 3; ++i) {
                shift[i] = B[i] * way[0] + B[3 + i] * way[1] + B[6 + i] * way[2];
                for (std::size_t j = 0; j < 3; ++j)
                    turn[3 * i + j] =
                        B[i] * body[j] + B[3 + i] * body[3 + j] + B[6 + i] * body[6 + j];
            }
            answers.data()[pose * boxes + box] = nearest_to_box(
                surface.place(turn, shift), surface.size(), halves.data() + 3 * box);
        }
    }
}
