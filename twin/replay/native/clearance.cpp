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
}
