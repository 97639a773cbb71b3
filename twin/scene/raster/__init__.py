"""Draw Gaussians and pull gradients back: on the CPU, on CUDA, and fused as one step of a fit."""
