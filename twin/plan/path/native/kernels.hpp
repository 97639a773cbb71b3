// The inner loops, once per instruction set. In float: callers take off what rounding may add.
// The same bits whatever the set is: nothing is contracted, and a minimum has no order.
#pragma once

struct Spheres {
    const float *x, *y, *z, *r;
    int count;
    // A multiple of kLanes; what fills up is far smaller than a point.
};

constexpr int kLanes = 16;

struct Kernels {
    // Spheres of a body in the base frame, R row by row.
    void (*place)(const float* R, const float* t, const Spheres& own, float* x, float* y, float* z);
    // Least distance of spheres to a box: its pose and half extents.
    float (*to_box)(const Spheres& spheres, const float* R, const float* t, const float* half);
    // Least height of spheres.
    float (*to_ground)(const Spheres& spheres);
    // Least distance between two sets of spheres.
    float (*between)(const Spheres& one, const Spheres& other);
    // Which point lies farthest along a direction.
    int (*farthest)(const float* x, const float* y, const float* z, int count, const float* d);
};

const Kernels& kernels();
