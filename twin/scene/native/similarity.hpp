// Mean structural similarity of two colour images and its gradient.
#pragma once

#include <vector>

#include "kernels.hpp"

namespace splat {

class Similarity {
  public:
    Similarity(const Kernels& kernels, int threads) : kernels_(kernels), threads_(threads) {}

    void use_threads(int threads) { threads_ = threads; }

    // ``rendered``, ``target`` and ``gradient`` are 3 x height x width; returns the mean over all
    // pixels and channels, and fills the gradient of that mean with respect to ``rendered``.
    double mean(const float* rendered, const float* target, float* gradient, int width,
                int height);
    double parallel_s() const { return parallel_s_; }  // spent so far in ``mean``

  private:
    const Kernels& kernels_;
    [[maybe_unused]] int threads_;  // not used without OpenMP
    std::vector<double> sums_;  // of each strip
    double parallel_s_ = 0;
};

}  // namespace splat
