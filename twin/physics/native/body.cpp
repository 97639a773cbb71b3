#include "body.hpp"

#include <algorithm>
#include <array>
#include <cstring>
#include <limits>

namespace soft {

namespace {

constexpr double kRecentre = 0.03;   // farther from its origin [m] a body gets another one
// Most that the local step's matrix may add to 1 before kept stress overshoots (measured: 3 is too
// much); the stiffest tetrahedra forget part of theirs, most bodies' need smaller substeps.
constexpr double kCoupling = 2.0;
constexpr double kUsual = 0.9;       // share of the tetrahedra that must keep all of their stress
// Substeps that viscosity looks back at most: with 24 a duck's beak crept inside out (measured).
constexpr double kViscous = 5.0;
// A body that touches something loses its turning at this rate [1/s]: what is pressed flat gives
// less back than it took. Without it light toys rock for seconds.
constexpr float kRolling = 8.0f;
// While it leaves what holds it up it loses speed at this rate [1/s]: the bounded viscosity of
// single tetrahedra lets stiff light toys bounce, which stuffed ones do not.
constexpr double kRebound = 600.0;
constexpr double kHysteresis = 0.8;  // at most this share of what held it up: nothing sticks
constexpr double kOriginGrid = 1.0 / 1024;  // origins are multiples of it [m]

Matrix inverse(const Matrix& a) {
    const auto& m = a.m;
    const double c00 = m[1][1] * m[2][2] - m[1][2] * m[2][1];
    const double c01 = m[1][2] * m[2][0] - m[1][0] * m[2][2];
    const double c02 = m[1][0] * m[2][1] - m[1][1] * m[2][0];
    const double det = m[0][0] * c00 + m[0][1] * c01 + m[0][2] * c02;
    Matrix r;
    r.m[0][0] = c00 / det;
    r.m[0][1] = (m[0][2] * m[2][1] - m[0][1] * m[2][2]) / det;
    r.m[0][2] = (m[0][1] * m[1][2] - m[0][2] * m[1][1]) / det;
    r.m[1][0] = c01 / det;
    r.m[1][1] = (m[0][0] * m[2][2] - m[0][2] * m[2][0]) / det;
    r.m[1][2] = (m[0][2] * m[1][0] - m[0][0] * m[1][2]) / det;
    r.m[2][0] = c02 / det;
    r.m[2][1] = (m[0][1] * m[2][0] - m[0][0] * m[2][1]) / det;
    r.m[2][2] = (m[0][0] * m[1][1] - m[0][1] * m[1][0]) / det;
    return r;
}

double largest_eigenvalue(const Matrix& a) {
    // Power iteration from a vector that no symmetry of a lattice makes orthogonal.
    double x[3] = {0.577, 0.637, 0.511}, size = 1.0;
    for (int turn = 0; turn < 60; ++turn) {
        double y[3];
        for (int i = 0; i < 3; ++i)
            y[i] = a.m[i][0] * x[0] + a.m[i][1] * x[1] + a.m[i][2] * x[2];
        size = std::sqrt(y[0] * y[0] + y[1] * y[1] + y[2] * y[2]);
        for (int i = 0; i < 3; ++i) x[i] = y[i] / size;
    }
    return size;
}

}  // namespace

Body::Body(const BodySpec& spec)
    : samples(spec.samples),
      triangles(spec.triangles),
      friction(spec.friction),
      damping_s(spec.damping_s),
      damping_rate(spec.damping_rate),
      spacing(spec.spacing),
      num_nodes(static_cast<int>(spec.nodes.size())),
      spec_(spec) {
    // Lame's constants, and Smith et al. 2018 (section 3.4): lambda is theirs plus mu, so that the
    // energy is linear elasticity for small strains.
    const double mu = spec.young / (2 * (1 + spec.poisson));
    const double lame = spec.young * spec.poisson / ((1 + spec.poisson) * (1 - 2 * spec.poisson));
    material.mu = static_cast<float>(mu);
    material.lambda = static_cast<float>(lame + mu);
    material.metric = static_cast<float>(2 * mu + 1.5 * lame);
    p.assign(4 * (num_nodes + 4), 0.0f);
    for (int k = 1; k < 4; ++k) p[4 * (num_nodes + k) + k - 1] = 1.0f;
    v.assign(p.size(), 0.0f);
    Double3 middle{0, 0, 0};
    for (const Double3& node : spec.nodes) middle = middle + node;
    middle = middle * (1.0 / num_nodes);
    origin = {std::round(middle.x / kOriginGrid) * kOriginGrid,
              std::round(middle.y / kOriginGrid) * kOriginGrid,
              std::round(middle.z / kOriginGrid) * kOriginGrid};
    for (int i = 0; i < num_nodes; ++i) {
        const Float3 local = narrow(spec.nodes[i] - origin);
        p[4 * i] = local.x;
        p[4 * i + 1] = local.y;
        p[4 * i + 2] = local.z;
        p[4 * i + 3] = static_cast<float>(1.0 / spec.masses[i]);
        masses_.push_back(static_cast<float>(spec.masses[i]));
        mass_ += spec.masses[i];
    }
    start = p;
    predicted_ = p;
    look_around();
}

Body::Tet Body::tet_of(std::int32_t t, double step_s) const {
    const std::int32_t* ids = spec_.tets.data() + 4 * t;
    Matrix edges;
    for (int k = 0; k < 3; ++k) {
        const Double3 edge = spec_.rest[ids[k + 1]] - spec_.rest[ids[0]];
        edges.m[0][k] = edge.x;
        edges.m[1][k] = edge.y;
        edges.m[2][k] = edge.z;
    }
    const Double3 e1{edges.m[0][0], edges.m[1][0], edges.m[2][0]},
        e2{edges.m[0][1], edges.m[1][1], edges.m[2][1]},
        e3{edges.m[0][2], edges.m[1][2], edges.m[2][2]};
    Tet tet;
    tet.b = inverse(edges);
    tet.step_volume = step_s * step_s * dot(cross(e1, e2), e3) / 6;
    tet.system = Matrix{};
    for (int i = 0; i < 3; ++i) tet.system.m[i][i] = 1.0;
    for (int k = 0; k < 4; ++k) {
        double row[3];
        for (int j = 0; j < 3; ++j)
            row[j] = k ? tet.b.m[k - 1][j] : -(tet.b.m[0][j] + tet.b.m[1][j] + tet.b.m[2][j]);
        const double scale = material.metric * tet.step_volume / spec_.masses[ids[k]];
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 3; ++j) tet.system.m[i][j] += scale * row[i] * row[j];
    }
    tet.coupling = largest_eigenvalue(tet.system) - 1.0;
    return tet;
}

double Body::longest_substep(double step_s) const {
    std::vector<double> couplings;
    for (std::size_t t = 0; t < spec_.tets.size() / 4; ++t)
        couplings.push_back(tet_of(static_cast<std::int32_t>(t), step_s).coupling);
    std::sort(couplings.begin(), couplings.end());
    const double usual = couplings[static_cast<std::size_t>(kUsual * (couplings.size() - 1))];
    return step_s * std::sqrt(kCoupling / usual);
}

void Body::build_blocks(double step_s) {
    const int num_tets = static_cast<int>(spec_.tets.size() / 4);
    order = block_order(spec_.tets.data(), num_tets, num_nodes);
    blocks.assign(order.size() / kLanes, TetBlock{});
    for (std::size_t n = 0; n < order.size(); ++n) {
        TetBlock& block = blocks[n / kLanes];
        const int lane = static_cast<int>(n % kLanes);
        const std::int32_t t = order[n];
        if (t < 0) {
            for (int k = 0; k < 4; ++k) block.ids[k][lane] = num_nodes + k;
            for (int k = 0; k < 3; ++k) block.b[4 * k][lane] = 1.0f;
            continue;
        }
        const Tet tet = tet_of(t, step_s);
        const Matrix z = inverse(tet.system);
        const double six[6] = {z.m[0][0], z.m[0][1], z.m[0][2], z.m[1][1], z.m[1][2], z.m[2][2]};
        for (int k = 0; k < 4; ++k) block.ids[k][lane] = spec_.tets[4 * t + k];
        for (int k = 0; k < 9; ++k) block.b[k][lane] = static_cast<float>(tet.b.m[k / 3][k % 3]);
        for (int k = 0; k < 6; ++k) block.z[k][lane] = static_cast<float>(six[k]);
        block.kept[lane] = static_cast<float>(std::min(1.0, kCoupling / tet.coupling));
        const double substeps = std::min(damping_s / step_s, kViscous);
        block.viscosity[lane] = static_cast<float>(
            2 * material.mu * substeps / (1 + substeps * tet.coupling));
        block.step_volume[lane] = static_cast<float>(tet.step_volume);
    }
}

void Body::shift_sample(const Sample& s, const Float3& by, float sample_inverse_mass) {
    if (s.ids[0] == s.ids[1]) {
        shift(s.ids[0], by);
        return;
    }
    for (const std::int32_t id : s.ids)
        shift(id, by * (0.5f * inverse_mass(id) / sample_inverse_mass));
}

void Body::look_around() {
    constexpr float far = std::numeric_limits<float>::max();
    Float3 low{far, far, far}, high{-far, -far, -far};
    float fastest = 0.0f, sum = 0.0f;
    for (int i = 0; i < num_nodes; ++i) {
        const Float3 node = at(i);
        low = {std::min(low.x, node.x), std::min(low.y, node.y), std::min(low.z, node.z)};
        high = {std::max(high.x, node.x), std::max(high.y, node.y), std::max(high.z, node.z)};
        const float* speed = v.data() + 4 * i;
        fastest = std::max(fastest,
                           speed[0] * speed[0] + speed[1] * speed[1] + speed[2] * speed[2]);
        sum += node.x + node.y + node.z + speed[0] + speed[1] + speed[2];
    }
    if (!std::isfinite(sum)) {
        lost = true;
        return;
    }
    top_speed = std::sqrt(fastest);
    box = {origin + widen(low), origin + widen(high)};
    recentre(widen(low + high) * 0.5);
    update_normals();
}

void Body::update_normals() {
    normals.assign(num_nodes, Float3{0, 0, 0});
    for (std::size_t t = 0; t < triangles.size(); t += 3) {
        const std::int32_t* ids = triangles.data() + t;
        const Float3 a = at(ids[0]);
        const Float3 normal = soft::cross(at(ids[1]) - a, at(ids[2]) - a);
        for (int k = 0; k < 3; ++k) normals[ids[k]] = normals[ids[k]] + normal;
    }
}

Float3 Body::sample_facing(const Sample& s) const {
    const Float3 sum = normals[s.ids[0]] + normals[s.ids[1]];
    const float length = norm(sum);
    return length > 0.0f ? sum * (1.0f / length) : Float3{0, 0, 0};
}

void Body::recentre(const Double3& middle) {
    if (norm(middle) < kRecentre) return;
    const Double3 by{std::round(middle.x / kOriginGrid) * kOriginGrid,
                     std::round(middle.y / kOriginGrid) * kOriginGrid,
                     std::round(middle.z / kOriginGrid) * kOriginGrid};
    origin = origin + by;
    const Float3 less = narrow(by * -1.0);
    for (int i = 0; i < num_nodes; ++i) shift(i, less);
}

void Body::predict(double gravity, float step_s, const Kernels& kernels) {
    touches = false;
    support = {0, 0, 0};
    const float fall = static_cast<float>(gravity) * step_s;
    std::copy(p.begin(), p.end(), start.begin());
    for (int i = 0; i < num_nodes; ++i) {
        v[4 * i + 2] -= fall;
        for (int k = 0; k < 3; ++k) p[4 * i + k] += v[4 * i + k] * step_s;
    }
    std::copy(p.begin(), p.end(), predicted_.begin());
    kernels.apply_stress(blocks.data(), static_cast<int>(blocks.size()), p.data());
}

void Body::finish(float step_s) {
    // The difference to the prediction, not to the start: free flight then loses no digit.
    const float rate = 1.0f / step_s;
    for (int i = 0; i < 4 * num_nodes; ++i) v[i] += (p[i] - predicted_[i]) * rate;
}

namespace {

Four turned(Four a) { return SOFT_PICK_FOUR(a, a, 1, 2, 0, 3); }

Four cross(Four a, Four b) { return turned(a * turned(b) - turned(a) * b); }

}  // namespace

void Body::damp(float step_s) {
    // Mueller et al. 2007 (position based dynamics), section 3.5: linear and angular momentum stay.
    if (damping_rate <= 0.0 && !touches) return;
    Four flow{}, spin{}, place{}, square{}, mixed{};
    for (int i = 0; i < num_nodes; ++i) {
        const Four x = load_four(p.data() + 4 * i), m = Four{} + masses_[i];
        const Four mx = m * x, mv = m * load_four(v.data() + 4 * i);
        flow += mv;
        spin += cross(x, mv);
        place += mx;
        square += mx * x;
        mixed += mx * turned(x);  // xy, yz, zx
    }
    const Double3 middle = Double3{place[0], place[1], place[2]} * (1.0 / mass_);
    const Double3 mean = Double3{flow[0], flow[1], flow[2]} * (1.0 / mass_);
    const Double3 turn = Double3{spin[0], spin[1], spin[2]} - soft::cross(middle, mean) * mass_;
    const double xx = square[0] - mass_ * middle.x * middle.x;
    const double yy = square[1] - mass_ * middle.y * middle.y;
    const double zz = square[2] - mass_ * middle.z * middle.z;
    const double xy = mixed[0] - mass_ * middle.x * middle.y;
    const double yz = mixed[1] - mass_ * middle.y * middle.z;
    const double zx = mixed[2] - mass_ * middle.z * middle.x;
    const Matrix back =
        inverse({{{yy + zz, -xy, -zx}, {-xy, xx + zz, -yz}, {-zx, -yz, xx + yy}}});
    const auto& r = back.m;
    const Double3 omega{r[0][0] * turn.x + r[0][1] * turn.y + r[0][2] * turn.z,
                        r[1][0] * turn.x + r[1][1] * turn.y + r[1][2] * turn.z,
                        r[2][0] * turn.x + r[2][1] * turn.y + r[2][2] * turn.z};
    const double slowed = touches ? 1.0 / (1.0 + kRolling * step_s) : 1.0;
    Double3 calmer = mean;
    const Double3 up = widen(support);
    const double size = norm(up), leaving = size > 0.0 ? dot(mean, up) / size : 0.0;
    if (leaving > 0.0) {
        const double most = kHysteresis * size / (mass_ * step_s);
        const double lost = std::min(leaving * (1.0 - 1.0 / (1.0 + kRebound * step_s)), most);
        calmer = mean - up * (lost / size);
    }
    const auto motion = [&](const Double3& speed, const Double3& turning) {
        const Float3 base = narrow(speed - soft::cross(turning, middle)), axis = narrow(turning);
        return std::array<Four, 2>{Four{base.x, base.y, base.z, 0.0f},
                                   Four{axis.x, axis.y, axis.z, 0.0f}};
    };
    const auto now = motion(mean, omega), after = motion(calmer, omega * slowed);
    const Four kept = Four{} + 1.0f / (1.0f + static_cast<float>(damping_rate) * step_s);
    for (int i = 0; i < num_nodes; ++i) {
        const Four x = load_four(p.data() + 4 * i);
        const Four rest = load_four(v.data() + 4 * i) - (now[0] + cross(now[1], x));
        const Four slower = after[0] + cross(after[1], x) + kept * rest;
        std::memcpy(v.data() + 4 * i, &slower, sizeof(slower));
    }
}

}  // namespace soft
