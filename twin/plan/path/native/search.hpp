// From one posture to another around what is in the way, and the same way made shorter.
#pragma once

#include <cstdint>
#include <vector>

#include "world.hpp"

struct Budget {
    std::int64_t nodes = 0;
    // Postures in both trees at most.
    std::int64_t postures = 0;
    // Postures looked at at most, over search and shortcuts.
    std::int64_t shortcuts = 0;
    // Shorter ways that are tried.
};

enum class Outcome : std::int32_t {
    kFound = 0,
    kStartTouches = 1,
    kGoalTouches = 2,
    kBudget = 3,
    kOutsideLimits = 4,
};

struct Found {
    Outcome outcome = Outcome::kBudget;
    std::int32_t pair = -1;
    // Which one touches, at start or goal.
    std::vector<double> path;
    // Postures one after the other.
};

// RRT-Connect (Kuffner, LaValle 2000) from a start to any of some goals, then shortcuts.
Found search(World& world, const double* start, const double* goals, std::int32_t num_goals,
             std::uint64_t seed, double range, const Budget& budget);
