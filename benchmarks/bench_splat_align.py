"""Scene and robot laid onto each other in the stand-in cell's geometry, truth known."""

import sys
import time
from dataclasses import replace

import numpy as np
from measure import ROOT, Target, report_targets

SCENES = 10
BIAS = 1.01
JOINT_OFFSET_RAD = 0.0015


def main() -> None:
    """Align from anywhere, four postures, one percent of depth bias; compare with a rigid fit."""
    sys.path.insert(0, str(ROOT / "tests" / "twin" / "scene" / "align"))
    import cell_views

    from twin.robot.surface import PosedSurface, sample_surface
    from twin.scene.align.align import RobotNotAlignedError, align_robot
    from twin.scene.align.refine import FINE, ScenePose, refine

    robot = cell_views.robot()

    cpu_seconds: list[float] = []

    def measure(errors: cell_views.CellErrors) -> tuple[list[float], list[float], list[float]]:
        """Errors [m], seconds and margins over scenes that lie anywhere."""
        views = cell_views.views(cell_views.POSTURES, np.eye(4), errors)
        points = sample_surface(robot, views[0].posture, 500, seed=3)
        wrong, seconds, margins = [], [], []
        for seed in range(SCENES):
            T = cell_views.anywhere(seed)
            moved = [replace(v, T_source_camera=T @ v.T_source_camera) for v in views]
            start, cpu_start = time.monotonic(), time.process_time()
            try:
                found = align_robot(moved, robot)
            except RobotNotAlignedError as error:
                print(f"  scene {seed}: {error}")
                wrong.append(float("inf"))
                continue
            seconds.append(time.monotonic() - start)
            cpu_seconds.append(time.process_time() - cpu_start)
            wrong.append(cell_views.surface_error_m(found.T_base_source, T, points))
            margins.append(found.margin or 0.0)
        return wrong, seconds, margins

    views = cell_views.views(
        cell_views.POSTURES, np.eye(4), cell_views.CellErrors(depth_scale=BIAS)
    )
    points = sample_surface(robot, views[0].posture, 500, seed=3)
    surfaces = [PosedSurface(robot, view.posture) for view in views]
    start = ScenePose(T_base_source=np.eye(4))
    rigid, _ = refine(views, surfaces, start, stages=FINE, num_points=6000, with_scale=False)
    rigid_m = cell_views.surface_error_m(rigid.T_base_source, np.eye(4), points)
    icp_m = cell_views.surface_error_m(open3d_icp(views, robot), np.eye(4), points)
    plain, seconds, margins = measure(cell_views.CellErrors(depth_scale=BIAS))
    offsets = np.random.default_rng(0).normal(0.0, JOINT_OFFSET_RAD, 6)
    real, _, _ = measure(
        cell_views.CellErrors(depth_scale=BIAS, joint_offset_rad=tuple(offsets.tolist()))
    )
    reference = f"from the true place, rigid: {rigid_m * 1e3:.1f} mm, Open3D {icp_m * 1e3:.1f} mm"
    targets = [
        Target(
            what="alignment error with 1 % depth bias, worst scene",
            measured=max(plain) * 1e3,
            limit=2.0,
            unit="mm",
            reference=reference,
        ),
        Target(
            what="the same with joint offsets of 1.5 mrad",
            measured=max(real) * 1e3,
            limit=4.0,
            unit="mm",
            reference="expected on real robots: 2 to 4 mm",
        ),
        Target(
            what="time, slowest scene",
            measured=max(seconds),
            limit=10.0,
            unit="s",
            reference=f"CPU {max(cpu_seconds):.1f} s",
        ),
        Target(
            what="yaw margin, smallest", measured=min(margins), limit=1.3, unit="", at_most=False
        ),
    ]
    note = f"{SCENES} scenes at random poses, {len(cell_views.POSTURES)} postures, 320 x 240"
    report_targets("splat_align", targets, note=note)


def open3d_icp(views: list, robot: object) -> np.ndarray:
    """Point-to-plane ICP with Tukey's loss of Open3D, rigid, from the true place."""
    import open3d

    from bridge.geometry import se3
    from twin.robot.surface import PosedSurface, sample_surface

    scans, models = [], []
    for view in views:
        surface = PosedSurface(robot, view.posture)
        p = se3.apply(view.T_source_camera, view.cloud.p_m)
        scans.append(p[surface.nearest(p).distance_m < 0.05])
        models.append(sample_surface(robot, view.posture, 20_000, seed=0))
    scan, model = (open3d.geometry.PointCloud() for _ in range(2))
    scan.points = open3d.utility.Vector3dVector(np.concatenate(scans))
    model.points = open3d.utility.Vector3dVector(np.concatenate(models))
    normals = [
        PosedSurface(robot, view.posture).nearest(m).normals
        for view, m in zip(views, models, strict=True)
    ]
    model.normals = open3d.utility.Vector3dVector(np.concatenate(normals))
    registration = open3d.pipelines.registration
    loss = registration.TransformationEstimationPointToPlane(registration.TukeyLoss(k=0.02))
    found = registration.registration_icp(scan, model, 0.03, np.eye(4), loss)
    return np.asarray(found.transformation)


if __name__ == "__main__":
    main()
