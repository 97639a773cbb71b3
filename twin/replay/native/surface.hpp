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
        for (std::size_t axis = 0; axis < 3 && count_ > 0; ++axis) {
            const double* row = own_.data() + axis * count_;
            const auto ends = std::minmax_element(row, row + count_);
            centre_[axis] = (*ends.first + *ends.second) / 2.0;
        }
        for (std::size_t i = 0; i < count_; ++i) {
            double square = 0.0;
            for (std::size_t axis = 0; axis < 3; ++axis) {
                const double away = own_[axis * count_ + i] - centre_[axis];
                square += away * away;
            }
            radius_ = std::max(radius_, std::sqrt(square));
        }
    }

    // What no placed point is nearer than to a box whose middle is the origin.
    double bound(const double* R, const double* t, const double* half) const {
        double square = 0.0;
        for (std::size_t axis = 0; axis < 3; ++axis) {
            const double at = R[3 * axis] * centre_[0] + R[3 * axis + 1] * centre_[1] +
                              R[3 * axis + 2] * centre_[2] + t[axis];
            const double away = std::max(std::fabs(at) - half[axis], 0.0);
            square += away * away;
        }
        return std::sqrt(square) - radius_;
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
    double centre_[3] = {0.0, 0.0, 0.0}, radius_ = 0.0;
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

// Of each point on its own: how much farther it is than it must be kept. Answers only go down, so
// that one list can be handed from obstacle to obstacle.
inline void points_to_grid(const Values& values, const Vector& origin, double voxel, double keep,
                           const Turns& R, const Points& t, const Points& points,
                           const Distances& answers) {
    const std::size_t count = R.shape(0), size = points.shape(0);
    if (origin.shape(0) != 3 || t.shape(0) != count || answers.shape(0) != count ||
        answers.shape(1) != size)
        throw std::invalid_argument("poses, points and answers differ in number");
    const Grid grid = grid_of(values, origin, voxel);
    Surface surface(points);
    for (std::size_t pose = 0; pose < count; ++pose) {
        const double* placed = surface.place(R.data() + 9 * pose, t.data() + 3 * pose);
        double* row = answers.data() + pose * size;
        for (std::size_t i = 0; i < size; ++i) {
            const double point[3] = {placed[i], placed[size + i], placed[2 * size + i]};
            row[i] = std::min(row[i], grid.at(point) - keep);
        }
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

inline void each_to_box(const double* placed, std::size_t size, const double* half, double keep,
                        double* row) {
    for (std::size_t i = 0; i < size; ++i) {
        const double x = std::fabs(placed[i]) - half[0];
        const double y = std::fabs(placed[size + i]) - half[1];
        const double z = std::fabs(placed[2 * size + i]) - half[2];
        const double a = x > 0.0 ? x : 0.0, b = y > 0.0 ? y : 0.0, c = z > 0.0 ? z : 0.0;
        const double xy = x > y ? x : y, deepest = xy > z ? xy : z;
        const double apart = std::sqrt(a * a + b * b + c * c) + (deepest < 0.0 ? deepest : 0.0);
        row[i] = apart - keep < row[i] ? apart - keep : row[i];
    }
}

// Goes through all boxes for all poses of a body, with the pose of the body in the box's frame.
template <typename Look>
void for_each_box(const Turns& turns, const Points& centres, const Points& halves, const Turns& R,
                  const Points& t, const Points& points, const Look& look) {
    const std::size_t count = R.shape(0), boxes = turns.shape(0);
    if (t.shape(0) != count || centres.shape(0) != boxes || halves.shape(0) != boxes)
        throw std::invalid_argument("poses or boxes differ in number");
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
            look(pose, box, surface, turn, shift);
        }
    }
}

inline void surface_to_boxes(const Turns& turns, const Points& centres, const Points& halves,
                             const Turns& R, const Points& t, const Points& points,
                             const Distances& answers) {
    const std::size_t boxes = turns.shape(0);
    if (answers.shape(0) != R.shape(0) || answers.shape(1) != boxes)
        throw std::invalid_argument("poses, boxes and answers differ in number");
    for_each_box(turns, centres, halves, R, t, points,
                 [&](std::size_t pose, std::size_t box, Surface& surface, const double* turn,
                     const double* shift) {
                     answers.data()[pose * boxes + box] = nearest_to_box(
                         surface.place(turn, shift), surface.size(), halves.data() + 3 * box);
                 });
}

// Boxes that are farther than most from all points are not looked at: answers are at most that.
inline void points_to_boxes(const Turns& turns, const Points& centres, const Points& halves,
                            const Vector& keep, double most, const Turns& R, const Points& t,
                            const Points& points, const Distances& answers) {
    const std::size_t num = points.shape(0);
    if (answers.shape(0) != R.shape(0) || answers.shape(1) != num ||
        keep.shape(0) != turns.shape(0))
        throw std::invalid_argument("poses, points, boxes and answers differ in number");
    for_each_box(turns, centres, halves, R, t, points,
                 [&](std::size_t pose, std::size_t box, Surface& surface, const double* turn,
                     const double* shift) {
                     const double *half = halves.data() + 3 * box, kept = keep.data()[box];
                     if (surface.bound(turn, shift, half) - kept >= most) return;
                     each_to_box(surface.place(turn, shift), num, half, kept,
                                 answers.data() + pose * num);
                 });
}
