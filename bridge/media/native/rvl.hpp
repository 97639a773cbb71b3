// RVL depth coding, after Wilson, "Fast lossless depth image compression" (2017), in the layout
// of ROS. bridge/media/depth.py describes the stream.
#pragma once

#include <cstddef>
#include <cstdint>

namespace rvl {

// Room that `encode` may need for so many pixels [bytes].
std::size_t max_encoded_bytes(std::size_t num_pixels);

// Encodes little-endian 16-bit pixels at any address; returns the bytes written, a multiple of 4.
std::size_t encode(const std::uint8_t* pixels, std::size_t num_pixels, std::uint8_t* out);

enum class Result { ok, ends_early, out_of_range };

// Decodes whole 32-bit words; `pixels` is filled only when the result is `ok`.
Result decode(const std::uint8_t* stream, std::size_t num_bytes, std::uint16_t* pixels,
              std::size_t num_pixels);

}  // namespace rvl
