// Vectors, poses and random numbers of distances and of paths: plain doubles, no library.
#pragma once

#include <cmath>
#include <cstdint>

struct Vec {
    double x = 0.0, y = 0.0, z = 0.0;
};

inline Vec operator+(Vec a, Vec b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
inline Vec operator-(Vec a, Vec b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
inline Vec operator*(double s, Vec a) { return {s * a.x, s * a.y, s * a.z}; }
inline double dot(Vec a, Vec b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
inline Vec cross(Vec a, Vec b) {
    return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}
inline double norm(Vec a) { return std::sqrt(dot(a, a)); }

// A rotation, row by row, and a translation.
struct Pose {
    double R[9] = {1, 0, 0, 0, 1, 0, 0, 0, 1};
    Vec t;

    Vec turn(Vec p) const {
        return {R[0] * p.x + R[1] * p.y + R[2] * p.z, R[3] * p.x + R[4] * p.y + R[5] * p.z,
                R[6] * p.x + R[7] * p.y + R[8] * p.z};
    }
    Vec turn_back(Vec p) const {
        return {R[0] * p.x + R[3] * p.y + R[6] * p.z, R[1] * p.x + R[4] * p.y + R[7] * p.z,
                R[2] * p.x + R[5] * p.y + R[8] * p.z};
    }
    Vec apply(Vec p) const { return turn(p) + t; }
};

inline Pose operator*(const Pose& a, const Pose& b) {
    Pose c;
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j)
            c.R[3 * i + j] = a.R[3 * i] * b.R[j] + a.R[3 * i + 1] * b.R[3 + j] +
                             a.R[3 * i + 2] * b.R[6 + j];
    c.t = a.apply(b.t);
    return c;
}

// A rotation that takes the z axis to a unit vector.
inline Pose with_z_along(Vec axis) {
    const Vec aside = std::fabs(axis.x) < 0.7 ? Vec{1, 0, 0} : Vec{0, 1, 0};
    Vec x = aside - dot(aside, axis) * axis;
    x = (1.0 / norm(x)) * x;
    const Vec y = cross(axis, x);
    Pose pose;
    const double rows[9] = {x.x, y.x, axis.x, x.y, y.y, axis.y, x.z, y.z, axis.z};
    for (int i = 0; i < 9; ++i) pose.R[i] = rows[i];
    return pose;
}

// splitmix64 (Steele, Lea, Flood 2014): the same numbers from the same seed everywhere.
class Random {
public:
    explicit Random(std::uint64_t seed) : state_(seed) {}

    // Evenly from [0, 1).
    double uniform() { return static_cast<double>(next() >> 11) * 0x1.0p-53; }

private:
    std::uint64_t next() {
        std::uint64_t z = (state_ += 0x9e3779b97f4a7c15ULL);
        z = (z ^ (z >> 30)) * 0xbf58476d1ce4e5b9ULL;
        z = (z ^ (z >> 27)) * 0x94d049bb133111ebULL;
        return z ^ (z >> 31);
    }

    std::uint64_t state_;
};
