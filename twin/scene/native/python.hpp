// What the Python faces share: types of NumPy buffers, new arrays, the camera.
#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/tuple.h>

#include <cmath>
#include <initializer_list>
#include <memory>
#include <string>
#include <tuple>

#include "rasteriser.hpp"

namespace nb = nanobind;

namespace splat {

template <class Scalar, class Shape>
using Buffer = nb::ndarray<const Scalar, Shape, nb::c_contig, nb::device::cpu>;
using Table3 = Buffer<float, nb::shape<-1, 3>>;
using Table4 = Buffer<float, nb::shape<-1, 4>>;
using Harmonics = Buffer<float, nb::shape<-1, -1, 3>>;
using Column = Buffer<float, nb::shape<-1>>;
using Planes = Buffer<float, nb::shape<5, -1, -1>>;
using AnyPlanes = Buffer<float, nb::shape<-1, -1, -1>>;
using Image = Buffer<float, nb::shape<3, -1, -1>>;
using Pose = Buffer<float, nb::shape<3, 4>>;
using Values = nb::ndarray<float, nb::c_contig, nb::device::cpu>;
using Intrinsics = std::tuple<int, int, float, float, float, float>;

template <class Scalar>
using NewArray = nb::ndarray<nb::numpy, Scalar>;

template <class Scalar>
NewArray<Scalar> new_array(std::initializer_list<std::size_t> shape) {
    std::size_t size = 1;
    for (const std::size_t extent : shape) size *= extent;
    std::unique_ptr<Scalar[]> data(new Scalar[size]);
    nb::capsule owner(data.get(),
                      [](void* pointer) noexcept { delete[] static_cast<Scalar*>(pointer); });
    return NewArray<Scalar>(data.release(), shape, owner);
}

inline const Kernels& choose(const std::string& isa) {
    const Kernels* kernels = kernels_named(isa.c_str());
    if (kernels == nullptr)
        throw nb::value_error("unknown instruction set, or not on this processor: use 'auto', "
                              "'base', 'v3' or 'v4'");
    return *kernels;
}

inline Camera make_camera(const Pose& T_camera_world, const Intrinsics& intrinsics) {
    Camera camera{};
    std::tie(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy) = intrinsics;
    if (camera.width < 1 || camera.height < 1 ||
        static_cast<double>(camera.width) * camera.height > 1e8)
        throw nb::value_error("the image needs 1 to 100 million pixels");
    for (int i = 0; i < 3; ++i) {
        for (int k = 0; k < 3; ++k) camera.R[3 * i + k] = T_camera_world(i, k);
        camera.t[i] = T_camera_world(i, 3);
    }
    for (int k = 0; k < 3; ++k)
        camera.centre[k] = -(camera.R[k] * camera.t[0] + camera.R[3 + k] * camera.t[1] +
                             camera.R[6 + k] * camera.t[2]);
    return camera;
}

inline int checked_harmonics(std::size_t count) {
    if (count != kNumHarmonics) throw nb::value_error("a colour has 3 harmonics, or None");
    return static_cast<int>(count);
}

inline Settings make_settings(float alpha_cut, float transmittance_stop) {
    if (!(alpha_cut > 0) || !(transmittance_stop >= 0))
        throw nb::value_error("alpha_cut must be positive, transmittance_stop not negative");
    return {alpha_cut, transmittance_stop};
}

void add_session(nb::module_& module);

}  // namespace splat
