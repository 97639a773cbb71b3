// Vectors, rotations and rigid pieces with flat faces.
#pragma once

#include <array>
#include <cmath>
#include <vector>

namespace soft {

template <class T>
struct Vec {
    T x, y, z;
};
using Float3 = Vec<float>;
using Double3 = Vec<double>;

template <class T>
Vec<T> operator+(const Vec<T>& a, const Vec<T>& b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
template <class T>
Vec<T> operator-(const Vec<T>& a, const Vec<T>& b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
template <class T>
Vec<T> operator*(const Vec<T>& a, T s) { return {a.x * s, a.y * s, a.z * s}; }
template <class T>
T dot(const Vec<T>& a, const Vec<T>& b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
template <class T>
Vec<T> cross(const Vec<T>& a, const Vec<T>& b) {
    return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}
template <class T>
T norm(const Vec<T>& a) { return std::sqrt(dot(a, a)); }

inline Float3 narrow(const Double3& a) {
    return {static_cast<float>(a.x), static_cast<float>(a.y), static_cast<float>(a.z)};
}
inline Double3 widen(const Float3& a) { return {a.x, a.y, a.z}; }

struct Matrix {
    double m[3][3];
};

struct Rotation {
    double m[9];  // row by row

    Double3 apply(const Double3& v) const {
        return {m[0] * v.x + m[1] * v.y + m[2] * v.z, m[3] * v.x + m[4] * v.y + m[5] * v.z,
                m[6] * v.x + m[7] * v.y + m[8] * v.z};
    }
    Double3 back(const Double3& v) const {
        return {m[0] * v.x + m[3] * v.y + m[6] * v.z, m[1] * v.x + m[4] * v.y + m[7] * v.z,
                m[2] * v.x + m[5] * v.y + m[8] * v.z};
    }
};

struct Pose {
    Double3 p;
    std::array<double, 4> q;  // x, y, z, w as PyBullet has them
};

inline Rotation rotation_of(const std::array<double, 4>& q) {
    const double n = std::sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
    const double x = q[0] / n, y = q[1] / n, z = q[2] / n, w = q[3] / n;
    return {{1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
             2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
             2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)}};
}

// Between two poses of one step; turns are small, so the chord stands for the arc.
inline Pose between(const Pose& a, const Pose& b, double share) {
    double sign = 0.0;
    for (int k = 0; k < 4; ++k) sign += a.q[k] * b.q[k];
    sign = sign < 0.0 ? -1.0 : 1.0;
    Pose pose{a.p + (b.p - a.p) * share, {}};
    for (int k = 0; k < 4; ++k) pose.q[k] = (1.0 - share) * a.q[k] + share * sign * b.q[k];
    return pose;
}

struct Plane {
    Float3 n;  // outward
    float d;   // n . p - d is the distance
};

}  // namespace soft
