// Corners become parabolas: within the triangle of the corner, tangent to both lines. The speed is
// found by reachability (Pham, Pham 2018, "A new approach to time-optimal path parameterization
// based on reachability analysis"): backwards the greatest speed from which one can still stop,
// then forwards as fast as that allows. Both need, at each point, a linear programme in two numbers.
#include "timing.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <stdexcept>

namespace {

using Row = std::vector<double>;
constexpr double kInfinity = std::numeric_limits<double>::infinity();

// A line or a parabola, passed at unit speed at its ends.
struct Piece {
    Row a, b, c;
    // Ends and, between them, the corner.
    double length = 0.0;
    bool straight = true;

    void at(double u, double* q) const {
        const double t = length > 0.0 ? u / length : 0.0;
        for (std::size_t j = 0; j < a.size(); ++j)
            q[j] = straight ? a[j] + t * (c[j] - a[j])
                            : (1 - t) * (1 - t) * a[j] + 2 * t * (1 - t) * b[j] + t * t * c[j];
    }
    void derivatives(double u, double* first, double* second) const {
        const double t = length > 0.0 ? u / length : 0.0;
        for (std::size_t j = 0; j < a.size(); ++j) {
            first[j] = straight ? (c[j] - a[j]) / length
                                : 2 * ((1 - t) * (b[j] - a[j]) + t * (c[j] - b[j])) / length;
            second[j] = straight ? 0.0 : 2 * (c[j] - 2 * b[j] + a[j]) / (length * length);
        }
    }
};

double away(const Row& a, const Row& b) {
    double sum = 0.0;
    for (std::size_t j = 0; j < a.size(); ++j) sum += (a[j] - b[j]) * (a[j] - b[j]);
    return std::sqrt(sum);
}

Row between(const Row& a, const Row& b, double share) {
    Row row(a.size());
    for (std::size_t j = 0; j < a.size(); ++j) row[j] = a[j] + share * (b[j] - a[j]);
    return row;
}

// Whether a parabola is free, as the chords that will be followed.
bool free_arc(World& world, const Piece& arc) {
    constexpr int kChords = 8;
    Row from = arc.a, to(from.size());
    for (int k = 1; k <= kChords; ++k) {
        arc.at(arc.length * k / kChords, to.data());
        if (world.blocked(from.data(), to.data()) >= 0) return false;
        from = to;
    }
    return true;
}

std::vector<Piece> rounded(World& world, const std::vector<Row>& knots, bool round) {
    constexpr int kHalvings = 5;
    constexpr double kShortest = 1e-6;
    std::vector<double> lengths;
    for (std::size_t i = 0; i + 1 < knots.size(); ++i) lengths.push_back(away(knots[i], knots[i + 1]));
    std::vector<double> cut(knots.size(), 0.0);
    std::vector<Piece> pieces;
    Row from = knots.front();
    for (std::size_t i = 1; i + 1 < knots.size(); ++i) {
        // The first and the last line are one corner's alone; others are shared by two.
        const double before = i == 1 ? lengths[0] : lengths[i - 1] - cut[i - 1];
        const double after = i + 2 == knots.size() ? lengths[i] : 0.5 * lengths[i];
        double reach = std::min(before, after);
        Piece arc;
        bool free = false;
        for (int halving = 0; round && halving <= kHalvings; ++halving, reach *= 0.5) {
            arc.a = between(knots[i], knots[i - 1], reach / lengths[i - 1]);
            arc.b = knots[i];
            arc.c = between(knots[i], knots[i + 1], reach / lengths[i]);
            arc.length = 2 * reach;
            arc.straight = false;
            free = free_arc(world, arc);
            if (free) break;
        }
        Piece line;
        line.a = from;
        line.c = free ? arc.a : knots[i];
        line.length = away(line.a, line.c);
        if (line.length > kShortest) pieces.push_back(line);
        if (free) {
            pieces.push_back(arc);
            cut[i] = reach;
        } else {
            pieces.push_back(Piece{});  // stop here
        }
        from = free ? arc.c : knots[i];
    }
    Piece line;
    line.a = from;
    line.c = knots.back();
    line.length = away(line.a, line.c);
    if (line.length > kShortest) pieces.push_back(line);
    return pieces;
}

// One constraint low <= p u + q x <= high on acceleration u and squared speed x.
struct Band {
    double p, q, most;
};

// Between which accelerations all bands hold at a squared speed, and what bounds them.
struct Range {
    double low = -kInfinity, high = kInfinity;
    double low_slope = 0.0, high_slope = 0.0;
};

Range range_at(const std::vector<Band>& bands, double x) {
    constexpr double kNothing = 1e-12;
    Range range;
    for (const Band& band : bands) {
        if (std::fabs(band.p) < kNothing) continue;
        const double size = std::fabs(band.p), sign = band.p > 0 ? 1.0 : -1.0;
        const double slope = -sign * band.q / size, reach = band.most / size;
        if (slope * x + reach < range.high) {
            range.high = slope * x + reach;
            range.high_slope = slope;
        }
        if (slope * x - reach > range.low) {
            range.low = slope * x - reach;
            range.low_slope = slope;
        }
    }
    return range;
}

struct Step {
    double width = 0.0;
    std::vector<Band> bands;
    double most = kInfinity;
    // Of the squared speed at its beginning.
};

// The greatest squared speed at a step's beginning from which one of at most `next` is reached.
double controllable(const Step& step, double next) {
    std::vector<Band> bands = step.bands;
    // x + 2 w u between 0 and next.
    bands.push_back({2 * step.width, 1.0, next});
    double x = step.most;
    for (const Band& band : step.bands)
        if (std::fabs(band.p) < 1e-12 && std::fabs(band.q) > 1e-12)
            x = std::min(x, band.most / std::fabs(band.q));
    for (int k = 0; k < 60; ++k) {
        const Range range = range_at(bands, x);
        if (range.low <= range.high + 1e-12) return x;
        const double closing = range.low_slope - range.high_slope;
        if (!(closing > 0.0)) return 0.0;
        x = std::max(0.0, x - (range.low - range.high) / closing);
    }
    return 0.0;
}


class Law {
public:
    Law(World& world, const std::vector<Piece>& pieces, const Limits& limits)
        : world_(world), pieces_(pieces), limits_(limits) {
        for (std::size_t p = 0; p < pieces.size(); ++p) divide(p);
    }

    // Squared speeds at all places; what is infeasible stands still.
    void solve() {
        const std::size_t count = steps_.size();
        std::vector<double> most(count + 1, 0.0);
        for (std::size_t i = count; i-- > 0;) most[i] = controllable(steps_[i], most[i + 1]);
        squares_.assign(count + 1, 0.0);
        for (std::size_t i = 0; i < count; ++i) {
            const double x = std::min(squares_[i], most[i]);
            const double high = range_at(steps_[i].bands, x).high;
            const double next = x + 2 * steps_[i].width * high;
            squares_[i + 1] = std::clamp(next, 0.0, most[i + 1]);
        }
    }

    // Postures at even times, those where the arm stands still among them.
    void sample(double step_s, Timed& timed) const {
        Row q(limits_.speed.size());
        const auto note = [&](double t, std::size_t i, double moved) {
            pieces_[owner_[i]].at(offset_[i] + std::clamp(moved, 0.0, steps_[i].width), q.data());
            timed.times.push_back(t);
            timed.rows.insert(timed.rows.end(), q.begin(), q.end());
        };
        note(0.0, 0, 0.0);
        double begun = 0.0;
        for (std::size_t section = 0; section < begins_.size(); ++section) {
            const std::size_t first = begins_[section];
            const std::size_t last = section + 1 < begins_.size() ? begins_[section + 1] : steps_.size();
            double whole = 0.0;
            for (std::size_t i = first; i < last; ++i) whole += time_of(i);
            const auto count = static_cast<std::int64_t>(std::max(1.0, std::ceil(whole / step_s - 1e-9)));
            std::size_t i = first;
            double before = 0.0;
            for (std::int64_t k = 1; k < count; ++k) {
                const double t = whole * static_cast<double>(k) / static_cast<double>(count);
                while (i + 1 < last && before + time_of(i) < t) before += time_of(i++);
                const double since = t - before;
                const double u = (squares_[i + 1] - squares_[i]) / (2 * steps_[i].width);
                note(begun + t, i, std::sqrt(squares_[i]) * since + 0.5 * u * since * since);
            }
            begun += whole;
            note(begun, last - 1, steps_[last - 1].width);
        }
        double place = 0.0;
        for (std::size_t i = 0; i < steps_.size(); ++i) {
            pieces_[owner_[i]].at(offset_[i], q.data());
            timed.curve.insert(timed.curve.end(), q.begin(), q.end());
            timed.curve_at.push_back(place);
            place += steps_[i].width;
        }
        pieces_.back().at(pieces_.back().length, q.data());
        timed.curve.insert(timed.curve.end(), q.begin(), q.end());
        timed.curve_at.push_back(place);
    }

private:
    double time_of(std::size_t i) const {
        const double sum = std::sqrt(squares_[i]) + std::sqrt(squares_[i + 1]);
        return sum > 0.0 ? 2 * steps_[i].width / sum : 0.0;
    }

    void divide(std::size_t p) {
        const Piece& piece = pieces_[p];
        if (!(piece.length > 0.0)) {
            stop_ = true;
            return;
        }
        constexpr double kLongest = 0.02;
        constexpr int kFewest = 8, kMost = 60;
        const int count = std::clamp(static_cast<int>(std::ceil(piece.length / kLongest)), kFewest, kMost);
        for (int k = 0; k < count; ++k) {
            // Shorter towards the ends of lines, where the speed changes most at rest.
            const double from = place(piece, k, count), to = place(piece, k + 1, count);
            Step step;
            step.width = to - from;
            step.most = std::min(fastest(piece, from), kInfinity);
            if (k == 0 && stop_) {
                step.most = 0.0;
                begins_.push_back(steps_.size());
            }
            add_bands(piece, from, 0.0, step);
            add_bands(piece, to, 2 * step.width, step);
            steps_.push_back(step);
            owner_.push_back(p);
            offset_.push_back(from);
        }
        stop_ = false;
    }

    static double place(const Piece& piece, int k, int count) {
        const double share = static_cast<double>(k) / count;
        return piece.straight ? piece.length * 0.5 * (1 - std::cos(3.14159265358979323846 * share))
                              : piece.length * share;
    }

    // The greatest squared speed that joints and tool may have at a place.
    double fastest(const Piece& piece, double u) {
        const std::size_t dof = limits_.speed.size();
        Row first(dof), second(dof), q(dof);
        piece.derivatives(u, first.data(), second.data());
        double most = kInfinity;
        for (std::size_t j = 0; j < dof; ++j)
            if (std::fabs(first[j]) > 1e-12) {
                const double v = limits_.speed[j] / std::fabs(first[j]);
                most = std::min(most, v * v);
            }
        if (limits_.tool_speed > 0.0) {
            constexpr double kAside = 1e-4;
            const double low = std::max(0.0, u - kAside), high = std::min(piece.length, u + kAside);
            piece.at(low, q.data());
            const Vec a = world_.tool_at(q.data());
            piece.at(high, q.data());
            const Vec b = world_.tool_at(q.data());
            const double per = norm(b - a) / (high - low);
            if (per > 1e-9) most = std::min(most, (limits_.tool_speed / per) * (limits_.tool_speed / per));
        }
        return most;
    }

    // |q' u + q'' (x + later u)| <= a of every joint.
    void add_bands(const Piece& piece, double u, double later, Step& step) const {
        const std::size_t dof = limits_.speed.size();
        Row first(dof), second(dof);
        piece.derivatives(u, first.data(), second.data());
        for (std::size_t j = 0; j < dof; ++j)
            step.bands.push_back({first[j] + second[j] * later, second[j], limits_.acceleration[j]});
    }

    World& world_;
    const std::vector<Piece>& pieces_;
    const Limits& limits_;
    std::vector<Step> steps_;
    std::vector<std::size_t> owner_;
    std::vector<double> offset_;
    std::vector<double> squares_;
    std::vector<std::size_t> begins_;
    // Where it starts from rest.
    bool stop_ = true;
};

}  // namespace

Timed time_path(World& world, const std::vector<double>& path, const Limits& limits, double step_s,
                bool round) {
    world.forget();
    const std::size_t dof = limits.speed.size();
    std::vector<Row> knots;
    for (std::size_t i = 0; i + dof <= path.size(); i += dof) {
        Row row(path.begin() + static_cast<std::ptrdiff_t>(i),
                path.begin() + static_cast<std::ptrdiff_t>(i + dof));
        if (knots.empty() || away(knots.back(), row) > 1e-6) knots.push_back(row);
    }
    Timed timed;
    if (knots.size() < 2) {
        timed.times = {0.0};
        timed.rows = knots.empty() ? Row{} : knots.front();
        timed.curve = timed.rows;
        timed.curve_at = {0.0};
        return timed;
    }
    const std::vector<Piece> pieces = rounded(world, knots, round);
    Law law(world, pieces, limits);
    law.solve();
    law.sample(step_s, timed);
    return timed;
}
