"""Hand-written plans, for tests and benchmarks of the replay."""

from dataclasses import replace

import numpy as np

from bridge.episode.streams import JointTrack
from bridge.geometry import se3
from bridge.geometry.trajectory import PoseTrajectory
from bridge.robots.default import ARM_JOINTS, ROBOT
from bridge.robots.robot import robot_of
from bridge.task.plan import Plan, Stage, Waypoint
from bridge.task.task_file import Task, load_task
from twin.replay.result import ReplayResult
from twin.replay.scene import ReplayScene
from twin.robot.inverse import solve_ik
from twin.robot.model import load_robot

OPEN_M, CLOSED_M = 0.085, 0.02


def scene_of_test(missing: tuple[str, ...] = ()) -> ReplayScene:
    poses = {
        "cube": se3.transform_from(np.array([0.92, 0, 0, 0.39]), np.array([0.5, -0.15, 0.02])),
        "box": se3.transform_from(np.array([1.0, 0, 0, 0]), np.array([0.5, 0.19, 0.0])),
    }
    return ReplayScene(
        task=load_task("cube_into_box"),
        Ts_base_object={name: T for name, T in poses.items() if name not in missing},
        urdf=ROBOT.urdf_text(),
    )


def joints_over(scene: ReplayScene, x: float, y: float, z: float) -> np.ndarray:
    """Tool at this place of the base frame, pointing straight down."""
    T = np.diag([1.0, -1.0, -1.0, 1.0])
    T[:3, 3] = (x, y, z)
    solution = solve_ik(load_robot(scene.urdf), T)
    assert solution.reached
    return solution.joints_rad


def downward(yaw_rad: float) -> tuple[float, float, float, float]:
    """The tool looks down; its fingers open along the direction of the yaw."""
    R = np.array(
        [[np.cos(yaw_rad), -np.sin(yaw_rad), 0], [np.sin(yaw_rad), np.cos(yaw_rad), 0], [0, 0, 1.0]]
    ) @ np.diag([1.0, -1.0, -1.0])
    w, x, y, z = se3.quaternion_from_rotation(R).tolist()
    return w, x, y, z


def pick_and_place(
    scene: ReplayScene,
    *,
    grasp_offset_m: tuple[float, float, float] = (0.0, 0.0, 0.0),
    carry_height_m: float = 0.22,
    place_m: tuple[float, float, float] | None = None,
    pace: float = 2.0,
    plan_id: str = "scripted",
) -> Plan:
    """Above, down, close, up, over the box, open, away: 11 seconds, divided by the pace."""
    robot = robot_of(scene.urdf)
    T = scene.Ts_base_object["cube"]
    yaw = float(np.arctan2(T[1, 0], T[0, 0]))
    x, y, z = (T[:3, 3] + np.array(grasp_offset_m)).tolist()
    bx, by, _ = scene.Ts_base_object["box"][:3, 3].tolist()
    place = (bx, by, 0.12) if place_m is None else place_m
    knots: list[tuple[float, tuple[float, float, float], float, int]] = [
        (0.0, (x, y, 0.25), yaw, 0),
        (2.0, (x, y, z), yaw, 0),
        (2.2, (x, y, z), yaw, 1),
        (3.2, (x, y, z), yaw, 1),
        (4.6, (x, y, carry_height_m), yaw, 1),
        (7.0, (bx, by, carry_height_m), 0.0, 1),
        (8.2, place, 0.0, 1),
        (8.4, place, 0.0, 0),
        (9.4, place, 0.0, 0),
        (11.0, (bx, by, 0.3), 0.0, 0),
    ]
    tau = tuple(
        Waypoint(
            t_ns=round(t * 1e9 / pace),
            p_m=p,
            q_wxyz=downward(angle),
            g=g,
            width_m=CLOSED_M if g else min(OPEN_M, robot.gripper.max_width_m),
        )
        for t, p, angle, g in knots
    )
    return Plan(
        id=plan_id,
        planner="test",
        policy="scripted",
        condition="without_replanning",
        robot=robot.name,
        frame=robot.base_frame,
        instruction=scene.task.instruction,
        task=scene.task.name,
        stages=stages_of(scene.task, pace),
        tau=tau,
    )


def with_joints(plan: Plan, scene: ReplayScene, step_s: float = 0.08) -> Plan:
    """The same plan with a waypoint each ``step_s`` and the joints that reach it."""
    robot = load_robot(scene.urdf)
    poses = PoseTrajectory(plan.times_ns(), plan.positions_m(), plan.quaternions_wxyz())
    stamps = np.arange(0, int(plan.tau[-1].t_ns) + 1, round(step_s * 1e9), dtype=np.int64)
    dense = poses.at(stamps)
    tau = []
    joints = None
    for stamp, p, q, T in zip(stamps, dense.p_m, dense.q_wxyz, dense.transforms(), strict=True):
        joints = solve_ik(robot, T, warm_start_rad=joints).joints_rad
        last = [waypoint for waypoint in plan.tau if waypoint.t_ns <= stamp][-1]
        tau.append(
            replace(
                last,
                t_ns=int(stamp),
                p_m=tuple(p.tolist()),
                q_wxyz=tuple(q.tolist()),
                joints_rad=tuple(joints.tolist()),
            )
        )
    return replace(plan, tau=tuple(tau), joint_names=robot.joints)


def recorded_tracks(
    result: ReplayResult, start_ns: int = 0, rate_hz: int = 125, names: tuple[str, ...] = ARM_JOINTS
) -> tuple[JointTrack, JointTrack]:
    """What encoders would have said of a replay."""
    end = int(result.stamps_ns[-1])
    stamps = np.arange(0, end, round(1e9 / rate_hz), dtype=np.int64)
    arm = JointTrack(names=names, stamps_ns=result.stamps_ns, position=result.joints_rad)
    grip = JointTrack(
        names=("gripper_width",), stamps_ns=result.stamps_ns, position=result.width_m[:, None]
    )
    return tuple(
        JointTrack(names=t.names, stamps_ns=stamps + start_ns, position=t.at(stamps))
        for t in (arm, grip)
    )


def stages_of(task: Task, pace: float = 2.0) -> tuple[Stage, ...]:
    spans = {"grasp": (0.0, 3.2), "place": (3.2, 11.0)}
    return tuple(
        Stage(
            id=stage["id"],
            text=stage["text"],
            grasp=stage.get("grasp"),
            release=stage.get("release"),
            allowed_contacts=tuple((a, b) for a, b in stage["allowed_contacts"]),
            t_start_ns=round(spans[stage["id"]][0] * 1e9 / pace),
            t_end_ns=round(spans[stage["id"]][1] * 1e9 / pace),
        )
        for stage in task.stages
    )


def toy_scene(task_name: str = "sloth_into_basket") -> ReplayScene:
    """The middle of the range every object starts from, the toys turned by a little."""
    task = load_task(task_name)
    poses = {}
    for name, limits in task.start.items():
        x, y = np.mean(limits.x_m), np.mean(limits.y_m)
        yaw = 0.0 if name in task.containers else 0.3
        q = np.array([np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)])
        poses[name] = se3.transform_from(q, np.array([x, y, task.objects[name].rest_height_m]))
    return ReplayScene(task=task, Ts_base_object=poses, urdf=ROBOT.urdf_text())


def toy_plan(scene: ReplayScene, *, miss_m: float = 0.0, plan_id: str = "toys") -> Plan:
    """What the stand-in's planner does when it sees everything right, or misses across."""
    from bridge.sources.standin.cell import HOME_SEED_RAD
    from bridge.sources.standin.kinematics import arm_kinematics, tool_down
    from bridge.sources.standin.planner import NO_ERROR, plan_pick_and_place

    kinematics = arm_kinematics()
    home = kinematics.joints_for(
        tool_down(np.array([0.42, 0.0, 0.42]), 0.0), np.array(HOME_SEED_RAD)
    )
    return plan_pick_and_place(
        scene.task,
        scene.Ts_base_object,
        replace(NO_ERROR, across_m=miss_m),
        kinematics=kinematics,
        joints_start_rad=home,
        max_joint_speed_rad_s=1.6,
        plan_id=plan_id,
        condition="without_replanning",
        start_id="s0",
    )
