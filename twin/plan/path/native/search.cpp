#include "search.hpp"

#include <algorithm>
#include <cmath>

namespace {

using Row = std::vector<double>;

double distance(const double* a, const double* b, int n) {
    double sum = 0.0;
    for (int j = 0; j < n; ++j) sum += (a[j] - b[j]) * (a[j] - b[j]);
    return std::sqrt(sum);
}

struct Tree {
    Row rows;
    std::vector<std::int32_t> parents;

    void add(const double* row, int n, std::int32_t parent) {
        rows.insert(rows.end(), row, row + n);
        parents.push_back(parent);
    }
    const double* row(std::int32_t index, int n) const {
        return rows.data() + static_cast<std::ptrdiff_t>(index) * n;
    }
    std::int32_t nearest(const double* to, int n) const {
        std::int32_t best = 0;
        double least = std::numeric_limits<double>::infinity();
        for (std::size_t i = 0; i < parents.size(); ++i) {
            const double away = distance(row(static_cast<std::int32_t>(i), n), to, n);
            if (away < least) {
                least = away;
                best = static_cast<std::int32_t>(i);
            }
        }
        return best;
    }
};

// Between start and goals at first, and farther around them the longer nothing is found.
class Sampler {
public:
    Sampler(const World& world, const double* start, const double* goals, std::int32_t num_goals,
            std::uint64_t seed)
        : world_(world), random_(seed), low_(start, start + world.num_joints()), high_(low_) {
        const int n = world.num_joints();
        for (std::int32_t g = 0; g < num_goals; ++g)
            for (int j = 0; j < n; ++j) {
                const auto at = static_cast<std::size_t>(j);
                low_[at] = std::min(low_[at], goals[g * n + j]);
                high_[at] = std::max(high_[at], goals[g * n + j]);
            }
    }

    void draw(std::int64_t round, double* row) {
        constexpr double kAround = 0.8;
        constexpr std::int64_t kRounds = 60;
        const std::int64_t grown = round / kRounds;  // whole steps
        const double around = kAround * static_cast<double>(1 + grown);
        for (std::size_t j = 0; j < low_.size(); ++j) {
            const double low = std::max(low_[j] - around, world_.joints[j].lower);
            const double high = std::min(high_[j] + around, world_.joints[j].upper);
            row[j] = low + random_.uniform() * (high - low);
        }
    }

    double uniform() { return random_.uniform(); }

private:
    const World& world_;
    Random random_;
    Row low_, high_;
};

class Planner {
public:
    Planner(World& world, const double* start, const double* goals, std::int32_t num_goals,
            std::uint64_t seed, double range, const Budget& budget)
        : world_(world), n_(world.num_joints()), start_(start), goals_(goals),
          num_goals_(num_goals), sampler_(world, start, goals, num_goals, seed), range_(range),
          budget_(budget) {}

    Found run() {
        world_.postures = 0;
        if (ends_free()) {
            connect();
            if (found_.outcome == Outcome::kFound) shorten();
        }
        return found_;
    }

private:
    bool within(const double* q) const {
        for (int j = 0; j < n_; ++j) {
            const Joint& joint = world_.joints[static_cast<std::size_t>(j)];
            if (!(q[j] >= joint.lower && q[j] <= joint.upper)) return false;
        }
        return true;
    }

    bool spent() const {
        return world_.postures >= budget_.postures ||
               static_cast<std::int64_t>(trees_[0].parents.size() + trees_[1].parents.size()) >=
                   budget_.nodes;
    }

    // Start and the goals that can be used become the roots.
    bool ends_free() {
        if (!within(start_)) {
            found_.outcome = Outcome::kOutsideLimits;
            return false;
        }
        found_.pair = world_.touching(start_);
        if (found_.pair >= 0) {
            found_.outcome = Outcome::kStartTouches;
            return false;
        }
        trees_[0].add(start_, n_, -1);
        for (std::int32_t g = 0; g < num_goals_; ++g) {
            const double* goal = goals_ + static_cast<std::ptrdiff_t>(g) * n_;
            if (!within(goal)) {
                found_.outcome = Outcome::kOutsideLimits;
                continue;
            }
            const std::int32_t pair = world_.touching(goal);
            if (pair >= 0) {
                found_.outcome = Outcome::kGoalTouches;
                found_.pair = pair;
                continue;
            }
            trees_[1].add(goal, n_, -1);
        }
        if (trees_[1].parents.empty()) return false;
        found_.outcome = Outcome::kBudget;
        found_.pair = -1;
        return true;
    }

    bool free(const double* from, const double* to) {
        return world_.blocked(from, to) < 0;
    }

    void connect() {
        // The goals are still all that the second tree has.
        for (std::size_t root = 0; root < trees_[1].parents.size(); ++root)
            if (free(start_, trees_[1].row(static_cast<std::int32_t>(root), n_))) {
                finish(0, static_cast<std::int32_t>(root));
                return;
            }
        Row drawn(static_cast<std::size_t>(n_)), step(static_cast<std::size_t>(n_));
        for (std::int64_t round = 0; !spent(); ++round) {
            const int own = static_cast<int>(round & 1);
            sampler_.draw(round, drawn.data());
            const std::int32_t from = trees_[own].nearest(drawn.data(), n_);
            if (!towards(own, from, drawn.data(), step.data())) continue;
            const auto added = static_cast<std::int32_t>(trees_[own].parents.size() - 1);
            const std::int32_t met = follow(1 - own, trees_[own].row(added, n_));
            if (met < 0) continue;
            if (own == 0) finish(added, met);
            else finish(met, added);
            return;
        }
    }

    // One step from a node towards a posture; whether it was free and became a node.
    bool towards(int tree, std::int32_t from, const double* to, double* step) {
        const double* base = trees_[tree].row(from, n_);
        const double away = distance(base, to, n_);
        if (!(away > 0.0)) return false;
        const double share = std::min(1.0, range_ / away);
        for (int j = 0; j < n_; ++j) step[j] = share < 1.0 ? base[j] + share * (to[j] - base[j]) : to[j];
        if (!free(base, step)) return false;
        trees_[tree].add(step, n_, from);
        return true;
    }

    // Steps of the other tree until it meets a posture; its node there, or -1.
    std::int32_t follow(int tree, const double* there) {
        const Row goal(there, there + n_);
        Row step(goal.size());
        std::int32_t from = trees_[tree].nearest(goal.data(), n_);
        while (!spent()) {
            if (!towards(tree, from, goal.data(), step.data())) return -1;
            from = static_cast<std::int32_t>(trees_[tree].parents.size() - 1);
            if (distance(trees_[tree].row(from, n_), goal.data(), n_) == 0.0) return from;
        }
        return -1;
    }

    void finish(std::int32_t first, std::int32_t second) {
        std::vector<const double*> rows;
        for (std::int32_t i = first; i >= 0; i = trees_[0].parents[static_cast<std::size_t>(i)])
            rows.push_back(trees_[0].row(i, n_));
        std::reverse(rows.begin(), rows.end());
        for (std::int32_t i = second; i >= 0; i = trees_[1].parents[static_cast<std::size_t>(i)]) {
            const double* row = trees_[1].row(i, n_);
            if (rows.empty() || distance(rows.back(), row, n_) > 0.0) rows.push_back(row);
        }
        found_.outcome = Outcome::kFound;
        for (const double* row : rows) found_.path.insert(found_.path.end(), row, row + n_);
    }

    std::size_t count() const { return found_.path.size() / static_cast<std::size_t>(n_); }
    double* at(std::size_t index) { return found_.path.data() + index * static_cast<std::size_t>(n_); }

    // Leave knots out from the far end, then join points drawn evenly along the way.
    void shorten() {
        for (std::size_t first = 0; first + 2 < count(); ++first)
            for (std::size_t last = count() - 1; last > first + 1; --last)
                if (free(at(first), at(last))) {
                    erase(first + 1, last);
                    break;
                }
        constexpr std::int64_t kInVain = 12;
        std::int64_t in_vain = 0;
        for (std::int64_t k = 0; k < budget_.shortcuts && count() > 2 && in_vain < kInVain; ++k) {
            if (world_.postures >= budget_.postures) return;
            in_vain = cut() ? 0 : in_vain + 1;
        }
    }

    void erase(std::size_t from, std::size_t to) {
        found_.path.erase(found_.path.begin() + static_cast<std::ptrdiff_t>(from) * n_,
                          found_.path.begin() + static_cast<std::ptrdiff_t>(to) * n_);
    }

    // Whether joining two drawn points made the way noticeably shorter.
    bool cut() {
        constexpr double kWorth = 1e-3;
        std::vector<double> lengths(1, 0.0);
        for (std::size_t i = 0; i + 1 < count(); ++i)
            lengths.push_back(lengths.back() + distance(at(i), at(i + 1), n_));
        double s = sampler_.uniform() * lengths.back(), e = sampler_.uniform() * lengths.back();
        if (s > e) std::swap(s, e);
        const std::size_t a = segment(lengths, s), b = segment(lengths, e);
        if (a == b) return false;
        Row from(static_cast<std::size_t>(n_)), to(from);
        point(lengths, a, s, from.data());
        point(lengths, b, e, to.data());
        const double saved = e - s - distance(from.data(), to.data(), n_);
        if (saved < kWorth * lengths.back() || !free(from.data(), to.data())) return false;
        erase(a + 1, b + 1);
        from.insert(from.end(), to.begin(), to.end());
        found_.path.insert(found_.path.begin() + static_cast<std::ptrdiff_t>(a + 1) * n_,
                           from.begin(), from.end());
        drop_repeated();
        return saved > 10 * kWorth * lengths.back();
    }

    static std::size_t segment(const std::vector<double>& lengths, double s) {
        const auto after = std::upper_bound(lengths.begin() + 1, lengths.end() - 1, s);
        return static_cast<std::size_t>(after - lengths.begin()) - 1;
    }

    void point(const std::vector<double>& lengths, std::size_t index, double s, double* row) {
        const double whole = lengths[index + 1] - lengths[index];
        const double share = whole > 0.0 ? (s - lengths[index]) / whole : 0.0;
        for (int j = 0; j < n_; ++j) row[j] = at(index)[j] + share * (at(index + 1)[j] - at(index)[j]);
    }

    void drop_repeated() {
        constexpr double kSame = 1e-9;
        for (std::size_t i = 0; i + 1 < count();)
            if (distance(at(i), at(i + 1), n_) < kSame && count() > 2)
                erase(i + 1 == count() - 1 ? i : i + 1, i + 1 == count() - 1 ? i + 1 : i + 2);
            else
                ++i;
    }

    World& world_;
    int n_;
    const double* start_;
    const double* goals_;
    std::int32_t num_goals_;
    Sampler sampler_;
    double range_;
    Budget budget_;
    Tree trees_[2];
    Found found_;
};

}  // namespace

Found search(World& world, const double* start, const double* goals, std::int32_t num_goals,
             std::uint64_t seed, double range, const Budget& budget) {
    world.forget();
    return Planner(world, start, goals, num_goals, seed, range, budget).run();
}
