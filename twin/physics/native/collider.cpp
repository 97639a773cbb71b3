#include "collider.hpp"

#include <algorithm>
#include <limits>

namespace soft {

Collider::Collider(const ColliderSpec& spec)
    : planes(spec.planes),
      corners(spec.corners),
      friction(spec.friction),
      inverse_mass_(spec.mass > 0.0 ? 1.0 / spec.mass : 0.0),
      inverse_inertia_{1.0 / spec.inertia.x, 1.0 / spec.inertia.y, 1.0 / spec.inertia.z} {
    place(spec.pose);
}

void Collider::place(const Pose& pose) {
    from_ = to_ = pose;
    now_ = before_ = rotation_of(pose.q);
    at_ = was_ = pose.p;
    moves = false;
    top_speed = 0.0;
    update_box();
}

void Collider::drive(const Pose& end, double period_s) {
    from_ = to_;
    to_ = end;
    push = turn = dv = domega = drift_ = {0, 0, 0};
    moves = dynamic() || from_.q != to_.q || norm(to_.p - from_.p) > 0.0;
    top_speed = 0.0;
    if (!moves) return;
    const Rotation a = rotation_of(from_.q), b = rotation_of(to_.q);
    double farthest = 0.0;
    for (const Float3& corner : corners) {
        const Double3 c = widen(corner);
        farthest = std::max(farthest, norm(b.apply(c) + to_.p - a.apply(c) - from_.p));
    }
    top_speed = farthest / period_s;
    now_ = a;
    at_ = from_.p;
    update_box();
}

void Collider::update_box() {
    constexpr double far = std::numeric_limits<double>::max();
    box = {{far, far, far}, {-far, -far, -far}};
    for (const Pose* pose : {&from_, &to_}) {
        const Rotation r = rotation_of(pose->q);
        for (const Float3& corner : corners) {
            const Double3 c = r.apply(widen(corner)) + pose->p;
            box.low = {std::min(box.low.x, c.x), std::min(box.low.y, c.y),
                       std::min(box.low.z, c.z)};
            box.high = {std::max(box.high.x, c.x), std::max(box.high.y, c.y),
                        std::max(box.high.z, c.z)};
        }
    }
}

void Collider::interpolate(double share, float step_s) {
    if (!moves) return;
    before_ = now_;
    was_ = at_;
    const Pose pose = between(from_, to_, share);
    now_ = rotation_of(pose.q);
    drift_ = drift_ + dv * static_cast<double>(step_s);
    at_ = pose.p + drift_;
}

Double3 Collider::moved(const Double3& p) const {
    const Double3 q = now_.back(p - at_);
    return p - (before_.apply(q) + was_);
}

Double3 Collider::accelerated(const Double3& torque) const {
    const Double3 local = now_.back(torque);
    return now_.apply({local.x * inverse_inertia_.x, local.y * inverse_inertia_.y,
                       local.z * inverse_inertia_.z});
}

double Collider::inverse_mass_along(const Double3& arm, const Double3& n) const {
    if (inverse_mass_ == 0.0) return 0.0;
    const Double3 lever = cross(arm, n);
    return inverse_mass_ + dot(lever, accelerated(lever));
}

void Collider::take(const Double3& impulse, const Double3& arm) {
    const Double3 torque = cross(arm, impulse);
    push = push + impulse;
    turn = turn + torque;
    if (inverse_mass_ == 0.0) return;
    dv = dv + impulse * inverse_mass_;
    domega = domega + accelerated(torque);
}

}  // namespace soft
