// The Python face: buffers in, bytes or NumPy arrays out, the interpreter lock released meanwhile.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <memory>

#include "rvl.hpp"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

// Above bridge.media.color.MAX_PIXELS: a last guard, the caller has its own limit.
constexpr std::size_t kMaxPixels = std::size_t{1} << 28;

class Buffer {
  public:
    explicit Buffer(nb::handle object) {
        if (PyObject_GetBuffer(object.ptr(), &view_, PyBUF_SIMPLE) != 0) throw nb::python_error();
    }
    ~Buffer() { PyBuffer_Release(&view_); }
    Buffer(const Buffer&) = delete;
    Buffer& operator=(const Buffer&) = delete;

    const std::uint8_t* data() const { return static_cast<const std::uint8_t*>(view_.buf); }
    std::size_t size() const { return static_cast<std::size_t>(view_.len); }

  private:
    Py_buffer view_;
};

nb::bytes encode_rvl(nb::handle pixels) {
    const Buffer input(pixels);
    const std::size_t num_pixels = input.size() / 2;
    if (input.size() % 2 || num_pixels > kMaxPixels)
        throw nb::value_error("16-bit pixels are needed, at most 2**28 of them");
    std::unique_ptr<std::uint8_t[]> stream;
    std::size_t size = 0;
    {
        nb::gil_scoped_release released;
        stream.reset(new std::uint8_t[rvl::max_encoded_bytes(num_pixels)]);
        size = rvl::encode(input.data(), num_pixels, stream.get());
    }
    return nb::bytes(stream.get(), size);
}

nb::ndarray<nb::numpy, std::uint16_t> decode_rvl(nb::handle stream, std::size_t num_pixels) {
    const Buffer input(stream);
    if (num_pixels > kMaxPixels) throw nb::value_error("at most 2**28 pixels are decoded");
    std::unique_ptr<std::uint16_t[]> pixels;
    rvl::Result result;
    {
        nb::gil_scoped_release released;
        pixels.reset(new std::uint16_t[num_pixels]);
        result = rvl::decode(input.data(), input.size(), pixels.get(), num_pixels);
    }
    if (result == rvl::Result::ends_early)
        throw nb::value_error("the RVL stream does not hold the pixels its header claims");
    if (result == rvl::Result::out_of_range)
        throw nb::value_error("the RVL stream holds a value outside 16 bits");
    nb::capsule owner(pixels.get(), [](void* pointer) noexcept {
        delete[] static_cast<std::uint16_t*>(pointer);
    });
    return nb::ndarray<nb::numpy, std::uint16_t>(pixels.release(), {num_pixels}, owner);
}

}  // namespace

NB_MODULE(_depth, m) {
    m.doc() = "RVL depth coding; bridge/media/depth.py describes the stream.";
    m.def("encode_rvl", &encode_rvl, "pixels"_a,
          "Encode contiguous little-endian 16-bit pixels, given as bytes.");
    m.def("decode_rvl", &decode_rvl, "stream"_a, "num_pixels"_a,
          "Decode to 16-bit pixels; raises ValueError for a broken stream.");
}
