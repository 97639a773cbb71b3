// Draws a cloud from a file and pulls ones back, without Python: for processors that we emulate.
#include <cstdint>
#include <cstdio>
#include <vector>

#include "rasteriser.hpp"

namespace {

std::vector<float> read_floats(std::FILE* file, std::size_t count) {
    std::vector<float> values(count);
    if (std::fread(values.data(), sizeof(float), count, file) != count) values.clear();
    return values;
}

}  // namespace

int main(int, char** arguments) {
    std::FILE* in = std::fopen(arguments[1], "rb");
    std::int32_t sizes[3];
    if (in == nullptr || std::fread(sizes, sizeof(std::int32_t), 3, in) != 3) return 1;
    const std::size_t n = sizes[0], pixels = static_cast<std::size_t>(sizes[1]) * sizes[2];
    const auto lens = read_floats(in, 4), pose = read_floats(in, 12);
    const auto means = read_floats(in, 3 * n), quats = read_floats(in, 4 * n);
    const auto scales = read_floats(in, 3 * n), opacities = read_floats(in, n);
    const auto colors = read_floats(in, 3 * n), harmonics = read_floats(in, 9 * n);
    std::fclose(in);

    splat::Camera camera{};
    camera.width = sizes[1], camera.height = sizes[2];
    camera.fx = lens[0], camera.fy = lens[1], camera.cx = lens[2], camera.cy = lens[3];
    for (int i = 0; i < 3; ++i) {
        for (int k = 0; k < 3; ++k) camera.R[3 * i + k] = pose[4 * i + k];
        camera.t[i] = pose[4 * i + 3];
    }
    for (int k = 0; k < 3; ++k)
        for (int i = 0; i < 3; ++i) camera.centre[k] -= camera.R[3 * i + k] * camera.t[i];

    const splat::Kernels* kernels = splat::kernels_named("auto");
    splat::Rasteriser rasteriser(*kernels, 1);
    const splat::Splats splats{means.data(),     quats.data(),  scales.data(),
                               opacities.data(), colors.data(), harmonics.data(), 3};
    std::vector<float> planes(5 * pixels), upstream(5 * pixels, 1.0f), gradients(23 * n);
    std::vector<float> features(n, 1.0f), drawn(pixels);
    rasteriser.draw(splats, static_cast<int>(n), camera, {1.0f / 255.0f, 1e-4f}, planes.data());
    float* g = gradients.data();
    double d_pose[12];
    rasteriser.pull(splats, planes.data(), upstream.data(),
                    {g, g + 3 * n, g + 7 * n, g + 10 * n, g + 11 * n, g + 14 * n}, d_pose);
    rasteriser.draw_features(features.data(), 1, drawn.data());

    std::FILE* out = std::fopen(arguments[2], "wb");
    std::fwrite(planes.data(), sizeof(float), planes.size(), out);
    std::fwrite(gradients.data(), sizeof(float), gradients.size(), out);
    std::fwrite(drawn.data(), sizeof(float), drawn.size(), out);
    std::fclose(out);
    std::printf("%s\n", kernels->name);
    return 0;
}
