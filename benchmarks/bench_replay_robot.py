"""Kinematics and distances of a replay, against named references in the same run.

Inverse kinematics: 1,000 random reachable poses of the UR5 with our gripper, seed 2026; reference
pinocchio with Levenberg-Marquardt, cold, 20 restarts, and eaik where it is installed. Clearance:
one configuration against a scene of about 50,000 triangles (a bumpy table and posts); reference
coal's bounding volumes of the same triangles. CPU time of this process, OMP_NUM_THREADS=1.
"""

import os

os.environ["OMP_NUM_THREADS"] = "1"

import argparse
import importlib.util
import statistics
import time
from collections.abc import Callable

import numpy as np
from measure import Target, report_targets

NOTE = "UR5 and parallel gripper, CPU time, one thread; microseconds are medians of repeats"
SEED = 2026
VOXEL_M = 0.008


def cpu_us(work: Callable[[], object], *, repeats: int, each: int = 1) -> float:
    """Median CPU time of one of the things that a call does [us]."""
    work()
    times = []
    for _ in range(repeats):
        start = time.process_time()
        work()
        times.append((time.process_time() - start) / each * 1e6)
    return statistics.median(times)


def inverse_rows(num_poses: int) -> list[Target]:
    from bridge.robots.default import ROBOT
    from twin.robot.inverse import UrInverse, pose_error, solve_ik
    from twin.robot.model import load_robot

    robot = load_robot(ROBOT.urdf_text())
    inverse = UrInverse.for_robot(robot)
    if inverse is None:
        raise SystemExit("the default robot is no UR any more")
    rng = np.random.default_rng(SEED)
    Ts = robot.Ts_base_tcp(rng.uniform(-np.pi, np.pi, (num_poses, 6)))
    joints, valid, _ = inverse.solve(Ts)
    worst = max(pose_error(robot, joints[i, b], Ts[i])[0] for i, b in np.argwhere(valid).tolist())
    batch_us = cpu_us(lambda: inverse.solve(Ts), repeats=9, each=num_poses)
    few = Ts[: max(num_poses // 10, 10)]
    solved = []
    cold_us = cpu_us(
        lambda: solved.append(sum(solve_ik(robot, T).reached for T in few)),
        repeats=1,
        each=len(few),
    )
    reference = f"LM cold, 20 restarts: {cold_us:.0f} us, {solved[-1]} of {len(few)}"
    eaik = eaik_us(Ts)
    reference += f"; eaik {eaik:.1f} us" if eaik is not None else "; eaik is not installed"
    return [
        Target(what="closed form: solved", measured=100 * float(valid.any(axis=1).mean()),
               limit=100.0, unit="%", at_most=False, reference=f"{int(valid.sum())} answers"),
        Target(what="closed form: worst answer", measured=worst * 1e9, limit=1.0, unit="nm"),
        Target(what="closed form: a pose, all branches", measured=batch_us, limit=15.0, unit="us",
               reference=reference),
        *warm_rows(robot, rng),
    ]  # fmt: skip


def eaik_us(Ts: np.ndarray) -> float | None:
    """What the library eaik needs for the bare arm, where it is installed."""
    if importlib.util.find_spec("eaik") is None:
        return None
    from eaik.IK_DH import DhRobot  # type: ignore[import-not-found]

    half = np.pi / 2
    arm = DhRobot(
        np.array([half, 0, 0, half, -half, 0]),
        np.array([0, -0.425, -0.39225, 0, 0, 0]),
        np.array([0.089159, 0, 0, 0.10915, 0.09465, 0.0823]),
    )
    return cpu_us(lambda: [arm.IK(T) for T in Ts], repeats=3, each=len(Ts))


def warm_rows(robot: object, rng: np.random.Generator) -> list[Target]:
    """Along 40 smooth joint paths of 50 poses, each solved from the one before."""
    from twin.robot.follow import follow_poses
    from twin.robot.inverse import solve_ik

    ends = rng.uniform(-2.5, 2.5, (40, 6))
    paths = [end + np.linspace(0, 1, 50)[:, None] * rng.uniform(-0.8, 0.8, 6) for end in ends]
    Ts = [robot.Ts_base_tcp(path) for path in paths]  # type: ignore[attr-defined]
    reached = []

    def warm() -> None:
        for path, poses in zip(paths, Ts, strict=True):
            joints = path[0]
            for T in poses:
                solution = solve_ik(robot, T, warm_start_rad=joints)
                joints = solution.joints_rad
                reached.append(solution.reached)

    def follow() -> None:
        for path, poses in zip(paths, Ts, strict=True):
            follow_poses(robot, poses, start_rad=path[0])

    warm_us = cpu_us(warm, repeats=3, each=2000)
    follow_us = cpu_us(follow, repeats=3, each=2000)
    return [
        Target(what="LM: a warm start", measured=warm_us, limit=80.0, unit="us",
               reference=f"{100 * np.mean(reached):.1f} % reached; closed form and choice of "
               f"branch along the same paths {follow_us:.0f} us a pose"),
    ]  # fmt: skip


def scene_mesh(side: int) -> tuple[np.ndarray, np.ndarray]:
    """A bumpy table of about 2 * side * side triangles, and five posts."""
    rng = np.random.default_rng(SEED)
    x, y = np.meshgrid(np.linspace(-0.9, 0.9, side), np.linspace(-0.9, 0.9, side), indexing="ij")
    z = -0.06 + 0.01 * rng.uniform(size=x.shape)
    vertices = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    i = np.arange((side - 1) * side).reshape(side - 1, side)[:, :-1].ravel()
    faces = np.concatenate([np.stack([i, i + side, i + 1], 1),
                            np.stack([i + 1, i + side, i + side + 1], 1)])  # fmt: skip
    for px, py in ((0.7, 0.0), (0.6, 0.45), (0.6, -0.45), (0.2, 0.7), (0.2, -0.7)):
        corners = np.array([[u, v, w] for u in (0, 1) for v in (0, 1) for w in (0, 1)])
        post = (corners - [0.5, 0.5, 0.0]) * [0.05, 0.05, 0.6] + [px, py, -0.05]
        quads = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4],
                          [1, 5, 7, 3]])  # fmt: skip
        sides = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]) + len(vertices)
        vertices, faces = np.concatenate([vertices, post]), np.concatenate([faces, sides])
    return vertices, faces


def static_of(vertices: np.ndarray, faces: np.ndarray) -> object:
    """The grid of a mesh: below the table and inside the posts is solid."""
    import open3d

    from twin.scene.shape.sdf import SdfGrid, distances_of_solid
    from twin.scene.shape.static import StaticSdf

    counts = (225, 225, 90)
    origin = np.array([-0.9, -0.9, -0.1])
    cells = np.stack(np.meshgrid(*(np.arange(n) for n in counts), indexing="ij"), axis=-1)
    points = (origin + VOXEL_M * cells.reshape(-1, 3)).astype(np.float32)
    scene = open3d.t.geometry.RaycastingScene()
    mesh = open3d.t.geometry.TriangleMesh(
        open3d.core.Tensor(vertices.astype(np.float32)), open3d.core.Tensor(faces.astype(np.int32))
    )
    scene.add_triangles(mesh)
    near = scene.compute_distance(open3d.core.Tensor(points)).numpy() < VOXEL_M / 2
    solid = (near | (points[:, 2] < -0.06)).reshape(counts)
    grid = SdfGrid(
        values_m=distances_of_solid(solid, VOXEL_M), origin_m=origin, voxel_m=VOXEL_M, closed=False
    )
    return StaticSdf(conservative=grid, observed=grid)  # fmt: skip


def clearance_rows(num_states: int) -> list[Target]:
    import coal

    from bridge.robots.default import ROBOT
    from bridge.task.task_file import load_task
    from twin.replay.clearance.surroundings import Surroundings
    from twin.replay.scene import ReplayScene
    from twin.robot.collision import hulls_of, signed_distance
    from twin.robot.model import load_robot

    robot = load_robot(ROBOT.urdf_text())
    hulls = hulls_of(robot)
    rng = np.random.default_rng(SEED)
    postures = np.array([0.0, -1.3, 1.5, -1.7, -1.57, 0.0]) + rng.uniform(
        -0.6, 0.6, (num_states, 6)
    )
    rows, micros = [], {}
    for side in (50, 159):
        vertices, faces = scene_mesh(side)
        scene = ReplayScene(
            task=load_task("cube_into_box"), Ts_base_object={}, urdf=robot.urdf,
            table_height_m=-0.2, static_sdf=static_of(vertices, faces),
        )  # fmt: skip
        around = Surroundings(scene, hulls, 0.002)

        def look(around: Surroundings = around) -> list[float]:
            found = []
            for joints in postures:
                hulls.place(joints, 0.08)
                distances, _ = around.measure({}, [], near_m=0.012, counts=lambda body, other: True)
                found.append(min(distances.values()))
            return found

        micros[len(faces)] = cpu_us(look, repeats=5, each=num_states)
    few, many = micros
    model = coal.BVHModelOBBRSS()
    model.beginModel(len(faces), len(vertices))
    model.addVertices(vertices)
    model.addTriangles(faces)
    model.endModel()
    moving = [
        i for i, hull in enumerate(hulls.hulls) if hull.link not in ("base_link", "shoulder_link")
    ]
    mesh_m = []

    def reference() -> None:
        mesh_m.clear()
        for joints in postures[: max(num_states // 2, 5)]:
            hulls.place(joints, 0.08)
            mesh_m.append(min(
                signed_distance(hulls.hulls[i].shape, hulls.placement(i), model,
                                coal.Transform3s()) for i in moving))  # fmt: skip

    reference_us = cpu_us(reference, repeats=1, each=max(num_states // 2, 5))
    ours = np.array(look()[: len(mesh_m)])
    apart = np.array(mesh_m) > 0.005
    off_mm = (ours - mesh_m)[apart] * 1e3
    rows += [
        Target(what=f"clearance: a configuration, {many} triangles", measured=micros[many],
               limit=300.0, unit="us", reference=f"coal hull against mesh {reference_us:.0f} us"),
        Target(what=f"clearance: the same, against {few} triangles",
               measured=abs(micros[many] / micros[few] - 1) * 100, limit=25.0, unit="%",
               reference=f"{micros[few]:.0f} us"),
        Target(what="clearance: largest over-estimate", measured=float(off_mm.max()), limit=1.0,
               unit="mm", reference=f"{len(off_mm)} states against coal, median "
               f"{np.median(off_mm):.1f} mm; grid of {VOXEL_M * 1e3:g} mm"),
    ]  # fmt: skip
    return rows + candidate_rows(around.grid)


def candidate_rows(grid: object) -> list[Target]:
    from bridge.geometry import se3
    from twin.plan.constrain.distances import grid_clearance

    rng = np.random.default_rng(SEED)
    points = rng.normal(size=(200, 3))
    points *= 0.035 / np.linalg.norm(points, axis=1, keepdims=True)
    count = 8000
    Ts = np.repeat(np.eye(4)[None], count, axis=0)
    Ts[:, :3, :3] = np.stack(
        [se3.rotation_from_vector(v) for v in rng.uniform(-0.2, 0.2, (count, 3))]
    )
    Ts[:, :3, 3] = np.array([0.55, 0.3, 0.12]) + rng.uniform(-0.08, 0.08, (count, 3))
    us = cpu_us(lambda: grid_clearance(grid, points, Ts), repeats=5, each=count)
    one_by_one = cpu_us(
        lambda: [grid.distance(se3.apply(T, points)).min() for T in Ts[:500]],  # type: ignore[attr-defined]
        repeats=3,
        each=500,
    )
    return [
        Target(what="release poses of 200 points", measured=1e6 / us, limit=40_000.0, unit="1/s",
               at_most=False, reference=f"one by one {1e6 / one_by_one:.0f} 1/s"),
    ]  # fmt: skip


def main() -> None:
    """Measure everything once."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--poses", type=int, default=1000)
    parser.add_argument("--states", type=int, default=200)
    sizes = parser.parse_args()
    rows = [*inverse_rows(sizes.poses), *clearance_rows(sizes.states)]
    report_targets("replay_robot", rows, note=NOTE)


if __name__ == "__main__":
    main()
