// What Python sees: a world is filled once, then asked; nothing holds the interpreter meanwhile.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/vector.h>

#include <stdexcept>

#include "search.hpp"
#include "timing.hpp"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

using Doubles = nb::ndarray<const double, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Matrix = nb::ndarray<const double, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
using Frames = nb::ndarray<const double, nb::shape<-1, 4, 4>, nb::c_contig, nb::device::cpu>;
using Flags = nb::ndarray<const bool, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Links = nb::ndarray<const std::int32_t, nb::shape<-1, 2>, nb::c_contig, nb::device::cpu>;
using Values = nb::ndarray<const float, nb::ndim<3>, nb::c_contig, nb::device::cpu>;

void require(bool fits, const char* what) {
    if (!fits) throw std::invalid_argument(what);
}

Pose pose_of(const double* rows) {
    Pose pose;
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) pose.R[3 * i + j] = rows[4 * i + j];
    pose.t = {rows[3], rows[7], rows[11]};
    return pose;
}

Pose inverse(const Pose& pose) {
    Pose back;
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) back.R[3 * i + j] = pose.R[3 * j + i];
    back.t = -1.0 * pose.turn_back(pose.t);
    return back;
}

nb::ndarray<nb::numpy, double> array_of(const std::vector<double>& values, std::size_t columns) {
    auto* kept = new std::vector<double>(values);
    nb::capsule owner(kept, [](void* p) noexcept { delete static_cast<std::vector<double>*>(p); });
    if (columns == 0) return {kept->data(), {kept->size()}, owner};
    return {kept->data(), {kept->size() / columns, columns}, owner};
}

// Up to the next multiple of kLanes.
std::size_t filled(std::size_t count) {
    constexpr std::size_t kEach = kLanes;
    return (count + kEach - 1) / kEach * kEach;
}

class Motion {
public:
    Motion(const Frames& placements, const Matrix& axes, const Flags& slides, const Doubles& lower,
           const Doubles& upper, const Doubles& tool) {
        const std::size_t n = placements.shape(0);
        require(axes.shape(0) == n && axes.shape(1) == 3 && slides.shape(0) == n &&
                    lower.shape(0) == n && upper.shape(0) == n && tool.shape(0) == 3,
                "joints differ in number");
        Pose unturned;
        for (std::size_t j = 0; j < n; ++j) {
            const double* a = axes.data() + 3 * j;
            const Pose turned = with_z_along({a[0], a[1], a[2]});
            Joint joint;
            joint.before = unturned * (pose_of(placements.data() + 16 * j) * turned);
            joint.slides = slides.data()[j];
            joint.lower = lower.data()[j];
            joint.upper = upper.data()[j];
            world_.joints.push_back(joint);
            unturned = inverse(turned);
            bases_.push_back(unturned);
        }
        world_.tool = into(static_cast<int>(n), {tool.data()[0], tool.data()[1], tool.data()[2]});
    }

    void add_body(int joint, const Matrix& corners, double cover, std::int32_t root_begin,
                  std::int32_t root_end) {
        require(joint >= 0 && joint <= world_.num_joints(), "a body's joint is not there");
        require(corners.shape(1) == 3 && corners.shape(0) > 0, "corners have three columns");
        Body body;
        body.joint = joint;
        Vec low{1e9, 1e9, 1e9}, high{-1e9, -1e9, -1e9};
        for (std::size_t i = 0; i < corners.shape(0); ++i) {
            const double* row = corners.data() + 3 * i;
            const Vec p = into(joint, {row[0], row[1], row[2]});
            body.corners.push_back(p);
            low = {std::min(low.x, p.x), std::min(low.y, p.y), std::min(low.z, p.z)};
            high = {std::max(high.x, p.x), std::max(high.y, p.y), std::max(high.z, p.z)};
        }
        body.centre = 0.5 * (low + high);
        for (const Vec& p : body.corners) body.radius = std::max(body.radius, norm(p - body.centre));
        for (std::size_t i = 0; i < filled(corners.shape(0)); ++i) {
            const Vec p = body.corners[std::min(i, body.corners.size() - 1)];
            body.corner_x.push_back(static_cast<float>(p.x));
            body.corner_y.push_back(static_cast<float>(p.y));
            body.corner_z.push_back(static_cast<float>(p.z));
        }
        body.cover = cover;
        body.root_begin = root_begin;
        body.root_end = root_end;
        world_.bodies.push_back(std::move(body));
    }

    void set_grid(const Values& values, const Doubles& origin, double voxel, const Matrix& points,
                  const Doubles& radii, const Links& children) {
        require(origin.shape(0) == 3 && points.shape(1) == 3 && radii.shape(0) == points.shape(0) &&
                    children.shape(0) == points.shape(0) && voxel > 0.0,
                "points, radii and children differ in number");
        GridPoints& grid = world_.grid;
        grid.values.assign(values.data(), values.data() + values.size());
        grid.radii.assign(radii.data(), radii.data() + radii.shape(0));
        grid.children.assign(children.data(), children.data() + 2 * children.shape(0));
        grid.points.assign(points.data(), points.data() + 3 * points.shape(0));
        std::int64_t sides[3];
        for (int axis = 0; axis < 3; ++axis) sides[axis] = static_cast<std::int64_t>(values.shape(axis));
        grid.grid = std::make_unique<Grid>(grid.values.data(), sides, origin.data(), voxel);
        // Points are stored in the frame of each body's joint, the axis along z.
        for (const Body& body : world_.bodies)
            if (body.root_end > body.root_begin) turn_points(body);
        grid.search = std::make_unique<Search>(*grid.grid, grid.points.data(), grid.radii.data(),
                                               grid.children.data(),
                                               static_cast<std::int32_t>(grid.radii.size()));
    }

    void add_box(const Matrix& T, const Doubles& half) {
        require(T.shape(0) == 4 && T.shape(1) == 4 && half.shape(0) == 3, "a box needs pose and size");
        Box box;
        box.pose = pose_of(T.data());
        box.half = {half.data()[0], half.data()[1], half.data()[2]};
        world_.boxes.push_back(box);
    }

    void set_table(double height) { world_.table_height = height; }

    void add_pair(std::int32_t body, int kind, std::int32_t other, double limit) {
        const auto bodies = static_cast<std::int32_t>(world_.bodies.size());
        require(body >= 0 && body < bodies && kind >= 0 && kind <= 3, "a pair's body is not there");
        const auto what = static_cast<Other>(kind);
        if (what == Other::kBox)
            require(other >= 0 && other < static_cast<std::int32_t>(world_.boxes.size()), "no such box");
        if (what == Other::kBody) require(other >= 0 && other < bodies, "no such body");
        if (what == Other::kGrid) {
            const Body& own = world_.bodies[static_cast<std::size_t>(body)];
            require(world_.grid.search != nullptr && own.root_end > own.root_begin, "no points for the grid");
        }
        Pair pair;
        pair.body = body;
        pair.kind = what;
        pair.other = other;
        pair.limit = limit;
        world_.pairs.push_back(pair);
    }

    void prepare() { world_.prepare(); }

    void set_limit(std::int32_t pair, double limit) {
        require(pair >= 0 && pair < static_cast<std::int32_t>(world_.pairs.size()), "no such pair");
        world_.pairs[static_cast<std::size_t>(pair)].limit = limit;
    }

    std::int32_t touching(const Doubles& q) {
        check(q);
        const nb::gil_scoped_release alone;
        return world_.touching(q.data());
    }

    std::int32_t blocked(const Matrix& path) {
        require(path.shape(1) == world_.joints.size(), "another number of joints");
        const nb::gil_scoped_release alone;
        for (std::size_t i = 0; i + 1 < path.shape(0); ++i) {
            const double* row = path.data() + i * path.shape(1);
            const std::int32_t pair = world_.blocked(row, row + path.shape(1));
            if (pair >= 0) return static_cast<std::int32_t>(i);
        }
        return -1;
    }

    nb::tuple distance(const Doubles& q, std::int32_t pair) {
        check(q);
        require(pair >= 0 && pair < static_cast<std::int32_t>(world_.pairs.size()), "no such pair");
        world_.place(q.data());
        const Separation found = world_.hulls(pair);
        return nb::make_tuple(found.least, found.most, world_.sphere_bound(pair));
    }

    nb::ndarray<nb::numpy, double> tool(const Doubles& q) {
        check(q);
        const Vec p = world_.tool_at(q.data());
        return array_of({p.x, p.y, p.z}, 0);
    }

    nb::tuple find(const Doubles& start, const Matrix& goals, std::uint64_t seed, double range,
                   std::int64_t nodes, std::int64_t postures, std::int64_t shortcuts) {
        check(start);
        require(goals.shape(1) == world_.joints.size() && goals.shape(0) > 0, "another number of joints");
        Budget budget;
        budget.nodes = nodes;
        budget.postures = postures;
        budget.shortcuts = shortcuts;
        Found found;
        {
            const nb::gil_scoped_release alone;
            found = search(world_, start.data(), goals.data(), static_cast<std::int32_t>(goals.shape(0)),
                           seed, range, budget);
        }
        return nb::make_tuple(static_cast<int>(found.outcome), found.pair,
                              array_of(found.path, world_.joints.size()), world_.postures);
    }

    nb::tuple time(const Matrix& path, const Doubles& speed, const Doubles& acceleration,
                   double tool_speed, double step_s, bool round) {
        const std::size_t n = world_.joints.size();
        require(path.shape(1) == n && speed.shape(0) == n && acceleration.shape(0) == n,
                "another number of joints");
        Limits limits;
        limits.speed.assign(speed.data(), speed.data() + n);
        limits.acceleration.assign(acceleration.data(), acceleration.data() + n);
        limits.tool_speed = tool_speed;
        Timed timed;
        {
            const nb::gil_scoped_release alone;
            const std::vector<double> rows(path.data(), path.data() + path.size());
            timed = time_path(world_, rows, limits, step_s, round);
        }
        return nb::make_tuple(array_of(timed.times, 0), array_of(timed.rows, n),
                              array_of(timed.curve_at, 0), array_of(timed.curve, n));
    }

private:
    Vec into(int joint, Vec p) const {
        return joint == 0 ? p : bases_[static_cast<std::size_t>(joint) - 1].apply(p);
    }

    void check(const Doubles& q) const {
        require(q.shape(0) == world_.joints.size(), "another number of joints");
    }

    // All points below a body's roots, which lie level by level behind them.
    void turn_points(const Body& body) {
        GridPoints& grid = world_.grid;
        std::int32_t begin = body.root_begin, end = body.root_end;
        const auto count = static_cast<std::int32_t>(grid.radii.size());
        while (begin < end) {
            require(begin >= 0 && end <= count, "a child is not there");
            std::int32_t next_begin = count, next_end = 0;
            for (std::int32_t i = begin; i < end; ++i) {
                double* p = grid.points.data() + 3 * static_cast<std::size_t>(i);
                const Vec turned = into(body.joint, {p[0], p[1], p[2]});
                p[0] = turned.x;
                p[1] = turned.y;
                p[2] = turned.z;
                const std::int32_t *child = grid.children.data() + 2 * static_cast<std::size_t>(i);
                if (child[0] < child[1]) {
                    next_begin = std::min(next_begin, child[0]);
                    next_end = std::max(next_end, child[1]);
                }
            }
            begin = next_begin;
            end = next_end;
        }
    }

    World world_;
    std::vector<Pose> bases_;
    // From a joint's own frame into that with its axis along z.
};

}  // namespace

NB_MODULE(_motion, module) {  // NOLINT(performance-unnecessary-value-param): nanobind's
    module.doc() = "Paths of a serial arm: search, shortcuts, times.";
    nb::class_<Motion>(module, "Motion")
        .def(nb::init<const Frames&, const Matrix&, const Flags&, const Doubles&, const Doubles&,
                      const Doubles&>(),
             "placements"_a, "axes"_a, "slides"_a, "lower"_a, "upper"_a, "tool"_a)
        .def("add_body", &Motion::add_body, "joint"_a, "corners"_a, "cover"_a,
             "root_begin"_a, "root_end"_a)
        .def("set_grid", &Motion::set_grid, "values"_a, "origin"_a, "voxel"_a, "points"_a, "radii"_a,
             "children"_a)
        .def("add_box", &Motion::add_box, "T"_a, "half"_a)
        .def("set_table", &Motion::set_table, "height"_a)
        .def("add_pair", &Motion::add_pair, "body"_a, "kind"_a, "other"_a, "limit"_a)
        .def("prepare", &Motion::prepare)
        .def("set_limit", &Motion::set_limit, "pair"_a, "limit"_a)
        .def("touching", &Motion::touching, "q"_a, "The first pair too near at a posture, or -1.")
        .def("blocked", &Motion::blocked, "path"_a, "The first leg of a path that is not free, or -1.")
        .def("distance", &Motion::distance, "q"_a, "pair"_a, "Least, most, and what the spheres around say.")
        .def("tool", &Motion::tool, "q"_a)
        .def("find", &Motion::find, "start"_a, "goals"_a, "seed"_a, "range"_a, "nodes"_a,
             "postures"_a, "shortcuts"_a)
        .def("time", &Motion::time, "path"_a, "speed"_a, "acceleration"_a, "tool_speed"_a,
             "step_s"_a, "round"_a);
}
