// The Python face: NumPy buffers in and out, the interpreter lock released while computing.
#include "python.hpp"

#include <nanobind/stl/optional.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <optional>
#include <vector>

#include "similarity.hpp"
#include "threads.hpp"

using namespace nb::literals;

namespace splat {

namespace {

class PyRasteriser {
  public:
    PyRasteriser(int threads, const std::string& isa)
        : kernels_(choose(isa)), rasteriser_(kernels_, thread_count(threads)) {}

    NewArray<float> draw(const Table3& means, const Table4& quats, const Table3& scales_log,
                         const Column& opacities, const Table3& colors, const Pose& T_camera_world,
                         const Intrinsics& intrinsics, float alpha_cut, float transmittance_stop,
                         const std::optional<Harmonics>& harmonics) {
        const std::size_t n = means.shape(0);
        check_tables(n, quats, scales_log, opacities, colors, harmonics);
        num_harmonics_ = harmonics ? checked_harmonics(harmonics->shape(1)) : 0;
        const Camera camera = make_camera(T_camera_world, intrinsics);
        const Settings settings = make_settings(alpha_cut, transmittance_stop);
        means_ = means, quats_ = quats, scales_log_ = scales_log;
        opacities_ = opacities, colors_ = colors, harmonics_ = harmonics;
        auto planes = new_array<float>({kPlanes, height(camera), width(camera)});
        const Splats in = splats();
        {
            nb::gil_scoped_release unlocked;
            rasteriser_.draw(in, static_cast<int>(n), camera, settings, planes.data());
        }
        return planes;
    }

    NewArray<float> draw_over(const Table3& means, const Table4& quats, const Table3& scales_log,
                              const Column& opacities, const Table3& colors, const Planes& under,
                              const std::optional<Buffer<bool, nb::shape<-1>>>& hidden,
                              const std::optional<Harmonics>& harmonics) {
        const std::size_t n = means.shape(0);
        check_tables(n, quats, scales_log, opacities, colors, harmonics);
        check_size(under.shape(1), under.shape(2));
        if (hidden) check_rows(hidden->shape(0));
        const Splats in{means.data(),  quats.data(),
                        scales_log.data(), opacities.data(),
                        colors.data(), harmonics ? harmonics->data() : nullptr,
                        harmonics ? checked_harmonics(harmonics->shape(1)) : 0};
        auto planes = new_array<float>({kPlanes, under.shape(1), under.shape(2)});
        {
            nb::gil_scoped_release unlocked;
            rasteriser_.draw_over(in, static_cast<int>(n), hidden ? hidden->data() : nullptr,
                                  under.data(), planes.data());
        }
        return planes;
    }

    nb::tuple pull(const Planes& planes, const Planes& plane_gradients) {
        check_size(planes.shape(1), planes.shape(2));
        check_size(plane_gradients.shape(1), plane_gradients.shape(2));
        const std::size_t n = rasteriser_.count();
        auto means = new_array<float>({n, 3}), quats = new_array<float>({n, 4});
        auto scales = new_array<float>({n, 3}), opacities = new_array<float>({n});
        auto colors = new_array<float>({n, 3});
        auto harmonics = new_array<float>({n, static_cast<std::size_t>(num_harmonics_), 3});
        auto pose = new_array<double>({3, 4});
        const Splats in = splats();
        const SplatGradients out{means.data(),     quats.data(),  scales.data(),
                                 opacities.data(), colors.data(), harmonics_ ? harmonics.data()
                                                                             : nullptr};
        {
            nb::gil_scoped_release unlocked;
            rasteriser_.pull(in, planes.data(), plane_gradients.data(), out, pose.data());
        }
        return nb::make_tuple(means, quats, scales, opacities, colors, harmonics, pose);
    }

    NewArray<float> draw_features(const Buffer<float, nb::shape<-1, -1>>& features) {
        check_rows(features.shape(0));
        const Camera& camera = rasteriser_.camera();
        auto planes = new_array<float>({features.shape(1), height(camera), width(camera)});
        {
            nb::gil_scoped_release unlocked;
            rasteriser_.draw_features(features.data(), static_cast<int>(features.shape(1)),
                                      planes.data());
        }
        return planes;
    }

    NewArray<float> lift(const AnyPlanes& planes) {
        check_size(planes.shape(1), planes.shape(2));
        const std::size_t n = rasteriser_.count();
        auto features = new_array<float>({n, planes.shape(0)});
        {
            nb::gil_scoped_release unlocked;
            rasteriser_.lift(planes.data(), static_cast<int>(planes.shape(0)), features.data());
        }
        return features;
    }

    NewArray<float> surface_depth() {
        const Camera& camera = rasteriser_.camera();
        auto plane = new_array<float>({height(camera), width(camera)});
        {
            nb::gil_scoped_release unlocked;
            rasteriser_.surface_depth(plane.data());
        }
        return plane;
    }

    nb::tuple label_map(const Buffer<std::uint16_t, nb::shape<-1>>& labels) {
        check_rows(labels.shape(0));
        const Camera& camera = rasteriser_.camera();
        auto ids = new_array<std::uint16_t>({height(camera), width(camera)});
        auto weights = new_array<float>({height(camera), width(camera)});
        {
            nb::gil_scoped_release unlocked;
            rasteriser_.label_map(labels.data(), ids.data(), weights.data());
        }
        return nb::make_tuple(ids, weights);
    }

    NewArray<bool> visible() const {
        const std::size_t n = rasteriser_.count();
        auto mask = new_array<bool>({n});
        for (std::size_t i = 0; i < n; ++i)
            mask.data()[i] = rasteriser_.visible(static_cast<int>(i));
        return mask;
    }

    std::int64_t num_pairs() const { return rasteriser_.num_pairs(); }
    std::string isa() const { return kernels_.name; }

  private:
    static std::size_t width(const Camera& camera) { return camera.width; }
    static std::size_t height(const Camera& camera) { return camera.height; }

    static void check_tables(std::size_t n, const Table4& quats, const Table3& scales_log,
                             const Column& opacities, const Table3& colors,
                             const std::optional<Harmonics>& harmonics) {
        if (quats.shape(0) != n || scales_log.shape(0) != n || opacities.shape(0) != n ||
            colors.shape(0) != n || (harmonics && harmonics->shape(0) != n))
            throw nb::value_error("all tables need one row per Gaussian");
    }

    void check_size(std::size_t rows, std::size_t columns) const {
        if (rows != height(rasteriser_.camera()) || columns != width(rasteriser_.camera()))
            throw nb::value_error("the planes are not those of the last draw");
    }

    void check_rows(std::size_t rows) const {
        if (rows != static_cast<std::size_t>(rasteriser_.count()) || rasteriser_.camera().width < 1)
            throw nb::value_error("these need one row per Gaussian of the last draw");
    }

    Splats splats() const {
        return {means_.data(),     quats_.data(),
                scales_log_.data(), opacities_.data(),
                colors_.data(),    harmonics_ ? harmonics_->data() : nullptr,
                num_harmonics_};
    }

    const Kernels& kernels_;
    Rasteriser rasteriser_;
    // Held so that the backward pass reads the same memory as the forward pass.
    Table3 means_, scales_log_, colors_;
    Table4 quats_;
    Column opacities_;
    std::optional<Harmonics> harmonics_;
    int num_harmonics_ = 0;
};

class PySimilarity {
  public:
    PySimilarity(int threads, const std::string& isa)
        : similarity_(choose(isa), thread_count(threads)) {}

    nb::tuple mean(const Image& rendered, const Image& target) {
        const std::size_t height = rendered.shape(1), width = rendered.shape(2);
        if (target.shape(1) != height || target.shape(2) != width)
            throw nb::value_error("the two images differ in size");
        auto gradient = new_array<float>({3, height, width});
        double value;
        {
            nb::gil_scoped_release unlocked;
            value = similarity_.mean(rendered.data(), target.data(), gradient.data(),
                                     static_cast<int>(width), static_cast<int>(height));
        }
        return nb::make_tuple(value, gradient);
    }

  private:
    Similarity similarity_;
};

void adam_step(const Values& values,
               const nb::ndarray<const float, nb::c_contig, nb::device::cpu>& gradients,
               const Values& first, const Values& second, int step, float rate, float beta1,
               float beta2, float epsilon, [[maybe_unused]] int threads) {
    const std::int64_t size = static_cast<std::int64_t>(values.size());
    if (gradients.size() != values.size() || first.size() != values.size() ||
        second.size() != values.size() || step < 1)
        throw nb::value_error("adam needs four arrays of one size, and steps counted from 1");
    const Kernels& kernels = choose("auto");
    const AdamRates rates{rate, beta1, beta2, epsilon,
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

std::vector<std::string> available_isas() {
    std::vector<std::string> names;
    for (const char* name : {"base", "v3", "v4"})
        if (kernels_named(name) != nullptr) names.emplace_back(name);
    return names;
}

}  // namespace

}  // namespace splat

NB_MODULE(_splat, module) {
    using namespace splat;
    module.doc() = "Gaussian splat rasteriser with gradients, for the CPU.";
    nb::class_<PyRasteriser>(module, "Rasteriser")
        .def(nb::init<int, const std::string&>(), "threads"_a = 0, "isa"_a = "auto")
        .def("draw", &PyRasteriser::draw, "means"_a.noconvert(), "quats_wxyz"_a.noconvert(),
             "scales_log"_a.noconvert(), "opacities_logit"_a.noconvert(),
             "colors"_a.noconvert(), "T_camera_world"_a.noconvert(), "intrinsics"_a,
             "alpha_cut"_a, "transmittance_stop"_a, "harmonics"_a.noconvert().none() = nb::none())
        .def("draw_over", &PyRasteriser::draw_over, "means"_a.noconvert(),
             "quats_wxyz"_a.noconvert(), "scales_log"_a.noconvert(),
             "opacities_logit"_a.noconvert(), "colors"_a.noconvert(), "under"_a.noconvert(),
             "hidden"_a.noconvert().none() = nb::none(),
             "harmonics"_a.noconvert().none() = nb::none())
        .def("pull", &PyRasteriser::pull, "planes"_a.noconvert(), "plane_gradients"_a.noconvert())
        .def("draw_features", &PyRasteriser::draw_features, "features"_a.noconvert())
        .def("lift", &PyRasteriser::lift, "planes"_a.noconvert())
        .def("label_map", &PyRasteriser::label_map, "labels"_a.noconvert())
        .def("surface_depth", &PyRasteriser::surface_depth)
        .def("visible", &PyRasteriser::visible)
        .def_prop_ro("num_pairs", &PyRasteriser::num_pairs)
        .def_prop_ro("isa", &PyRasteriser::isa);
    nb::class_<PySimilarity>(module, "Similarity")
        .def(nb::init<int, const std::string&>(), "threads"_a = 0, "isa"_a = "auto")
        .def("mean", &PySimilarity::mean, "rendered"_a.noconvert(), "target"_a.noconvert());
    module.def("adam_step", &adam_step, "values"_a.noconvert(), "gradients"_a.noconvert(),
               "first"_a.noconvert(), "second"_a.noconvert(), "step"_a, "rate"_a,
               "beta1"_a = 0.9f, "beta2"_a = 0.999f, "epsilon"_a = 1e-15f, "threads"_a = 0);
    module.def("available_isas", &available_isas);
    add_session(module);
}
