#include "body.hpp"

#include <algorithm>
#include <limits>

namespace soft {

namespace {

constexpr double kRecentre = 0.03;   // farther from its origin [m] a body gets another one
// Most that the local step's matrix may add to 1 before kept stress overshoots (measured: 3 is too
// much); the stiffest tetrahedra forget part of theirs, most bodies' need smaller substeps.
constexpr double kCoupling = 2.0;
constexpr double kUsual = 0.9;       // share of the tetrahedra that must keep all of their stress
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

void Body::damp(double period_s) {
    // Mueller et al. 2007 (position based dynamics), section 3.5: linear and angular momentum stay.
    if (damping_rate <= 0.0) return;
    double mass = 0.0;
    Double3 middle{0, 0, 0}, mean{0, 0, 0};
    for (int i = 0; i < num_nodes; ++i) {
        const double m = 1.0 / inverse_mass(i);
        mass += m;
        middle = middle + widen(at(i)) * m;
        mean = mean + Double3{v[4 * i], v[4 * i + 1], v[4 * i + 2]} * m;
    }
    middle = middle * (1.0 / mass);
    mean = mean * (1.0 / mass);
    Matrix inertia{};
    Double3 spin{0, 0, 0};
    for (int i = 0; i < num_nodes; ++i) {
        const double m = 1.0 / inverse_mass(i);
        const Double3 r = widen(at(i)) - middle;
        const double rr = dot(r, r), c[3] = {r.x, r.y, r.z};
        spin = spin + cross(r, Double3{v[4 * i], v[4 * i + 1], v[4 * i + 2]}) * m;
        for (int a = 0; a < 3; ++a)
            for (int b = 0; b < 3; ++b) inertia.m[a][b] += m * ((a == b ? rr : 0.0) - c[a] * c[b]);
    }
    const Matrix back = inverse(inertia);
    const double s[3] = {spin.x, spin.y, spin.z};
    double turn[3] = {0, 0, 0};
    for (int a = 0; a < 3; ++a)
        for (int b = 0; b < 3; ++b) turn[a] += back.m[a][b] * s[b];
    const Double3 omega{turn[0], turn[1], turn[2]};
    const double kept = 1.0 / (1.0 + damping_rate * period_s);
    for (int i = 0; i < num_nodes; ++i) {
        const Double3 rigid = mean + cross(omega, widen(at(i)) - middle);
        v[4 * i] = static_cast<float>(rigid.x + kept * (v[4 * i] - rigid.x));
        v[4 * i + 1] = static_cast<float>(rigid.y + kept * (v[4 * i + 1] - rigid.y));
        v[4 * i + 2] = static_cast<float>(rigid.z + kept * (v[4 * i + 2] - rigid.z));
    }
}

}  // namespace soft
