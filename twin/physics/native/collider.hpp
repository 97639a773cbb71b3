// A convex rigid piece: still, driven along given poses, or pushed about by soft bodies.
#pragma once

#include <vector>

#include "body.hpp"
#include "geometry.hpp"

namespace soft {

struct ColliderSpec {
    std::vector<Plane> planes;            // in the piece's frame, normals of length 1
    std::vector<Float3> corners;          // of the piece, or of a box around it
    double friction;
    double mass = 0.0;                    // 0: nothing that soft bodies do moves it
    Double3 inertia{1, 1, 1};             // about the frame's axes, where the mass is not 0
    Pose pose;
};

class Collider {
  public:
    explicit Collider(const ColliderSpec& spec);

    std::vector<Plane> planes;
    std::vector<Float3> corners;
    double friction;
    bool moves = false;                   // in this step
    double top_speed = 0.0;               // of a corner, in this step
    Box box;                              // around the whole step

    // What soft bodies did to it in this step: momentum about the frame's origin.
    Double3 push{0, 0, 0}, turn{0, 0, 0};
    // What that made of the velocities of a piece with a mass.
    Double3 dv{0, 0, 0}, domega{0, 0, 0};

    void place(const Pose& pose);         // without having moved there
    void drive(const Pose& end, double period_s);
    void interpolate(double share, float step_s);

    const Rotation& rotation() const { return now_; }
    Double3 position() const { return at_; }
    // Where the material point that is at p now was when the substep began, relative to p.
    Double3 moved(const Double3& p) const;
    double inverse_mass_along(const Double3& arm, const Double3& n) const;
    void take(const Double3& impulse, const Double3& arm);
    void nudge(const Double3& by) {
        at_ = at_ + by;
        drift_ = drift_ + by;
    }
    Double3 drift() const { return drift_; }  // what its position changed by in this step
    bool dynamic() const { return inverse_mass_ > 0.0; }
    double inverse_mass() const { return inverse_mass_; }

  private:
    Pose from_, to_;
    Rotation now_, before_;
    Double3 at_, was_;
    Double3 drift_{0, 0, 0};
    double inverse_mass_;
    Double3 inverse_inertia_;

    Double3 accelerated(const Double3& torque) const;
    void update_box();
};

// Lists the samples of a body that may touch the collider during the step.
void find_contacts(Body& body, const Collider& collider, int index, double period_s);

// Lets contacts that were there in the last step hold on where they held.
void keep_anchors(Body& body);

// Pushes samples out and holds them by friction (Coulomb, one coefficient).
void solve_contacts(Body& body, std::vector<Collider>& colliders, float step_s);

// The same among bodies: samples of one against triangles of the other.
void find_pairs(std::vector<Body>& bodies, int first, int second, double period_s);
void solve_pairs(std::vector<Body>& bodies, int index, float step_s);

}  // namespace soft
