// The Python face of FitSession. Tables stay NumPy arrays of the caller and are changed in place.
#include "python.hpp"

#include <algorithm>
#include <cstring>
#include <vector>

#include "session.hpp"
#include "threads.hpp"

using namespace nb::literals;

namespace splat {

namespace {

using Bytes = Buffer<std::uint8_t, nb::shape<3, -1, -1>>;
using Depth = Buffer<float, nb::shape<-1, -1>>;
using Mask = Buffer<bool, nb::shape<-1, -1>>;
using Exposure = Buffer<float, nb::shape<3, 4>>;
using Loss = std::tuple<bool, float, float>;  // structural, share of L1, weight of depth
using Rates = std::tuple<float, float, float, float, float, float>;

constexpr std::size_t kColumns[Tables::kCount - 1] = {3, 4, 3, 1, 3};

// How many Gaussians the first of the tables holds.
std::size_t rows_of(const nb::tuple& arrays) {
    if (arrays.size() != Tables::kCount) throw nb::value_error("a cloud has six tables");
    const Values means = nb::cast<Values>(arrays[0], false);
    if (means.ndim() < 1) throw nb::value_error("all tables need one row per Gaussian");
    return means.shape(0);
}

// How many harmonics each colour of the last table has; 0 where it is None.
int num_harmonics_of(const nb::tuple& arrays) {
    const nb::handle last = arrays[Tables::kCount - 1];
    if (last.is_none()) return 0;
    const Values values = nb::cast<Values>(last, false);
    if (values.ndim() != 3) throw nb::value_error("harmonics are a table of three dimensions");
    return checked_harmonics(values.shape(1));
}

// Means, quaternions, log scales, opacities, colours and, or None, harmonics.
Tables tables_of(const nb::tuple& arrays, std::size_t count, int num_harmonics) {
    if (arrays.size() != Tables::kCount) throw nb::value_error("a cloud has six tables");
    Tables tables{};
    for (int i = 0; i < Tables::kCount; ++i) {
        const bool last = i == Tables::kCount - 1;
        if (last && arrays[i].is_none()) continue;
        const Values values = nb::cast<Values>(arrays[i], false);
        const std::size_t columns = last ? 3 * num_harmonics : kColumns[i];
        if (values.size() != count * columns)
            throw nb::value_error("all tables need one row per Gaussian");
        tables.table[i] = values.data();
    }
    return tables;
}

class PyFitSession {
  public:
    PyFitSession(int threads, const std::string& isa)
        : session_(choose(isa), thread_count(threads)) {}

    void use_threads(int threads) { session_.use_threads(thread_count(threads)); }

    nb::tuple step(const nb::tuple& values, const nb::tuple& first, const nb::tuple& second,
                   const Pose& T_camera_world, const Intrinsics& intrinsics, float alpha_cut,
                   float transmittance_stop, const Bytes& planes_u8, const Depth& depth_m,
                   const Mask& static_mask, const Exposure& exposure, const Loss& loss,
                   const Rates& rates, int step) {
        const Camera camera = make_camera(T_camera_world, intrinsics);
        const Settings settings = make_settings(alpha_cut, transmittance_stop);
        const std::size_t rows = camera.height, columns = camera.width;
        if (planes_u8.shape(1) != rows || planes_u8.shape(2) != columns ||
            depth_m.shape(0) != rows || depth_m.shape(1) != columns ||
            static_mask.shape(0) != rows || static_mask.shape(1) != columns || step < 1)
            throw nb::value_error("a step needs images of the camera's size, and counts from 1");
        const std::size_t count = rows_of(values);
        num_harmonics_ = num_harmonics_of(values);
        Learning learning{tables_of(values, count, num_harmonics_),
                          tables_of(first, count, num_harmonics_),
                          tables_of(second, count, num_harmonics_),
                          num_harmonics_,
                          {},
                          0.9f,
                          0.999f,
                          1e-15f,
                          step};
        std::tie(learning.rates[0], learning.rates[1], learning.rates[2], learning.rates[3],
                 learning.rates[4], learning.rates[5]) = rates;
        FitTarget target{planes_u8.data(), depth_m.data(),
                         reinterpret_cast<const std::uint8_t*>(static_mask.data()), {}};
        std::copy_n(exposure.data(), 12, target.exposure);
        const LossWeights weights{std::get<0>(loss), std::get<1>(loss), std::get<2>(loss)};
        count_ = count;
        StepResult result;
        {
            nb::gil_scoped_release unlocked;
            result = session_.step(static_cast<int>(count), camera, settings, target, weights,
                                   learning);
        }
        return answer(result);
    }

    // What the last step drew, five planes.
    NewArray<float> planes() const {
        const Camera& camera = session_.rasteriser().camera();
        auto planes = new_array<float>({kPlanes, static_cast<std::size_t>(camera.height),
                                        static_cast<std::size_t>(camera.width)});
        std::copy(session_.planes().begin(), session_.planes().end(), planes.data());
        return planes;
    }

    // The six gradients of the last step; harmonics may have no rows.
    nb::tuple gradients() const {
        const std::size_t harmonics = num_harmonics_;
        return nb::make_tuple(copy(0, {count_, 3}), copy(1, {count_, 4}), copy(2, {count_, 3}),
                              copy(3, {count_}), copy(4, {count_, 3}),
                              copy(5, {count_, harmonics, 3}));
    }

    NewArray<bool> visible() const {
        auto mask = new_array<bool>({count_});
        for (std::size_t i = 0; i < count_; ++i)
            mask.data()[i] = session_.rasteriser().visible(static_cast<int>(i));
        return mask;
    }

  private:
    static nb::tuple answer(const StepResult& result) {
        auto pose = new_array<double>({3, 4});
        std::memcpy(pose.data(), result.pose, sizeof result.pose);
        return nb::make_tuple(
            result.loss, result.squared, result.static_pixels,
            std::make_tuple(result.gain[0], result.gain[1], result.gain[2]), pose,
            std::make_tuple(result.draw_s, result.compare_s, result.pull_s, result.learn_s),
            result.serial_s);
    }

    NewArray<float> copy(int table, std::initializer_list<std::size_t> shape) const {
        auto rows = new_array<float>(shape);
        std::size_t size = 1;
        for (const std::size_t extent : shape) size *= extent;
        if (size > 0) std::memcpy(rows.data(), session_.gradient(table), size * sizeof(float));
        return rows;
    }

    FitSession session_;
    std::size_t count_ = 0;
    int num_harmonics_ = 0;
};

}  // namespace

void add_session(nb::module_& module) {
    nb::class_<PyFitSession>(module, "FitSession")
        .def(nb::init<int, const std::string&>(), "threads"_a = 0, "isa"_a = "auto")
        .def("step", &PyFitSession::step, "values"_a, "first"_a, "second"_a,
             "T_camera_world"_a.noconvert(), "intrinsics"_a, "alpha_cut"_a,
             "transmittance_stop"_a, "planes_u8"_a.noconvert(), "depth_m"_a.noconvert(),
             "static_mask"_a.noconvert(), "exposure"_a.noconvert(), "loss"_a, "rates"_a, "step"_a)
        .def("use_threads", &PyFitSession::use_threads, "threads"_a)
        .def("planes", &PyFitSession::planes)
        .def("gradients", &PyFitSession::gradients)
        .def("visible", &PyFitSession::visible);
}

}  // namespace splat
