// Distances of surfaces to a grid of distances, and which pairs of bodies may be near.
#include "bounds.hpp"
#include "surface.hpp"

namespace {

void nearest(const Values& values, const Vector& origin, double voxel, const Turns& R,
             const Points& t, const Points& points, const Vector& radius, const Ranges& children,
             const Ranges& roots, const Answers& answers) {
    const std::size_t num_bodies = roots.shape(0);
    if (origin.shape(0) != 3 || R.shape(0) != num_bodies || t.shape(0) != num_bodies ||
        answers.shape(0) != num_bodies)
        throw std::invalid_argument("poses, bodies and answers differ in number");
    if (radius.shape(0) != points.shape(0) || children.shape(0) != points.shape(0))
        throw std::invalid_argument("points, radii and children differ in number");
    const Grid grid = grid_of(values, origin, voxel);
    Search search(grid, points.data(), radius.data(), children.data(),
                  static_cast<std::int32_t>(points.shape(0)));
    for (std::size_t body = 0; body < num_bodies; ++body)
        answers.data()[body] = search.nearest(R.data() + 9 * body, t.data() + 3 * body,
                                              roots.data()[2 * body], roots.data()[2 * body + 1]);
}

// The smallest of the answers of `nearest` less each body's cover, or `below` where none is smaller.
// The same bits as from all answers, though most bodies are hardly looked at.
double least(const Values& values, const Vector& origin, double voxel, const Turns& R,
             const Points& t, const Points& points, const Vector& radius, const Ranges& children,
             const Ranges& roots, const Vector& cover, const Points& centres, const Vector& reaches,
             double below) {
    const std::size_t num_bodies = roots.shape(0);
    if (origin.shape(0) != 3 || R.shape(0) != num_bodies || t.shape(0) != num_bodies ||
        cover.shape(0) != num_bodies || centres.shape(0) != num_bodies ||
        reaches.shape(0) != num_bodies)
        throw std::invalid_argument("poses, bodies and covers differ in number");
    if (radius.shape(0) != points.shape(0) || children.shape(0) != points.shape(0))
        throw std::invalid_argument("points, radii and children differ in number");
    const Grid grid = grid_of(values, origin, voxel);
    Search search(grid, points.data(), radius.data(), children.data(),
                  static_cast<std::int32_t>(points.shape(0)));
    constexpr double kLeast = (1.0 - kShare) * (1.0 - kShare);
    // All points of a body lie within one sphere: what is found about its middle bounds them.
    std::vector<Visit> order;
    for (std::size_t body = 0; body < num_bodies; ++body) {
        const double *turn = R.data() + 9 * body, *c = centres.data() + 3 * body;
        double middle[3];
        for (int i = 0; i < 3; ++i)
            middle[i] = turn[3 * i] * c[0] + turn[3 * i + 1] * c[1] + turn[3 * i + 2] * c[2] +
                        t.data()[3 * body + static_cast<std::size_t>(i)];
        order.push_back({grid.at(middle) - reaches.data()[body], static_cast<std::int32_t>(body)});
    }
    std::sort(order.begin(), order.end(), [](const Visit& a, const Visit& b) {
        return a.distance != b.distance ? a.distance < b.distance : a.index < b.index;
    });
    bool first = true;
    constexpr double kNear = 0.02;
    for (const Visit& next : order) {
        const auto body = static_cast<std::size_t>(next.index);
        const double *turn = R.data() + 9 * body, *shift = t.data() + 3 * body;
        const std::int32_t begin = roots.data()[2 * body], end = roots.data()[2 * body + 1];
        // An answer is less than what was found by at most a share: twice that is left open.
        const double limit = below + cover.data()[body];
        const double stop = limit > 0.0 ? limit / kLeast : limit;
        if (next.distance > stop) continue;
        // The most promising one is the answer most often, and asked for it at once; not where only
        // what nearly touches is asked for.
        const bool at_once = first && stop > kNear;
        if (!at_once && search.nearest(turn, shift, begin, end, stop) > stop) continue;
        first = false;
        below = std::min(below, search.nearest(turn, shift, begin, end) - cover.data()[body]);
    }
    return below;
}

}  // namespace

NB_MODULE(_clearance, module) {
    module.doc() = "Distances of surfaces to a grid, and which pairs of bodies may be near.";
    nb::class_<Bounds>(module, "Bounds")
        .def(nb::init<const Points&, const Points&, const Vector&, const Points&, const Ranges&,
                      const Ranges&>(),
             "centres"_a, "halves"_a, "radii"_a, "corners"_a, "ranges"_a, "pairs"_a,
             "Bodies by their boxes, spheres about their centres and corners; the pairs of them.")
        .def("nearest_first", &Bounds::nearest_first, "R"_a, "t"_a, "bounds"_a.noconvert(),
             "order"_a.noconvert(), "up_to"_a,
             "Lower bounds of the pairs' distances that are not above a number, and their order.");
    module.def("nearest", &nearest, "values"_a, "origin"_a, "voxel"_a, "R"_a, "t"_a, "points"_a,
               "radius"_a, "children"_a, "roots"_a, "answers"_a.noconvert(),
               "Smallest distance of each placed body's points, into answers.");
    module.def("surface_to_grid", &surface_to_grid, "values"_a, "origin"_a, "voxel"_a, "R"_a, "t"_a,
               "points"_a, "answers"_a.noconvert(),
               "Smallest distance of one body's points to a grid, for every pose of the body.");
    module.def("surface_to_boxes", &surface_to_boxes, "turns"_a, "centres"_a, "halves"_a, "R"_a,
               "t"_a, "points"_a, "answers"_a.noconvert(),
               "Smallest distance of one body's points to each box, for every pose of the body.");
    module.def("least", &least, "values"_a, "origin"_a, "voxel"_a, "R"_a, "t"_a, "points"_a,
               "radius"_a, "children"_a, "roots"_a, "cover"_a, "centres"_a,
               "reaches"_a, "below"_a,
               "The smallest of them less the covers, if it is below a number.");
}
