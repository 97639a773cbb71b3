// The Python face of the soft bodies' solver: arrays in, arrays out.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <limits>
#include <memory>
#include <stdexcept>

#include "solver.hpp"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

using Rows = nb::ndarray<const double, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
using Column = nb::ndarray<const double, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Ids = nb::ndarray<const std::int32_t, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
using IdColumn = nb::ndarray<const std::int32_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;

nb::ndarray<nb::numpy, double> table(std::size_t rows, std::size_t columns, double*& data) {
    data = new double[rows * columns]();
    nb::capsule owner(data, [](void* pointer) noexcept { delete[] static_cast<double*>(pointer); });
    return nb::ndarray<nb::numpy, double>(data, {rows, columns}, owner);
}

void need(bool holds, const char* message) {
    if (!holds) throw nb::value_error(message);
}

std::vector<soft::Double3> points(const Rows& rows) {
    need(rows.shape(1) == 3, "rows of three numbers are needed");
    std::vector<soft::Double3> found(rows.shape(0));
    for (std::size_t n = 0; n < found.size(); ++n)
        found[n] = {rows(n, 0), rows(n, 1), rows(n, 2)};
    return found;
}

std::vector<std::int32_t> node_ids(const Ids& ids, std::size_t columns, std::size_t num_nodes) {
    need(ids.shape(1) == columns, "ids have the wrong number of columns");
    std::vector<std::int32_t> found(ids.data(), ids.data() + ids.size());
    for (const std::int32_t id : found)
        need(id >= 0 && static_cast<std::size_t>(id) < num_nodes, "an id names no node");
    return found;
}

soft::Pose pose_from(const double* seven) {
    return {{seven[0], seven[1], seven[2]}, {seven[3], seven[4], seven[5], seven[6]}};
}

class SoftSolver {
  public:
    SoftSolver(double period_s, int num_substeps, double gravity, const char* isa) {
        need(period_s > 0 && num_substeps > 0, "a step needs a length and substeps");
        const soft::Kernels* kernels = soft::kernels_named(isa);
        need(kernels != nullptr, "this processor has no such instruction set: auto, base or v3");
        solver_ = std::make_unique<soft::Solver>(period_s, num_substeps, gravity, kernels);
    }

    int add_body(const Rows& nodes, const Rows& rest, const Ids& tets, const Column& masses,
                 const Ids& samples, const Ids& triangles, double young, double poisson,
                 double damping_s, double damping_rate, double friction, double spacing) {
        soft::BodySpec spec;
        spec.nodes = points(nodes);
        spec.rest = points(rest);
        const std::size_t count = spec.nodes.size();
        need(spec.rest.size() == count && masses.shape(0) == count,
             "nodes, rest and masses differ in length");
        spec.tets = node_ids(tets, 4, count);
        need(!spec.tets.empty(), "a soft body needs a tetrahedron");
        need(spacing > 0, "cells need a size");
        spec.triangles = node_ids(triangles, 3, count);
        const std::vector<std::int32_t> ends = node_ids(samples, 2, count);
        for (std::size_t n = 0; n < ends.size(); n += 2)
            spec.samples.push_back({{ends[n], ends[n + 1]}});
        spec.masses.assign(masses.data(), masses.data() + count);
        for (const double mass : spec.masses) need(mass > 0, "a node has no mass");
        spec.young = young;
        spec.poisson = poisson;
        spec.damping_s = damping_s;
        spec.damping_rate = damping_rate;
        spec.friction = friction;
        spec.spacing = spacing;
        return solver_->add_body(spec);
    }

    int add_collider(const Rows& planes, const Rows& corners, const Column& pose, double friction,
                     double mass, const Column& inertia) {
        need(planes.shape(0) > 3 && planes.shape(1) == 4, "a piece has four planes or more");
        need(pose.shape(0) == 7 && inertia.shape(0) == 3, "a pose has 7 numbers, an inertia 3");
        soft::ColliderSpec spec;
        for (std::size_t n = 0; n < planes.shape(0); ++n)
            spec.planes.push_back(
                {soft::narrow({planes(n, 0), planes(n, 1), planes(n, 2)}),
                 static_cast<float>(planes(n, 3))});
        for (const soft::Double3& corner : points(corners))
            spec.corners.push_back(soft::narrow(corner));
        spec.friction = friction;
        spec.mass = mass;
        spec.inertia = {inertia(0), inertia(1), inertia(2)};
        spec.pose = pose_from(pose.data());
        return solver_->add_collider(spec);
    }

    void place(int collider, const Column& pose) {
        need(pose.shape(0) == 7, "a pose has 7 numbers");
        piece(collider).place(pose_from(pose.data()));
    }

    void step(const IdColumn& driven, const Rows& poses) {
        const std::size_t count = driven.shape(0);
        need(poses.shape(0) == count && (count == 0 || poses.shape(1) == 7),
             "each driven piece needs a pose of 7 numbers");
        std::vector<int> ids(count);
        std::vector<soft::Pose> ends(count);
        for (std::size_t n = 0; n < count; ++n) {
            ids[n] = driven(n);
            piece(ids[n]);
            ends[n] = pose_from(poses.data() + 7 * n);
        }
        nb::gil_scoped_release released;
        solver_->step(ids, ends);
    }

    nb::ndarray<nb::numpy, double> nodes(int index) {
        const soft::Body& one = body(index);
        double* data = nullptr;
        auto rows = table(one.num_nodes, 3, data);
        for (int i = 0; i < one.num_nodes; ++i) {
            data[3 * i] = one.origin.x + one.p[4 * i];
            data[3 * i + 1] = one.origin.y + one.p[4 * i + 1];
            data[3 * i + 2] = one.origin.z + one.p[4 * i + 2];
        }
        if (one.lost)
            std::fill_n(data, 3 * one.num_nodes, std::numeric_limits<double>::quiet_NaN());
        return rows;
    }

    nb::ndarray<nb::numpy, double> velocities(int index) {
        const soft::Body& one = body(index);
        double* data = nullptr;
        auto rows = table(one.num_nodes, 3, data);
        for (int i = 0; i < 3 * one.num_nodes; ++i) data[i] = one.v[4 * (i / 3) + i % 3];
        return rows;
    }

    void set_velocities(int index, const Rows& v) {
        soft::Body& one = body(index);
        const std::vector<soft::Double3> given = points(v);
        need(static_cast<int>(given.size()) == one.num_nodes, "one velocity for each node");
        for (int i = 0; i < one.num_nodes; ++i) {
            const soft::Float3 speed = soft::narrow(given[i]);
            one.v[4 * i] = speed.x;
            one.v[4 * i + 1] = speed.y;
            one.v[4 * i + 2] = speed.z;
        }
    }

    // Momentum and its moment about the frame's origin; changes of speed, of turning, of place.
    nb::ndarray<nb::numpy, double> pushes() {
        double* data = nullptr;
        auto rows = table(solver_->colliders.size(), 15, data);
        for (const soft::Collider& one : solver_->colliders)
            for (const soft::Double3& v : {one.push, one.turn, one.dv, one.domega, one.drift()}) {
                *data++ = v.x;
                *data++ = v.y;
                *data++ = v.z;
            }
        return rows;
    }

    std::vector<int> pushed() {
        std::vector<int> found;
        for (std::size_t k = 0; k < solver_->colliders.size(); ++k) {
            const soft::Double3& push = solver_->colliders[k].push;
            if (push.x != 0.0 || push.y != 0.0 || push.z != 0.0)
                found.push_back(static_cast<int>(k));
        }
        return found;
    }

    std::vector<int> touched(int index) {
        const soft::Body& one = body(index);
        std::vector<int> found;
        for (std::size_t k = 0; k < one.touched.size(); ++k)
            if (one.touched[k]) found.push_back(static_cast<int>(k));
        return found;
    }

    int num_substeps() { return solver_->num_substeps(); }
    bool is_lost(int index) { return body(index).lost; }
    std::vector<std::int32_t> order(int index) { return body(index).order; }

  private:
    std::unique_ptr<soft::Solver> solver_;

    soft::Body& body(int index) {
        need(index >= 0 && index < static_cast<int>(solver_->bodies.size()), "no such body");
        return solver_->bodies[index];
    }
    soft::Collider& piece(int index) {
        need(index >= 0 && index < static_cast<int>(solver_->colliders.size()), "no such piece");
        return solver_->colliders[index];
    }
};

}  // namespace

NB_MODULE(_soft, m) {  // NOLINT(performance-unnecessary-value-param): nanobind's signature
    m.doc() = "Soft bodies; see twin/physics/soft_world.py and the NumPy twin in tests/parity.";
    nb::class_<SoftSolver>(m, "SoftSolver")
        .def(nb::init<double, int, double, const char*>(), "period_s"_a, "num_substeps"_a,
             "gravity"_a, "isa"_a = "auto")
        .def("add_body", &SoftSolver::add_body, "nodes"_a, "rest"_a, "tets"_a, "masses"_a,
             "samples"_a, "triangles"_a, "young"_a, "poisson"_a, "damping_s"_a,
             "damping_rate"_a, "friction"_a,
             "spacing"_a)
        .def("add_collider", &SoftSolver::add_collider, "planes"_a, "corners"_a, "pose"_a,
             "friction"_a, "mass"_a, "inertia"_a)
        .def("place", &SoftSolver::place, "collider"_a, "pose"_a)
        .def("step", &SoftSolver::step, "driven"_a, "poses"_a)
        .def("nodes", &SoftSolver::nodes, "body"_a)
        .def("velocities", &SoftSolver::velocities, "body"_a)
        .def("set_velocities", &SoftSolver::set_velocities, "body"_a, "velocities"_a)
        .def("pushes", &SoftSolver::pushes)
        .def("pushed", &SoftSolver::pushed)
        .def("touched", &SoftSolver::touched, "body"_a)
        .def("num_substeps", &SoftSolver::num_substeps)
        .def("is_lost", &SoftSolver::is_lost, "body"_a)
        .def("order", &SoftSolver::order, "body"_a);
}
