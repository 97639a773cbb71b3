// How far two convex bodies are apart (Gilbert, Johnson, Keerthi 1988), as far as anybody asks.
//
// Every direction that is tried gives a distance which the bodies surely keep, and every simplex
// one which they surely do not exceed. The search ends as soon as one of the two answers the
// question, most often with the direction that answered it last time.
#pragma once

#include <algorithm>
#include <limits>

#include "geometry.hpp"

struct Separation {
    double least = -std::numeric_limits<double>::infinity();
    // The distance is at least this; 0 or less says nothing of the depth.
    double most = std::numeric_limits<double>::infinity();
    // And at most this.
};

// Points of a difference of two bodies whose hull comes nearest to the origin.
class Simplex {
public:
    // Add a point and return the point of the hull that is nearest to the origin; the corners that
    // do not take part are dropped. All four are kept when they enclose the origin.
    Vec add(Vec point) {
        corners_[count_++] = point;
        if (count_ == 1) return corners_[0];
        if (count_ == 2) return segment(corners_[0], corners_[1]);
        if (count_ == 3) return triangle(corners_[0], corners_[1], corners_[2]);
        return tetrahedron();
    }
    int count() const { return count_; }

private:
    Vec keep(Vec nearest, std::initializer_list<Vec> corners) {
        count_ = 0;
        for (const Vec& corner : corners) corners_[count_++] = corner;
        return nearest;
    }

    Vec segment(Vec a, Vec b) {
        const Vec way = b - a;
        const double along = -dot(a, way), whole = dot(way, way);
        if (along <= 0.0 || whole <= 0.0) return keep(a, {a});
        if (along >= whole) return keep(b, {b});
        return keep(a + (along / whole) * way, {a, b});
    }

    // Voronoi regions of a triangle (Ericson, Real-Time Collision Detection, 5.1.5).
    Vec triangle(Vec a, Vec b, Vec c) {
        const Vec ab = b - a, ac = c - a;
        const double d1 = -dot(ab, a), d2 = -dot(ac, a);
        if (d1 <= 0.0 && d2 <= 0.0) return keep(a, {a});
        const double d3 = -dot(ab, b), d4 = -dot(ac, b);
        if (d3 >= 0.0 && d4 <= d3) return keep(b, {b});
        const double vc = d1 * d4 - d3 * d2;
        if (vc <= 0.0 && d1 >= 0.0 && d3 <= 0.0) return segment(a, b);
        const double d5 = -dot(ab, c), d6 = -dot(ac, c);
        if (d6 >= 0.0 && d5 <= d6) return keep(c, {c});
        const double vb = d5 * d2 - d1 * d6;
        if (vb <= 0.0 && d2 >= 0.0 && d6 <= 0.0) return segment(a, c);
        const double va = d3 * d6 - d5 * d4;
        if (va <= 0.0 && d4 - d3 >= 0.0 && d5 - d6 >= 0.0) return segment(b, c);
        const double sum = va + vb + vc;
        if (!(sum > 0.0)) return segment(a, b);  // no area
        return keep(a + (vb / sum) * ab + (vc / sum) * ac, {a, b, c});
    }

    Vec tetrahedron() {
        const Vec p[4] = {corners_[0], corners_[1], corners_[2], corners_[3]};
        const int faces[4][4] = {{0, 1, 2, 3}, {0, 1, 3, 2}, {0, 2, 3, 1}, {1, 2, 3, 0}};
        double best = std::numeric_limits<double>::infinity();
        Vec nearest;
        Simplex chosen;
        for (const auto& face : faces) {
            const Vec a = p[face[0]], b = p[face[1]], c = p[face[2]], inside = p[face[3]];
            const Vec normal = cross(b - a, c - a);
            // The origin and the fourth corner on the same side: this face does not divide them.
            if (dot(normal, inside - a) * dot(normal, Vec{} - a) > 0.0) continue;
            Simplex part;
            const Vec found = part.triangle(a, b, c);
            const double away = dot(found, found);
            if (away < best) {
                best = away;
                nearest = found;
                chosen = part;
            }
        }
        if (chosen.count_ == 0) return {};  // enclosed
        *this = chosen;
        return nearest;
    }

    Vec corners_[4];
    int count_ = 0;
};

// Search until the distance is known to be at least `enough`, below `too_little` or in between; with
// an infinite `enough` until it is known.
//
// `support(direction)` is the point of the difference (first body less second) that lies farthest
// along a direction. `guess` is the first direction that is tried, and returns the last one.
template <class Support>
Separation separation(const Support& support, double enough, double too_little, Vec& guess) {
    constexpr int kMost = 64;
    constexpr double kExact = 1e-9;
    Separation found;
    Simplex simplex;
    Vec v = dot(guess, guess) > 0.0 ? guess : Vec{1, 0, 0};
    for (int step = 0; step < kMost; ++step) {
        const double length = norm(v);
        if (!(length > 1e-12)) break;  // they touch
        const Vec w = support((-1.0 / length) * v);
        const double least = dot(v, w) / length;
        if (least > found.least) {
            found.least = least;
            guess = v;
        }
        if (found.least >= enough || found.most - found.least <= kExact) return found;
        v = simplex.add(w);
        if (simplex.count() == 4) {
            found.most = 0.0;
            return found;
        }
        const double most = norm(v);
        if (!(most < found.most)) return found;  // as near as the numbers allow
        found.most = most;
        if (found.most < too_little) return found;
        // Neither enough nor too little: nobody asks for more.
        if (found.most < enough && found.least >= too_little && std::isfinite(enough)) return found;
    }
    found.most = std::min(found.most, norm(v));
    return found;
}
