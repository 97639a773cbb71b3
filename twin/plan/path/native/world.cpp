#include "world.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

namespace {

constexpr double kInfinity = std::numeric_limits<double>::infinity();
// Parts of a way in which a pair moves less than this are not divided further: a pair that is
// nearer to its limit than half of it counts as too near.
constexpr double kFine = 0.0005;
// Most that an interpolated distance changes per way (bounding_spheres.py has the same number).
constexpr double kSlope = 1.15;
// What floats may add to a distance [m]; and to the support of a hull.
constexpr double kRounding = 2e-6;

double distance_to_box(Vec local, Vec half) {
    const double x = std::fabs(local.x) - half.x, y = std::fabs(local.y) - half.y,
                 z = std::fabs(local.z) - half.z;
    const double largest = std::max(x, std::max(y, z));
    if (largest <= 0.0) return largest;
    const double ox = std::max(x, 0.0), oy = std::max(y, 0.0), oz = std::max(z, 0.0);
    return std::sqrt(ox * ox + oy * oy + oz * oz);
}

// The loop that takes most of the time, also for what newer processors can do.
#if defined(__x86_64__) && defined(__linux__)
#define EACH_PROCESSOR __attribute__((target_clones("avx512f", "avx2", "default")))
#else
#define EACH_PROCESSOR
#endif

// Which corner of a body lies farthest along a direction.
EACH_PROCESSOR int farthest(const Body& body, const float* d) {
    const float *x = body.corner_x.data(), *y = body.corner_y.data(), *z = body.corner_z.data();
    float best[kLanes];
    int block[kLanes];
    for (int lane = 0; lane < kLanes; ++lane) {
        best[lane] = d[0] * x[lane] + d[1] * y[lane] + d[2] * z[lane];
        block[lane] = 0;
    }
    const int count = static_cast<int>(body.corner_x.size());
    for (int begin = kLanes; begin < count; begin += kLanes) {
#pragma omp simd
        for (int lane = 0; lane < kLanes; ++lane) {
            const int i = begin + lane;
            const float along = d[0] * x[i] + d[1] * y[i] + d[2] * z[i];
            const bool more = along > best[lane];
            best[lane] = more ? along : best[lane];
            block[lane] = more ? begin : block[lane];
        }
    }
    int lane = 0;
    for (int other = 1; other < kLanes; ++other)
        if (best[other] > best[lane]) lane = other;
    return block[lane] + lane;
}

}  // namespace

// How far a joint moves any point of a body at most, per radian or metre, wherever the joints
// between stand: lengths add up, only what the joint itself carries has a known distance to its
// axis.
double World::body_reach(const Body& body, int joint) const {
    if (joint > body.joint) return 0.0;
    if (joints[static_cast<std::size_t>(joint) - 1].slides) return 1.0;
    double reach = 0.0;
    for (const Vec& p : body.corners)
        reach = std::max(reach, body.joint == joint ? std::hypot(p.x, p.y) : norm(p));
    for (int k = body.joint; k > joint; --k) {
        const Joint& link = joints[static_cast<std::size_t>(k) - 1];
        const Vec t = link.before.t;
        reach += k - 1 == joint ? std::hypot(t.x, t.y) : norm(t);
        if (link.slides) reach += std::max(std::fabs(link.lower), std::fabs(link.upper));
    }
    return reach;
}

void World::prepare() {
    frames_.assign(joints.size() + 1, Pose{});
    centred_at_.assign(bodies.size(), -1);
    travelled_at_ = centred_at_;
    centres_.assign(bodies.size(), {});
    travels_.assign(bodies.size(), std::vector<double>(joints.size() + 1, 0.0));
    for (std::size_t body = 0; body < bodies.size(); ++body) {
        bodies[body].reach.assign(joints.size(), 0.0);
        for (int joint = 1; joint <= num_joints(); ++joint)
            bodies[body].reach[static_cast<std::size_t>(joint) - 1] = body_reach(bodies[body], joint);
    }
    for (Pair& pair : pairs) {
        pair.moving = pair.body;
        pair.fixed_joint = 0;
        if (pair.kind != Other::kBody) continue;
        const int one = bodies[static_cast<std::size_t>(pair.body)].joint;
        const int other = bodies[static_cast<std::size_t>(pair.other)].joint;
        if (other > one) pair.moving = pair.other;
        pair.fixed_joint = std::min(one, other);
    }
    forget();
    turned_.resize(joints.size());
    middle_.resize(joints.size());
}

void World::forget() {
    guesses_.assign(pairs.size(), {});
    order_.resize(pairs.size());
    for (std::size_t i = 0; i < pairs.size(); ++i)
        order_[i] = static_cast<std::int32_t>(pairs.size() - 1 - i);
}

// How far a body moves at most against the frame of each joint before it, while every joint turns
// by no more than given, both ways. From the hand to the base: at the placed posture the distance
// to an axis is known, and changes by what the joints behind it do.
void World::place_travel(std::int32_t index, const double* turned) {
    const auto at = static_cast<std::size_t>(index);
    if (travelled_at_[at] == stamp_) return;
    travelled_at_[at] = stamp_;
    const Body& body = bodies[at];
    std::vector<double>& travel = travels_[at];
    const Vec middle = centre(index);
    double sum = 0.0;
    travel[static_cast<std::size_t>(body.joint)] = 0.0;
    for (int k = body.joint; k > 0; --k) {
        const auto joint = static_cast<std::size_t>(k);
        double reach = body.reach[joint - 1];
        if (!joints[joint - 1].slides && turned[joint - 1] > 0.0) {
            const Pose& frame = frames_[joint];
            const Vec way = middle - frame.t;
            const double along = dot(way, {frame.R[2], frame.R[5], frame.R[8]});
            const double aside = std::sqrt(std::max(0.0, dot(way, way) - along * along));
            reach = std::min(reach, aside + body.radius + sum);
        }
        sum += reach * turned[joint - 1];
        travel[joint - 1] = sum;
    }
}

void World::place(const double* q) {
    ++postures;
    ++stamp_;
    for (std::size_t j = 0; j < joints.size(); ++j) {
        Pose& here = frames_[j + 1];
        here = frames_[j] * joints[j].before;
        if (joints[j].slides) {
            here.t = here.t + q[j] * Vec{here.R[2], here.R[5], here.R[8]};
            continue;
        }
        const double c = std::cos(q[j]), s = std::sin(q[j]);
        for (int row = 0; row < 9; row += 3) {
            const double x = here.R[row], y = here.R[row + 1];
            here.R[row] = c * x + s * y;
            here.R[row + 1] = c * y - s * x;
        }
    }
}

Vec World::tool_at(const double* q) {
    place(q);
    return frames_.back().apply(tool);
}

Vec World::centre(std::int32_t index) {
    const auto at = static_cast<std::size_t>(index);
    if (centred_at_[at] != stamp_) {
        centred_at_[at] = stamp_;
        centres_[at] = frames_[static_cast<std::size_t>(bodies[at].joint)].apply(bodies[at].centre);
    }
    return centres_[at];
}

double World::sphere_bound(std::int32_t index) {
    const Pair& pair = pairs[static_cast<std::size_t>(index)];
    const Body& body = bodies[static_cast<std::size_t>(pair.body)];
    const Vec here = centre(pair.body);
    if (pair.kind == Other::kTable) return here.z - table_height - body.radius;
    if (pair.kind == Other::kGrid) {
        const double point[3] = {here.x, here.y, here.z};
        const double away = grid.grid->at(point) - kSlope * body.radius - body.cover;
        return away > 0.0 ? away * (1.0 - kShare) : away;
    }
    if (pair.kind == Other::kBox) {
        const Box& box = boxes[static_cast<std::size_t>(pair.other)];
        return distance_to_box(box.pose.turn_back(here - box.pose.t), box.half) - body.radius;
    }
    const Body& other = bodies[static_cast<std::size_t>(pair.other)];
    return norm(centre(pair.other) - here) - body.radius - other.radius;
}

Vec World::support(const Body& body, const Pose& pose, Vec direction) const {
    const Vec d = pose.turn_back(direction);
    const float way[3] = {static_cast<float>(d.x), static_cast<float>(d.y), static_cast<float>(d.z)};
    const int found = farthest(body, way);
    const auto at = std::min(static_cast<std::size_t>(found), body.corners.size() - 1);
    return pose.apply(body.corners[at]);
}

Separation World::exact(std::int32_t index, double enough, double too_little) {
    const Pair& pair = pairs[static_cast<std::size_t>(index)];
    const Body& body = bodies[static_cast<std::size_t>(pair.body)];
    const Pose& pose = frames_[static_cast<std::size_t>(body.joint)];
    Separation found;
    if (pair.kind == Other::kTable) {
        const double below = support(body, pose, {0, 0, -1}).z - table_height;
        found.least = found.most = below;
        return found;
    }
    if (pair.kind == Other::kGrid) {
        const double t[3] = {pose.t.x, pose.t.y, pose.t.z};
        const double away =
            grid.search->nearest(pose.R, t, body.root_begin, body.root_end) - body.cover;
        found.least = found.most = away;
        return found;
    }
    Vec& guess = guesses_[static_cast<std::size_t>(index)];
    const bool new_guess = !(dot(guess, guess) > 0.0);
    if (pair.kind == Other::kBox) {
        const Box& box = boxes[static_cast<std::size_t>(pair.other)];
        if (new_guess) guess = centre(pair.body) - box.pose.t;
        return separation(
            [&](Vec d) {
                const Vec in_box = box.pose.turn_back(d);
                const Vec corner{in_box.x < 0 ? box.half.x : -box.half.x,
                                 in_box.y < 0 ? box.half.y : -box.half.y,
                                 in_box.z < 0 ? box.half.z : -box.half.z};
                return support(body, pose, d) - box.pose.apply(corner);
            },
            enough, too_little, guess);
    }
    const Body& other = bodies[static_cast<std::size_t>(pair.other)];
    const Pose& second = frames_[static_cast<std::size_t>(other.joint)];
    if (new_guess) guess = centre(pair.body) - centre(pair.other);
    return separation(
        [&](Vec d) { return support(body, pose, d) - support(other, second, -1.0 * d); }, enough,
        too_little, guess);
}

Separation World::distance(std::int32_t index, double enough, double too_little) {
    Separation found;
    found.least = sphere_bound(index);
    if (found.least >= enough) return found;
    const Separation known = exact(index, enough + kRounding, too_little);
    found.least = std::max(found.least, known.least - kRounding);
    found.most = known.most;
    return found;
}

std::int32_t World::touching(const double* q) {
    place(q);
    for (std::size_t index = 0; index < pairs.size(); ++index) {
        const double limit = pairs[index].limit;
        const Separation found = distance(static_cast<std::int32_t>(index), limit, limit);
        if (!(found.least >= limit)) return static_cast<std::int32_t>(index);
    }
    return -1;
}

std::int32_t World::blocked(const double* from, const double* to) {
    open_.clear();
    parts_.clear();
    const std::size_t dof = joints.size();
    for (std::size_t j = 0; j < dof; ++j) turned_[j] = 0.5 * std::fabs(to[j] - from[j]);
    for (const std::int32_t index : order_) {
        const Pair& pair = pairs[static_cast<std::size_t>(index)];
        const Body& moving = bodies[static_cast<std::size_t>(pair.moving)];
        bool moves = false;
        for (int j = pair.fixed_joint; j < moving.joint; ++j)
            moves = moves || turned_[static_cast<std::size_t>(j)] > 0.0;
        if (moves) open_.push_back(index);
    }
    std::vector<double>& turned = half_turns_;
    turned.resize(dof);
    parts_.push_back({0.0, 1.0, 0, open_.size()});
    // Coarse parts first: what blocks a way is then found soonest.
    for (std::size_t next = 0; next < parts_.size(); ++next) {
        const Part part = parts_[next];
        const double middle = 0.5 * (part.begin + part.end);
        const double half = 0.5 * (part.end - part.begin);
        for (std::size_t j = 0; j < dof; ++j)
            middle_[j] = from[j] + middle * (to[j] - from[j]);
        for (std::size_t j = 0; j < dof; ++j) turned[j] = 2 * half * turned_[j];
        place(middle_.data());
        const std::size_t first = open_.size();
        for (std::size_t at = part.first; at < part.last; ++at) {
            const std::int32_t index = open_[at];
            const Pair& pair = pairs[static_cast<std::size_t>(index)];
            const double limit = pair.limit;
            place_travel(pair.moving, turned.data());
            const double moves = travels_[static_cast<std::size_t>(pair.moving)]
                                         [static_cast<std::size_t>(pair.fixed_joint)];
            const Separation found = distance(index, limit + moves, limit);
            if (found.least >= limit + moves) continue;
            if (found.least < limit || moves <= 0.5 * kFine) {
                const auto own = std::find(order_.begin(), order_.end(), index);
                std::rotate(order_.begin(), own, own + 1);
                return index;
            }
            open_.push_back(index);
        }
        if (open_.size() > first) {
            parts_.push_back({middle, part.end, first, open_.size()});
            parts_.push_back({part.begin, middle, first, open_.size()});
        }
    }
    return -1;
}
