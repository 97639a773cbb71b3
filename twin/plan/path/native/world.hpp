// A serial arm among obstacles: where its bodies are, what they keep from what, and whether a
// straight way between two postures is free all along.
//
// Each body is a convex hull. The sphere around it is asked first; where that is not enough, the hull
// is. A way is divided until everything that moves is farther from everything else than it can come
// within its part, so nothing is missed between two postures.
#pragma once

#include <cstdint>
#include <limits>
#include <memory>
#include <vector>

#include "twin/robot/native/geometry.hpp"
#include "twin/robot/native/grid_search.hpp"
#include "twin/robot/native/separation.hpp"

constexpr int kLanes = 16;
// So many corners are looked at together.

struct Joint {
    Pose before;
    // Frame of the joint in that of the one before, its axis along z.
    bool slides = false;
    double lower = 0.0, upper = 0.0;
};

struct Body {
    int joint = 0;
    // How many joints move it.
    std::vector<Vec> corners;
    // Of its hull, frame of its joint.
    std::vector<float> corner_x, corner_y, corner_z;
    // The same, filled up to a multiple of kLanes by repeating the last one.
    Vec centre;
    double radius = 0.0;
    // One sphere around all of it.
    std::vector<double> reach;
    // How far each joint moves any of its points at most, wherever the others stand [m/rad].
    std::int32_t root_begin = 0, root_end = 0;
    // Its points among those that grids are asked about; none: it is not asked.
    double cover = 0.0;
};

struct Box {
    Pose pose;
    Vec half;
};

enum class Other : std::int32_t { kBox = 0, kTable = 1, kGrid = 2, kBody = 3 };

struct Pair {
    std::int32_t body = 0;
    Other kind = Other::kBox;
    std::int32_t other = 0;
    double limit = 0.0;
    // They keep more than this [m].
    std::int32_t moving = 0, fixed_joint = 0;
    // The body that moves against the other, and the last joint that moves both.
};

struct GridPoints {
    std::vector<float> values;
    std::vector<double> points, radii;
    std::vector<std::int32_t> children;
    std::unique_ptr<Grid> grid;
    std::unique_ptr<Search> search;
};

class World {
public:
    std::vector<Joint> joints;
    std::vector<Body> bodies;
    std::vector<Box> boxes;
    double table_height = 0.0;
    GridPoints grid;
    std::vector<Pair> pairs;
    Vec tool;
    // In the frame of the last joint.
    std::int64_t postures = 0;
    // Looked at since it was last set.

    int num_joints() const { return static_cast<int>(joints.size()); }

    // After everything is filled in: how far joints move bodies.
    void prepare();

    // Leave behind what earlier questions taught: the same question then gets the same answer.
    void forget();

    // Frames of all joints; the base's is the first.
    void place(const double* q);
    Vec centre(std::int32_t body);
    Vec tool_at(const double* q);

    // The first pair that is too near at a posture, or -1.
    std::int32_t touching(const double* q);

    // The first pair found that comes too near on the straight way, or -1 when all is free.
    std::int32_t blocked(const double* from, const double* to);

    // A distance that a pair keeps at the placed posture, and an upper one; as exact as asked.
    Separation distance(std::int32_t pair, double enough, double too_little);

    // A distance that the spheres around both of a pair say it keeps.
    double sphere_bound(std::int32_t pair);

    // As exact as the hulls are.
    Separation hulls(std::int32_t pair) {
        constexpr double kAll = std::numeric_limits<double>::infinity();
        return exact(pair, kAll, -kAll);
    }

private:
    struct Part {
        double begin, end;
        std::size_t first, last;
        // Its pairs in open_.
    };

    Separation exact(std::int32_t index, double enough, double too_little);
    Vec support(const Body& body, const Pose& pose, Vec direction) const;
    double body_reach(const Body& body, int joint) const;
    void place_travel(std::int32_t body, const double* turned);

    std::vector<Pose> frames_;
    std::vector<std::int64_t> centred_at_, travelled_at_;
    std::vector<Vec> centres_;
    std::vector<std::vector<double>> travels_;
    // Of each body, against the frame of each joint before it.
    std::int64_t stamp_ = 0;
    std::vector<Vec> guesses_;
    std::vector<std::int32_t> open_;
    std::vector<Part> parts_;
    std::vector<std::int32_t> order_;
    // Pairs, those first that blocked a way last.
    std::vector<double> turned_, half_turns_, middle_;
};
