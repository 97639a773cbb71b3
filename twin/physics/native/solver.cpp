#include "solver.hpp"

#include <algorithm>
#include <cmath>

namespace soft {

namespace {

constexpr int kMostRefined = 4;  // times the substeps asked for, for the stiffest and lightest
// Smaller cells [m] get more substeps in proportion, or what closes on a body presses them flat
// between two looks: at 9 mm 20 N crushed a sloth in 11 substeps, and not in 15 (measured).
constexpr double kUsualSpacing = 0.014;

}  // namespace

Solver::Solver(double period_s, int num_substeps, double gravity, const Kernels* kernels)
    : period_s_(period_s),
      gravity_(gravity),
      fewest_substeps_(num_substeps),
      num_substeps_(num_substeps),
      kernels_(kernels) {}

int Solver::add_body(const BodySpec& spec) {
    bodies.emplace_back(spec);
    Body& added = bodies.back();
    added.touched.assign(colliders.size(), 0);
    const double longest = added.longest_substep(substep_s());
    const int needed = static_cast<int>(std::ceil(period_s_ / longest - 1e-9));
    const double finer = kUsualSpacing / added.spacing;
    const int pressed = static_cast<int>(std::ceil(fewest_substeps_ * finer - 1e-9));
    const int most = kMostRefined * fewest_substeps_;
    num_substeps_ = std::min(std::max({num_substeps_, needed, pressed}), most);
    for (Body& body : bodies) body.build_blocks(substep_s());
    return static_cast<int>(bodies.size()) - 1;
}

int Solver::add_collider(const ColliderSpec& spec) {
    colliders.emplace_back(spec);
    for (Body& body : bodies) body.touched.push_back(0);
    return static_cast<int>(colliders.size()) - 1;
}

void Solver::find() {
    for (Body& body : bodies) {
        body.past_contacts.swap(body.contacts);
        body.contacts.clear();
        body.pairs.clear();
        std::fill(body.touched.begin(), body.touched.end(), 0);
        body.look_around();
    }
    const int num_bodies = static_cast<int>(bodies.size());
    for (int i = 0; i < num_bodies; ++i) {
        if (bodies[i].lost) continue;
        for (std::size_t k = 0; k < colliders.size(); ++k)
            find_contacts(bodies[i], colliders[k], static_cast<int>(k), period_s_);
        keep_anchors(bodies[i]);
        for (int j = 0; j < num_bodies; ++j)
            if (j != i && !bodies[j].lost) find_pairs(bodies, i, j, period_s_);
    }
}

void Solver::step(const std::vector<int>& driven, const std::vector<Pose>& poses) {
    for (std::size_t n = 0; n < driven.size(); ++n)
        colliders[driven[n]].drive(poses[n], period_s_);
    find();
    const float step_s = static_cast<float>(substep_s());
    for (int substep = 1; substep <= num_substeps_; ++substep) {
        const double share = static_cast<double>(substep) / num_substeps_;
        for (Collider& collider : colliders) collider.interpolate(share, step_s);
        for (Body& body : bodies)
            if (!body.lost) body.predict(gravity_, step_s, *kernels_);
        // Before the stress is looked at: where forces balance contact then leaves nothing to do,
        // and the material sees the body as it is and not as it would be inside of its support.
        for (std::size_t i = 0; i < bodies.size(); ++i)
            solve_pairs(bodies, static_cast<int>(i), step_s);
        for (Body& body : bodies) {
            if (body.lost) continue;
            solve_contacts(body, colliders, step_s);
            body.relax(*kernels_);
            body.finish(step_s);
            body.damp(step_s);
        }
    }
}

}  // namespace soft
