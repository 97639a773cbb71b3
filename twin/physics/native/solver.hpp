// All soft bodies of a world and the rigid pieces around them, one fixed step at a time.
#pragma once

#include <vector>

#include "body.hpp"
#include "collider.hpp"

namespace soft {

class Solver {
  public:
    Solver(double period_s, int num_substeps, double gravity, const Kernels* kernels);

    int add_body(const BodySpec& spec);
    int add_collider(const ColliderSpec& spec);
    // Drives pieces to where the rigid world has them at the end of the step; others stay.
    void step(const std::vector<int>& driven, const std::vector<Pose>& poses);

    std::vector<Body> bodies;
    std::vector<Collider> colliders;

    int num_substeps() const { return num_substeps_; }
    double substep_s() const { return period_s_ / num_substeps_; }

  private:
    double period_s_, gravity_;
    int fewest_substeps_, num_substeps_;
    const Kernels* kernels_;

    void find();
};

}  // namespace soft
