// Contact and friction of soft bodies: position based, solved once per substep in a fixed order.
//
// Friction as in Macklin et al. 2014 (unified particle physics), section 6.1: a contact takes back
// the sliding of the substep up to the coefficient times what it pushed out. A node that only just
// touches is pushed back by exactly what the forces on it did, so this is Coulomb's cone.
#include <algorithm>
#include <array>
#include <limits>

#include "collider.hpp"

namespace soft {

namespace {

constexpr double kMargin = 0.002;       // contacts are looked for this far off the surface [m]
// A face that a surface does not look at counts as farther, by this share of a cell per unit of
// cosine. Measured: with 1/16 toys hang on a finger's rim, with 1 the softest slip out of the hand.
constexpr float kFacing = 0.125f;
constexpr float kEasing = 0.1f;         // speed at which bodies that already overlap part [m/s]

bool overlap(const Box& a, const Box& b, double margin) {
    return a.low.x - margin < b.high.x && b.low.x - margin < a.high.x &&
           a.low.y - margin < b.high.y && b.low.y - margin < a.high.y &&
           a.low.z - margin < b.high.z && b.low.z - margin < a.high.z;
}

struct Frame {
    Float3 rows[3];
    Float3 offset;  // of the body's origin in the piece's frame

    Frame(const Rotation& r, const Double3& p, const Double3& origin) {
        const double* m = r.m;
        for (int k = 0; k < 3; ++k) rows[k] = narrow({m[k], m[3 + k], m[6 + k]});
        offset = narrow(r.back(origin - p));
    }
    Float3 inward(const Float3& v) const {
        return Float3{dot(rows[0], v), dot(rows[1], v), dot(rows[2], v)};
    }
    Float3 outward(const Float3& n) const {
        return rows[0] * n.x + rows[1] * n.y + rows[2] * n.z;
    }
};

// How far a contact pushes out: what came in during this substep, and older overlap slowly.
float eased(float depth, float approach, float step_s) {
    return std::min(depth, std::max(approach, 0.0f) + kEasing * step_s);
}

bool inside(const Collider& piece, const Float3& q) {
    for (const Plane& plane : piece.planes)
        if (dot(plane.n, q) > plane.d) return false;
    return !piece.planes.empty();
}

// The face by which a sample came in: one that is near, and that its surface looks at. Nearness
// alone lets what bulges beside a finger come down onto the finger's rim, which then carries it.
std::int32_t entered(const Collider& piece, const Float3& q, const Float3& facing, float spacing) {
    std::int32_t best = 0;
    float least = std::numeric_limits<float>::max();
    for (std::size_t k = 0; k < piece.planes.size(); ++k) {
        const Plane& plane = piece.planes[k];
        const float way = plane.d - dot(plane.n, q) + kFacing * spacing * dot(plane.n, facing);
        if (way < least) {
            least = way;
            best = static_cast<std::int32_t>(k);
        }
    }
    return best;
}

Float3 friction_shift(const Float3& slip, const Float3& n, float reach) {
    const Float3 along = slip - n * dot(slip, n);
    const float length = norm(along);
    if (length <= 1e-12f) return {0, 0, 0};
    return along * -std::min(1.0f, reach / length);
}

}  // namespace

void find_contacts(Body& body, const Collider& collider, int index, double period_s) {
    const double margin = kMargin + 1.5 * period_s * (body.top_speed + collider.top_speed);
    if (!overlap(body.box, collider.box, margin)) return;
    const Frame frame(collider.rotation(), collider.position(), body.origin);
    const float reach = static_cast<float>(margin);
    const int num_samples = static_cast<int>(body.samples.size());
    for (int s = 0; s < num_samples; ++s) {
        const Float3 q = frame.inward(body.sample_at(body.samples[s])) + frame.offset;
        bool near = true;
        for (const Plane& plane : collider.planes)
            if (dot(plane.n, q) - plane.d > reach) {
                near = false;
                break;
            }
        if (!near) continue;
        Contact contact{s, index};
        contact.facing = body.sample_facing(body.samples[s]);
        body.contacts.push_back(contact);
    }
}

void keep_anchors(Body& body) {
    // Both lists are sorted by piece, then by sample.
    std::size_t old = 0;
    const auto before = [](const Contact& a, const Contact& b) {
        return a.collider != b.collider ? a.collider < b.collider : a.sample < b.sample;
    };
    for (Contact& contact : body.contacts) {
        while (old < body.past_contacts.size() && before(body.past_contacts[old], contact)) ++old;
        if (old == body.past_contacts.size()) return;
        if (before(contact, body.past_contacts[old])) continue;
        const Float3 facing = contact.facing;
        contact = body.past_contacts[old];
        contact.facing = facing;
    }
}

void solve_contacts(Body& body, std::vector<Collider>& colliders, float step_s) {
    std::size_t n = 0;
    while (n < body.contacts.size()) {
        const int index = body.contacts[n].collider;
        Collider& piece = colliders[index];
        const Frame frame(piece.rotation(), piece.position(), body.origin);
        const float mu = static_cast<float>(piece.friction * body.friction);
        const float spacing = static_cast<float>(body.spacing);
        Double3 push{0, 0, 0};
        for (; n < body.contacts.size() && body.contacts[n].collider == index; ++n) {
            Contact& contact = body.contacts[n];
            const Sample& sample = body.samples[contact.sample];
            const Float3 p = body.sample_at(sample);
            const Float3 q = frame.inward(p) + frame.offset;
            if (!inside(piece, q)) {
                contact.holds = false;
                continue;
            }
            // Pressed in deeply a sample may come nearer to a side: pushed out there, the body would
            // hook itself onto the piece.
            if (!contact.holds)
                contact.face = entered(piece, q, frame.inward(contact.facing), spacing);
            const Plane* face = &piece.planes[contact.face];
            const float best = dot(face->n, q) - face->d;
            const Float3 normal = frame.outward(face->n);
            const Double3 place = widen(p) + body.origin;
            Float3 slip = p - body.sample_started(sample);
            if (piece.moves) slip = slip - narrow(piece.moved(place));
            const float depth = -best;
            const float pushed = eased(depth, -dot(slip, normal), step_s);
            const float w = body.sample_inverse_mass(sample);
            const Double3 arm = place - piece.position();
            const float other =
                piece.dynamic()
                    ? static_cast<float>(piece.inverse_mass_along(arm, widen(normal)))
                    : 0.0f;
            const float share = w / (w + other);
            // Slip counts from where the contact last held, or what the stress moves between two
            // looks would add up to creep.
            const Float3 since = contact.holds ? frame.outward(q - contact.anchor) : slip;
            const Float3 back = friction_shift(since, normal, mu * pushed);
            const Float3 by = (normal * pushed + back) * share;
            contact.holds = true;
            contact.anchor = q + frame.inward(by);
            body.shift_sample(sample, by, w);
            body.touched[index] = 1;
            body.touches = true;
            if (!piece.moves) body.support = body.support + normal * (pushed / w);
            const Double3 impulse = widen(by) * (-1.0 / (static_cast<double>(w) * step_s));
            piece.take(impulse, arm);
            if (piece.dynamic()) push = push + impulse;
        }
        // A light piece gives way at once, or the next body would find it where it was.
        if (piece.dynamic()) piece.nudge(push * (piece.inverse_mass() * step_s));
    }
}

namespace {

// Nearest point of a triangle, as weights of its corners: Ericson, Real-Time Collision Detection.
std::array<float, 3> nearest_weights(const Float3& p, const Float3& a, const Float3& b,
                                     const Float3& c) {
    const Float3 ab = b - a, ac = c - a, ap = p - a;
    const float d1 = dot(ab, ap), d2 = dot(ac, ap);
    if (d1 <= 0 && d2 <= 0) return {1, 0, 0};
    const Float3 bp = p - b;
    const float d3 = dot(ab, bp), d4 = dot(ac, bp);
    if (d3 >= 0 && d4 <= d3) return {0, 1, 0};
    const float vc = d1 * d4 - d3 * d2;
    if (vc <= 0 && d1 >= 0 && d3 <= 0) return {1 - d1 / (d1 - d3), d1 / (d1 - d3), 0};
    const Float3 cp = p - c;
    const float d5 = dot(ab, cp), d6 = dot(ac, cp);
    if (d6 >= 0 && d5 <= d6) return {0, 0, 1};
    const float vb = d5 * d2 - d1 * d6;
    if (vb <= 0 && d2 >= 0 && d6 <= 0) return {1 - d2 / (d2 - d6), 0, d2 / (d2 - d6)};
    const float va = d3 * d6 - d5 * d4;
    if (va <= 0 && d4 - d3 >= 0 && d5 - d6 >= 0) {
        const float t = (d4 - d3) / ((d4 - d3) + (d5 - d6));
        return {0, 1 - t, t};
    }
    const float sum = va + vb + vc;
    return {va / sum, vb / sum, vc / sum};
}

struct Near {
    std::array<float, 3> weights;
    float distance;   // of the point from the triangle
    float facing;     // cosine between normal and the way to the point
};

Near look_at(const Float3& p, const Float3& a, const Float3& b, const Float3& c) {
    const std::array<float, 3> w = nearest_weights(p, a, b, c);
    const Float3 to = p - (a * w[0] + b * w[1] + c * w[2]);
    const Float3 normal = cross(b - a, c - a);
    const float distance = norm(to), scale = distance * norm(normal);
    return {w, distance, scale > 0 ? dot(to, normal) / scale : 1.0f};
}

}  // namespace

void find_pairs(std::vector<Body>& bodies, int first, int second, double period_s) {
    Body &body = bodies[first], &other = bodies[second];
    const double speed = body.top_speed + other.top_speed;
    const double margin = kMargin + 1.5 * period_s * speed;
    if (!overlap(body.box, other.box, margin)) return;
    const Float3 offset = narrow(body.origin - other.origin);
    const float reach = static_cast<float>(margin), spacing = static_cast<float>(other.spacing);
    const float deep = 0.7f * spacing;
    const Float3 low = narrow(other.box.low - other.origin), high = narrow(other.box.high - other.origin);
    const int num_samples = static_cast<int>(body.samples.size());
    for (int s = 0; s < num_samples; ++s) {
        const Float3 p = body.sample_at(body.samples[s]) + offset;
        if (p.x < low.x - reach || p.x > high.x + reach || p.y < low.y - reach ||
            p.y > high.y + reach || p.z < low.z - reach || p.z > high.z + reach)
            continue;
        Near best{{}, deep + reach, 0.0f};
        int found = -1;
        for (std::size_t t = 0; t < other.triangles.size(); t += 3) {
            const Float3 a = other.at(other.triangles[t]);
            // No point of a triangle is farther from a corner than the longest edge of a cell.
            const Float3 far = p - a;
            const float around = 2.5f * spacing + best.distance;
            if (dot(far, far) > around * around) continue;
            const Near near = look_at(p, a, other.at(other.triangles[t + 1]),
                                      other.at(other.triangles[t + 2]));
            // Where two triangles are equally near, the one that faces the point says which side.
            const bool nearer = near.distance < best.distance - 1e-6f;
            const bool as_near = near.distance < best.distance + 1e-6f;
            if (nearer || (as_near && std::fabs(near.facing) > std::fabs(best.facing))) {
                best = near;
                found = static_cast<int>(t);
            }
        }
        const float limit = best.facing < 0.0f ? deep : reach;
        if (found < 0 || best.distance > limit) continue;
        Pair pair{s, second, {}, {}};
        for (int k = 0; k < 3; ++k) {
            pair.ids[k] = other.triangles[found + k];
            pair.weights[k] = best.weights[k];
        }
        body.pairs.push_back(pair);
    }
}

void solve_pairs(std::vector<Body>& bodies, int index, float step_s) {
    Body& body = bodies[index];
    for (const Pair& pair : body.pairs) {
        Body& other = bodies[pair.other];
        const Sample& sample = body.samples[pair.sample];
        const Float3 offset = narrow(body.origin - other.origin);
        const Float3 a = other.at(pair.ids[0]), b = other.at(pair.ids[1]),
                     c = other.at(pair.ids[2]);
        const Float3 p = body.sample_at(sample) + offset;
        const Float3 there = a * pair.weights[0] + b * pair.weights[1] + c * pair.weights[2];
        Float3 normal = cross(b - a, c - a);
        const float area = norm(normal);
        if (area <= 0.0f) continue;
        normal = normal * (1.0f / area);
        const float depth = dot(there - p, normal);
        if (depth <= 0.0f) continue;
        Float3 was{0, 0, 0};
        float w_other = 0.0f;
        for (int k = 0; k < 3; ++k) {
            was = was + other.started(pair.ids[k]) * pair.weights[k];
            w_other += pair.weights[k] * pair.weights[k] * other.inverse_mass(pair.ids[k]);
        }
        const Float3 slip = (p - there) - (body.sample_started(sample) + offset - was);
        const float pushed = eased(depth, -dot(slip, normal), step_s);
        const float mu = static_cast<float>(body.friction * other.friction);
        const Float3 by = normal * pushed + friction_shift(slip, normal, mu * pushed);
        body.touches = other.touches = true;
        const float w = body.sample_inverse_mass(sample), sum = w + w_other;
        body.shift_sample(sample, by * (w / sum), w);
        for (int k = 0; k < 3; ++k)
            other.shift(pair.ids[k],
                        by * (-pair.weights[k] * other.inverse_mass(pair.ids[k]) / sum));
    }
}

}  // namespace soft
