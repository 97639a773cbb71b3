// When to be where on a way of straight lines, whose corners are rounded as far as nothing touches.
#pragma once

#include <cstdint>
#include <vector>

#include "world.hpp"

struct Limits {
    std::vector<double> speed, acceleration;
    // Of each joint.
    double tool_speed = 0.0;
    // Of the tool; 0: none.
};

struct Timed {
    std::vector<double> times;
    std::vector<double> rows;
    std::vector<double> curve;
    // The rounded way at its grid points, for whoever times it otherwise.
    std::vector<double> curve_at;
    // Their places along it.
};

// Pass a path (rows of postures) as fast as the limits allow, its corners rounded as far as nothing
// touches, or not at all: the arm then stands still at them.
Timed time_path(World& world, const std::vector<double>& path, const Limits& limits, double step_s,
                bool round);
