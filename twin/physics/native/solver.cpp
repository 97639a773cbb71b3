#include "solver.hpp"

#include <algorithm>

namespace soft {

Solver::Solver(double period_s, int num_substeps, double gravity, const Kernels* kernels)
    : period_s_(period_s), gravity_(gravity), num_substeps_(num_substeps), kernels_(kernels) {}

int Solver::add_body(const BodySpec& spec) {
    bodies.emplace_back(spec, substep_s());
    bodies.back().touched.assign(colliders.size(), 0);
    return static_cast<int>(bodies.size()) - 1;
}

int Solver::add_collider(const ColliderSpec& spec) {
    colliders.emplace_back(spec);
    for (Body& body : bodies) body.touched.push_back(0);
    return static_cast<int>(colliders.size()) - 1;
}

void Solver::find() {
    for (Body& body : bodies) {
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
        for (Body& body : bodies) {
            if (body.lost) continue;
            body.predict(gravity_, step_s, *kernels_);
            body.relax(*kernels_);
        }
        for (std::size_t i = 0; i < bodies.size(); ++i)
            solve_pairs(bodies, static_cast<int>(i), step_s);
        for (Body& body : bodies) {
            if (body.lost) continue;
            solve_contacts(body, colliders, step_s);
            body.finish(step_s);
        }
    }
    for (Body& body : bodies)
        if (!body.lost) body.damp(period_s_);
}

}  // namespace soft
