// How near the surfaces of placed bodies come to the zero level of a grid of distances.
//
// A surface is a tree of points: each has a radius within which everything below it lies, so a
// point at distance d cannot lead to less than d - radius, and most of the tree is never looked at
// (branch and bound; the children of the nearest point first). Plain double arithmetic in a fixed
// order: the same bits on every run. tests/parity/test_clearance_parity.py looks at every point.
#include "bounds.hpp"
#include "grid.hpp"
#include "surface.hpp"

namespace {

constexpr double kShare = 0.02;

class Search {
public:
    Search(const Grid& grid, const Points& points, const Vector& radius, const Ranges& children)
        : grid_(grid), points_(points.data()), radius_(radius.data()),
          children_(children.data()), count_(static_cast<std::int32_t>(points.shape(0))) {
        if (radius.shape(0) != points.shape(0) || children.shape(0) != points.shape(0))
            throw std::invalid_argument("points, radii and children differ in number");
    }

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
        const std::size_t first = open_.size();
        for (std::int32_t index = begin; index < end; ++index) {
            const double* p = points_ + 3 * static_cast<std::int64_t>(index);
            const double placed[3] = {
                R[0] * p[0] + R[1] * p[1] + R[2] * p[2] + t[0],
                R[3] * p[0] + R[4] * p[1] + R[5] * p[2] + t[1],
                R[6] * p[0] + R[7] * p[1] + R[8] * p[2] + t[2],
            };
            const double distance = grid_.at(placed);
            best_ = std::min(best_, distance);
            if (children_[2 * index] < children_[2 * index + 1])
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
};

void nearest(const Values& values, const Vector& origin, double voxel, const Turns& R,
             const Points& t, const Points& points, const Vector& radius, const Ranges& children,
             const Ranges& roots, const Answers& answers) {
    const std::size_t count = roots.shape(0);
    if (origin.shape(0) != 3 || R.shape(0) != count || t.shape(0) != count ||
        answers.shape(0) != count)
        throw std::invalid_argument("poses, bodies and answers differ in number");
    const Grid grid(values, origin, voxel);
    Search search(grid, points, radius, children);
    for (std::size_t body = 0; body < count; ++body)
        answers.data()[body] = search.nearest(R.data() + 9 * body, t.data() + 3 * body,
                                              roots.data()[2 * body], roots.data()[2 * body + 1]);
}

}  // namespace

NB_MODULE(_clearance, module) {
    module.doc() = "Distances of surfaces to a grid, and which pairs of bodies may be near.";
    nb::class_<Bounds>(module, "Bounds")
        .def(nb::init<const Points&, const Points&, const Vector&, const Ranges&>(), "centres"_a,
             "halves"_a, "radii"_a, "pairs"_a,
             "Bodies by their boxes and spheres about their centres, and the pairs of them.")
        .def("nearest_first", &Bounds::nearest_first, "R"_a, "t"_a, "bounds"_a.noconvert(),
             "order"_a.noconvert(), "Lower bounds of the pairs' distances, and their order.");
    module.def("nearest", &nearest, "values"_a, "origin"_a, "voxel"_a, "R"_a, "t"_a, "points"_a,
               "radius"_a, "children"_a, "roots"_a, "answers"_a.noconvert(),
               "Smallest distance of each placed body's points, into answers.");
    module.def("surface_to_grid", &surface_to_grid, "values"_a, "origin"_a, "voxel"_a, "R"_a, "t"_a,
               "points"_a, "answers"_a.noconvert(),
               "Smallest distance of one body's points to a grid, for every pose of the body.");
    module.def("surface_to_boxes", &surface_to_boxes, "turns"_a, "centres"_a, "halves"_a, "R"_a,
               "t"_a, "points"_a, "answers"_a.noconvert(),
               "Smallest distance of one body's points to each box, for every pose of the body.");
    module.def("points_to_grid", &points_to_grid, "values"_a, "origin"_a, "voxel"_a, "keep"_a,
               "R"_a, "t"_a, "points"_a, "answers"_a.noconvert(),
               "Lower answers to each point's distance to a grid less what is to be kept.");
    module.def("points_to_boxes", &points_to_boxes, "turns"_a, "centres"_a, "halves"_a, "keep"_a,
               "most"_a, "R"_a, "t"_a, "points"_a, "answers"_a.noconvert(),
               "Lower answers, none above most, to each point's distance to the boxes less keep.");
}
