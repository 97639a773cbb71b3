"""The rasteriser's speed: against torch, with two threads, and for a frame of a sequence."""

import statistics
import sys

import numpy as np
from measure import ROOT, Target, cpu_seconds, report_targets

from bridge.geometry.camera import Camera
from bridge.robots.default import ROBOT
from twin.robot.posture import Posture
from twin.scene.frames.rgbd import Target as Seen
from twin.scene.gaussians import (
    GaussianCloud,
    arrays,
    as_float32,
    concatenate,
    morton_order,
)
from twin.scene.movable_scene import Frame, MovableScene
from twin.scene.objects.decompose import ObjectSplats
from twin.scene.raster.rasteriser import NAMES, FitSession, RasterConfig, Rasteriser, load_native

VGA = Camera(width=640, height=480, fx=525.0, fy=525.0, cx=320.0, cy=240.0)
SMALL = Camera(width=160, height=120, fx=160.0, fy=160.0, cx=80.0, cy=60.0)
COUNT = 50_000
SMALL_COUNT, REPEATS = 2_000, 15
TORCH_FACTOR, THREADS_FACTOR = 100.0, 1.8
FRAME_MS = 200.0
"""CPU time that a frame of a whole episode may take."""
LINKS = (
    *("shoulder_link", "upper_arm_link", "forearm_link", "wrist_1_link", "wrist_2_link"),
    *("wrist_3_link", "base_link", "tool0"),
)
RATES = {
    "means_m": 1e-4,
    "quats_wxyz": 1e-3,
    "scales_log": 1e-3,
    "opacities_logit": 1e-3,
    "colors": 1e-3,
}


def surface_cloud(camera: Camera, count: int) -> GaussianCloud:
    """Flat Gaussians on all a camera sees of a wavy surface with a step, as fused depth gives."""
    rng = np.random.default_rng(0)
    u = rng.uniform(-0.05, 1.05, count) * camera.width
    v = rng.uniform(-0.05, 1.05, count) * camera.height
    z = 1.2 + 0.5 * np.sin(7 * u / camera.width) * np.cos(7 * v / camera.height)
    z += 0.4 * (v > 0.55 * camera.height)
    ray = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(count)], 1)
    spacing_px = np.sqrt(1.21 * camera.width * camera.height / count)
    sigma = 0.62 * spacing_px * z / camera.fx
    quats = rng.normal(scale=0.15, size=(count, 4)) + np.array([1.0, 0.0, 0.0, 0.0])
    cloud = GaussianCloud(
        means_m=as_float32(ray * z[:, None]),
        quats_wxyz=as_float32(quats),
        scales_log=as_float32(np.log(np.stack([sigma, sigma, 0.1 * sigma], axis=1))),
        opacities_logit=as_float32(rng.normal(1.0, 1.0, count)),
        colors=as_float32(rng.uniform(size=(count, 3))),
    )
    return cloud.take(morton_order(cloud.means_m))


def native(cloud: GaussianCloud, camera: Camera, rasteriser: Rasteriser) -> tuple[np.ndarray, ...]:
    planes = rasteriser.draw_planes(cloud, camera, np.eye(4))
    gradients = rasteriser._native.pull(planes, np.ones_like(planes))
    return planes, gradients[NAMES.index("colors")]


def against_torch(repeats: int) -> Target:
    import torch

    sys.path.insert(0, str(ROOT / "tests" / "parity"))
    import splat_reference

    torch.set_num_threads(1)
    cloud = surface_cloud(SMALL, SMALL_COUNT)

    def reference() -> None:
        tensors = [torch.tensor(rows, requires_grad=True) for _, rows in arrays(cloud)]
        drawn = splat_reference.draw(
            *tensors, camera=SMALL, T_camera_base=np.eye(4), alpha_cut=1 / 255
        )
        drawn.sum().backward()

    wide = "v3" if "v3" in load_native().available_isas() else "auto"
    rasteriser = Rasteriser(RasterConfig(threads=1, isa=wide))
    slow = statistics.median(cpu_seconds(reference, repeats=2))
    own = statistics.median(cpu_seconds(lambda: native(cloud, SMALL, rasteriser), repeats=repeats))
    return Target(
        what=f"{SMALL_COUNT} Gaussians, {SMALL.width} x {SMALL.height}, faster than torch",
        measured=slow / own,
        limit=TORCH_FACTOR,
        unit="x",
        at_most=False,
        reference=f"torch {slow * 1e3:.0f} ms, native {own * 1e3:.2f} ms",
    )


def iterations(count: int, threads: int, repeats: int) -> tuple[float, float, dict[str, float]]:
    """Wall time of a whole fit step, what of it is serial, and its stages, medians [s]."""
    rng = np.random.default_rng(1)
    size = (VGA.height, VGA.width)
    target = Seen(
        camera=VGA,
        planes_u8=rng.integers(0, 256, (3, *size), dtype=np.uint8),
        depth_m=rng.uniform(0.8, 2.0, size).astype(np.float32),
        static_mask=np.ones(size, dtype=bool),
    )
    session = FitSession(surface_cloud(VGA, count), RasterConfig(threads=threads))
    session.step(target, np.eye(4), RATES)
    reports = [session.step(target, np.eye(4), RATES) for _ in range(repeats)]
    stages = {
        name: statistics.median(report.seconds[name] for report in reports)
        for name in reports[0].seconds
    }
    total = statistics.median(sum(report.seconds.values()) for report in reports)
    return total, statistics.median(report.serial_s for report in reports), stages


def with_threads(count: int, repeats: int) -> tuple[Target, dict[str, dict[str, float]]]:
    one, serial, stages_one = iterations(count, 1, repeats)
    two, _, stages_two = iterations(count, 2, repeats)
    share = serial / one
    bound = f"serial {100 * share:.1f} %: at most {2 / (1 + share):.2f} x by Amdahl's law"
    target = Target(
        what=f"fit step, {count // 1000}k Gaussians, two threads faster than one",
        measured=one / two,
        limit=THREADS_FACTOR,
        unit="x",
        at_most=False,
        reference=f"{one * 1e3:.1f} ms, {two * 1e3:.1f} ms wall; {bound}",
    )
    return target, {"1": stages_one, "2": stages_two}


def of_a_sequence(repeats: int) -> Target:
    """A frame of ``render --episode``: background, two objects and eight links, put together."""
    links = {name: surface_cloud(SMALL, 1500) for name in LINKS}
    thing = ObjectSplats(cloud=surface_cloud(SMALL, 1500), T_base_object=np.eye(4))
    seen = surface_cloud(VGA, COUNT - 3000)
    guessed = surface_cloud(VGA, 3000).as_completed()
    parts = MovableScene(
        background=concatenate([seen, guessed]),
        objects={"first": thing, "second": thing},
        links=links,
    )
    rasteriser = Rasteriser(RasterConfig(threads=1))
    posture = Posture(joints_rad=np.full(len(ROBOT.joints), 0.4), width_m=0.04)
    frame = Frame(
        stamp_ns=0,
        T_base_camera=np.eye(4),
        Ts_base_object={"first": np.eye(4)},
        posture=posture,
        urdf=ROBOT.urdf_text(),
    )
    took_s = cpu_seconds(lambda: parts.drawn_as(rasteriser, VGA, frame), repeats=repeats)
    seconds = statistics.median(took_s)
    return Target(
        what="a frame of a sequence, 65k Gaussians with their seen mask",
        measured=seconds * 1e3,
        limit=FRAME_MS,
        unit="ms",
    )


def main() -> None:
    """Measure."""
    target, stages = with_threads(COUNT, REPEATS)
    targets = [target, against_torch(REPEATS), of_a_sequence(REPEATS)]
    note = "640 x 480 unless said, forward and backward, CPU time of one thread unless said wall"
    report_targets("splat_rasteriser", targets, note=note, stages_s=stages)


if __name__ == "__main__":
    main()
