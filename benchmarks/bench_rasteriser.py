"""The native rasteriser against its plain torch twin on the same Gaussians, one thread each."""

import os

os.environ["OMP_NUM_THREADS"] = "1"

import numpy as np
from measure import ROOT, cpu_seconds, report

COUNT, WIDTH, HEIGHT = 2_000, 160, 120
LARGE = 50_000


def main() -> None:
    """Measure one drawing with its gradient."""
    import sys

    import torch

    sys.path.insert(0, str(ROOT / "tests" / "parity"))
    import splat_reference

    from bridge.geometry import se3
    from bridge.geometry.camera import Camera
    from twin.scene.gaussians import GaussianCloud, arrays, as_float32
    from twin.scene.raster import RasterConfig, Rasteriser

    torch.set_num_threads(1)
    rng = np.random.default_rng(0)

    def cloud_of(count: int, scale_m: float) -> GaussianCloud:
        means = rng.uniform([-0.8, -0.6, 1.0], [0.8, 0.6, 2.5], (count, 3))
        return GaussianCloud(
            means_m=as_float32(means),
            quats_wxyz=as_float32(rng.normal(size=(count, 4))),
            scales_log=as_float32(np.log(rng.uniform(0.3, 1.0, (count, 3)) * scale_m)),
            opacities_logit=as_float32(rng.normal(1.0, 1.0, count)),
            colors=as_float32(rng.uniform(size=(count, 3))),
        )

    def camera_of(width: int, height: int) -> Camera:
        return Camera(width=width, height=height, fx=width, fy=width, cx=width / 2, cy=height / 2)

    def native(cloud: GaussianCloud, camera: Camera, isa: str) -> None:
        rasteriser = Rasteriser(RasterConfig(threads=1, isa=isa))
        planes = rasteriser.draw_planes(cloud, camera, np.eye(4))
        rasteriser.pull_back(planes, np.ones_like(planes))

    small, camera = cloud_of(COUNT, 0.02), camera_of(WIDTH, HEIGHT)

    def reference() -> None:
        tensors = [torch.tensor(rows, requires_grad=True) for _, rows in arrays(small)]
        splat_reference.draw(*tensors, camera, se3.invert(np.eye(4)), 1 / 255).sum().backward()

    rows = {
        "torch twin": cpu_seconds(reference, repeats=5),
        "native base": cpu_seconds(lambda: native(small, camera, "base"), repeats=15),
        "native auto": cpu_seconds(lambda: native(small, camera, "auto"), repeats=15),
    }
    note = f"{COUNT} Gaussians, {WIDTH} x {HEIGHT}, forward and backward, 1 thread"
    report("rasteriser", rows, reference="torch twin", note=note)
    large, vga = cloud_of(LARGE, 0.008), camera_of(640, 480)
    rows = {
        isa: cpu_seconds(lambda isa=isa: native(large, vga, isa), repeats=9)
        for isa in ("base", "auto")
    }
    note = f"{LARGE} Gaussians, 640 x 480, forward and backward, 1 thread"
    report("rasteriser_vga", rows, reference="base", note=note)


if __name__ == "__main__":
    main()
