// The Python face: NumPy buffers in and out, the interpreter lock released while computing.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/tuple.h>

#include <algorithm>
#include <cmath>
#include <memory>
#include <string>
#include <tuple>

#ifdef _OPENMP
#include <omp.h>
#endif

#include "rasteriser.hpp"
#include "similarity.hpp"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

using Table3 = nb::ndarray<const float, nb::shape<-1, 3>, nb::c_contig, nb::device::cpu>;
using Table4 = nb::ndarray<const float, nb::shape<-1, 4>, nb::c_contig, nb::device::cpu>;
using Column = nb::ndarray<const float, nb::shape<-1>, nb::c_contig, nb::device::cpu>;
using Planes = nb::ndarray<const float, nb::shape<5, -1, -1>, nb::c_contig, nb::device::cpu>;
using Image = nb::ndarray<const float, nb::shape<3, -1, -1>, nb::c_contig, nb::device::cpu>;
using Pose = nb::ndarray<const float, nb::shape<3, 4>, nb::c_contig, nb::device::cpu>;
using Values = nb::ndarray<float, nb::c_contig, nb::device::cpu>;
using Intrinsics = std::tuple<int, int, float, float, float, float>;

nb::ndarray<nb::numpy, float> new_array(std::initializer_list<std::size_t> shape) {
    std::size_t size = 1;
    for (const std::size_t extent : shape) size *= extent;
    std::unique_ptr<float[]> data(new float[size]);
    nb::capsule owner(data.get(), [](void* pointer) noexcept {
        delete[] static_cast<float*>(pointer);
    });
    return nb::ndarray<nb::numpy, float>(data.release(), shape, owner);
}

int thread_count(int wanted) {
#ifdef _OPENMP
    return wanted > 0 ? wanted : omp_get_max_threads();
#else
    return 1;
#endif
}

const splat::Kernels& choose(const std::string& isa) {
    const splat::Kernels* kernels = splat::kernels_named(isa.c_str());
    if (kernels == nullptr)
        throw nb::value_error("unknown instruction set, or not on this processor: use 'auto', "
                              "'base' or 'v3'");
    return *kernels;
}

class PyRasteriser {
  public:
    PyRasteriser(int threads, const std::string& isa)
        : kernels_(choose(isa)), rasteriser_(kernels_, thread_count(threads)) {}

    nb::ndarray<nb::numpy, float> draw(Table3 means, Table4 quats, Table3 scales_log,
                                       Column opacities, Table3 colors, Pose T_camera_world,
                                       Intrinsics intrinsics, float alpha_cut,
                                       float transmittance_stop) {
        const std::size_t n = means.shape(0);
        if (quats.shape(0) != n || scales_log.shape(0) != n || opacities.shape(0) != n ||
            colors.shape(0) != n)
            throw nb::value_error("all five tables need one row per Gaussian");
        splat::Camera camera;
        std::tie(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy) =
            intrinsics;
        if (camera.width < 1 || camera.height < 1 ||
            static_cast<double>(camera.width) * camera.height > 1e8)
            throw nb::value_error("the image needs 1 to 100 million pixels");
        if (!(alpha_cut > 0) || !(transmittance_stop >= 0))
            throw nb::value_error("alpha_cut must be positive, transmittance_stop not negative");
        for (int i = 0; i < 3; ++i) {
            for (int k = 0; k < 3; ++k) camera.R[3 * i + k] = T_camera_world(i, k);
            camera.t[i] = T_camera_world(i, 3);
        }
        means_ = means, quats_ = quats, scales_log_ = scales_log;
        opacities_ = opacities, colors_ = colors;
        auto planes = new_array({splat::kPlanes, static_cast<std::size_t>(camera.height),
                                 static_cast<std::size_t>(camera.width)});
        const splat::Splats in = splats();
        {
            nb::gil_scoped_release unlocked;
            rasteriser_.draw(in, static_cast<int>(n), camera, {alpha_cut, transmittance_stop},
                             planes.data());
        }
        return planes;
    }

    nb::tuple pull(Planes planes, Planes plane_gradients) {
        const std::size_t height = rasteriser_.camera().height;
        const std::size_t width = rasteriser_.camera().width;
        if (planes.shape(1) != height || planes.shape(2) != width ||
            plane_gradients.shape(1) != height || plane_gradients.shape(2) != width)
            throw nb::value_error("the planes are not those of the last draw");
        const std::size_t n = rasteriser_.count();
        auto means = new_array({n, 3}), quats = new_array({n, 4}), scales = new_array({n, 3});
        auto opacities = new_array({n}), colors = new_array({n, 3});
        const splat::Splats in = splats();
        {
            nb::gil_scoped_release unlocked;
            rasteriser_.pull(in, planes.data(), plane_gradients.data(),
                             {means.data(), quats.data(), scales.data(), opacities.data(),
                              colors.data()});
        }
        return nb::make_tuple(means, quats, scales, opacities, colors);
    }

    nb::ndarray<nb::numpy, bool> visible() const {
        const std::size_t n = rasteriser_.count();
        std::unique_ptr<bool[]> data(new bool[n]);
        for (std::size_t i = 0; i < n; ++i) data[i] = rasteriser_.visible(static_cast<int>(i));
        nb::capsule owner(data.get(),
                          [](void* pointer) noexcept { delete[] static_cast<bool*>(pointer); });
        return nb::ndarray<nb::numpy, bool>(data.release(), {n}, owner);
    }

    std::int64_t num_pairs() const { return rasteriser_.num_pairs(); }
    std::string isa() const { return kernels_.name; }

  private:
    splat::Splats splats() const {
        return {means_.data(), quats_.data(), scales_log_.data(), opacities_.data(),
                colors_.data()};
    }

    const splat::Kernels& kernels_;
    splat::Rasteriser rasteriser_;
    // Held so that the backward pass reads the same memory as the forward pass.
    Table3 means_, scales_log_, colors_;
    Table4 quats_;
    Column opacities_;
};

class PySimilarity {
  public:
    PySimilarity(int threads, const std::string& isa)
        : similarity_(choose(isa), thread_count(threads)) {}

    nb::tuple mean(Image rendered, Image target) {
        const std::size_t height = rendered.shape(1), width = rendered.shape(2);
        if (target.shape(1) != height || target.shape(2) != width)
            throw nb::value_error("the two images differ in size");
        auto gradient = new_array({3, height, width});
        double value;
        {
            nb::gil_scoped_release unlocked;
            value = similarity_.mean(rendered.data(), target.data(), gradient.data(),
                                     static_cast<int>(width), static_cast<int>(height));
        }
        return nb::make_tuple(value, gradient);
    }

  private:
    splat::Similarity similarity_;
};

void adam_step(Values values, nb::ndarray<const float, nb::c_contig, nb::device::cpu> gradients,
               Values first, Values second, int step, float rate, float beta1, float beta2,
               float epsilon, int threads) {
    const std::int64_t size = static_cast<std::int64_t>(values.size());
    if (gradients.size() != values.size() || first.size() != values.size() ||
        second.size() != values.size() || step < 1)
        throw nb::value_error("adam needs four arrays of one size, and steps counted from 1");
    const splat::Kernels& kernels = choose("auto");
    const splat::AdamRates rates{rate, beta1, beta2, epsilon,
                                 static_cast<float>(1 - std::pow(double(beta1), step)),
                                 static_cast<float>(1 - std::pow(double(beta2), step))};
    float *v = values.data(), *m = first.data(), *s = second.data();
    const float* g = gradients.data();
    nb::gil_scoped_release unlocked;
    constexpr std::int64_t kBlock = 1 << 14;
#pragma omp parallel for schedule(static) num_threads(thread_count(threads))
    for (std::int64_t at = 0; at < size; at += kBlock)
        kernels.adam(v + at, g + at, m + at, s + at, rates,
                     static_cast<int>(std::min(kBlock, size - at)));
}

}  // namespace

NB_MODULE(_splat, module) {
    module.doc() = "Gaussian splat rasteriser with gradients, for the CPU.";
    nb::class_<PyRasteriser>(module, "Rasteriser")
        .def(nb::init<int, const std::string&>(), "threads"_a = 0, "isa"_a = "auto")
        .def("draw", &PyRasteriser::draw, "means"_a.noconvert(), "quats_wxyz"_a.noconvert(),
             "scales_log"_a.noconvert(), "opacities_logit"_a.noconvert(),
             "colors"_a.noconvert(), "T_camera_world"_a.noconvert(), "intrinsics"_a,
             "alpha_cut"_a, "transmittance_stop"_a)
        .def("pull", &PyRasteriser::pull, "planes"_a.noconvert(), "plane_gradients"_a.noconvert())
        .def("visible", &PyRasteriser::visible)
        .def_prop_ro("num_pairs", &PyRasteriser::num_pairs)
        .def_prop_ro("isa", &PyRasteriser::isa);
    nb::class_<PySimilarity>(module, "Similarity")
        .def(nb::init<int, const std::string&>(), "threads"_a = 0, "isa"_a = "auto")
        .def("mean", &PySimilarity::mean, "rendered"_a.noconvert(), "target"_a.noconvert());
    module.def("adam_step", &adam_step, "values"_a.noconvert(), "gradients"_a.noconvert(),
               "first"_a.noconvert(), "second"_a.noconvert(), "step"_a, "rate"_a,
               "beta1"_a = 0.9f, "beta2"_a = 0.999f, "epsilon"_a = 1e-15f, "threads"_a = 0);
}
