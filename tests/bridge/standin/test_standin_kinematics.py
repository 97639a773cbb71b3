"""The kinematics of the controller against MuJoCo, ray-cast cameras against plain geometry."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from standin_plans import planned

from bridge.geometry import se3
from bridge.geometry.camera import Camera
from bridge.sources.standin import planner
from bridge.sources.standin.cell_file import CellFile, HiddenParameters, SensorModel
from bridge.sources.standin.kinematics import (
    UnreachablePoseError,
    arm_kinematics,
    tool_down,
    yaw_of,
)
from bridge.sources.standin.render import Picture, Renderer, measure_color, measure_depth
from bridge.sources.standin.surfaces import Surface, box_surface, lab_surfaces
from bridge.sources.standin.world import World
from bridge.task.plan import Plan
from bridge.task.task_file import Task

HOME = np.array([-0.263, -1.709, 1.365, -1.227, -1.571, 1.308])


@pytest.fixture(scope="module")
def world(task: Task, nominal: HiddenParameters) -> World:
    return World(task, nominal)


@pytest.fixture
def plan_of(task: Task, starts: dict[str, np.ndarray], cell_file: CellFile) -> Callable[..., Plan]:
    def plan(error: planner.GraspError = planner.NO_ERROR, **more: Any) -> Plan:
        speed_rad_s = cell_file.max_joint_speed_rad_s
        settings = {"joints_start_rad": HOME, "max_joint_speed_rad_s": speed_rad_s, **more}
        return planned(task, starts, error, **settings)

    return plan


def test_forward_kinematics_agree_with_mujoco(world: World, starts: dict[str, np.ndarray]) -> None:
    rng = np.random.default_rng(9_000_000)
    for joints in rng.uniform(-np.pi, np.pi, (20, 6)):
        world.reset(joints, starts)
        difference = world.T_base_body("tcp") - arm_kinematics().T_base_tcp(joints)
        assert np.abs(difference).max() < 1e-9


def test_every_waypoint_reaches_its_commanded_pose(
    plan_of: Callable[..., Plan], world: World, starts: dict[str, np.ndarray]
) -> None:
    plan = plan_of()
    commanded = se3.transform_from(plan.quaternions_wxyz(), plan.positions_m())
    for waypoint, T in list(zip(plan.tau, commanded, strict=True))[::5]:
        world.reset(np.array(waypoint.joints_rad), starts)
        reached = world.T_base_body("tcp")
        assert np.linalg.norm(reached[:3, 3] - T[:3, 3]) < 0.0005
        assert se3.rotation_angle_rad(reached[:3, :3].T @ T[:3, :3]) < 0.001


def test_no_joint_moves_faster_than_the_cell_allows(
    plan_of: Callable[..., Plan], cell_file: CellFile
) -> None:
    plan = plan_of()
    joints = np.array([waypoint.joints_rad for waypoint in plan.tau])
    speed = np.abs(np.diff(joints, axis=0)) / (np.diff(plan.times_ns())[:, None] * 1e-9)
    assert speed.max() <= cell_file.max_joint_speed_rad_s + 1e-9


def test_a_grasp_is_never_turned_more_than_an_eighth_from_the_cube(
    plan_of: Callable[..., Plan], starts: dict[str, np.ndarray]
) -> None:
    closed = next(waypoint for waypoint in plan_of().tau if waypoint.g == 1)
    T = se3.transform_from(np.array(closed.q_wxyz), np.array(closed.p_m))
    # Tool x at yaw 0 points along -x of the base.
    turn = (yaw_of(T) - np.pi - yaw_of(starts["cube"])) % (np.pi / 2)
    assert min(turn, np.pi / 2 - turn) < 1e-6


def test_the_error_of_a_candidate_depends_on_start_and_round_only(
    cell_file: CellFile, starts: dict[str, np.ndarray]
) -> None:
    noise = cell_file.planner
    first = planner.draw_error(noise, start_seed=9_000_001, round_=0)
    assert first == planner.draw_error(noise, start_seed=9_000_001, round_=0)
    assert first != planner.draw_error(noise, start_seed=9_000_001, round_=1)
    seen = [planner.perceive(starts, noise, start_seed=9_000_001)["cube"] for _ in range(2)]
    np.testing.assert_array_equal(*seen)
    assert not np.array_equal(seen[0], starts["cube"])


def test_a_pose_out_of_reach_is_refused_with_its_position() -> None:
    far = tool_down(np.array([1.4, 0.0, 0.2]), 0.0)
    with pytest.raises(UnreachablePoseError, match=r"cannot reach \(1.400, 0.000, 0.200\)"):
        arm_kinematics().joints_for(far, HOME)


def test_a_wrist_that_is_wound_up_turns_back_before_the_next_object(
    ducks: Task, toys_cell: CellFile
) -> None:
    def lying(p_m: tuple[float, float, float], yaw: float) -> np.ndarray:
        q = np.array([np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)])
        return se3.transform_from(q, np.array(p_m))

    # Each of these turns is reached alone; with both, the wrist has no way to the second's basket.
    yaws = (-1.22, -1.18, 0.3, 1.02, -0.6)
    seen = {"basket": lying((0.46, 0.24, 0.0), 0.15)}
    for name, yaw in zip(ducks.manipulated, yaws, strict=True):
        start = ducks.start[name]
        seen[name] = lying((np.mean(start.x_m), np.mean(start.y_m), 0.03), yaw)
    limit = toys_cell.max_joint_speed_rad_s
    plan = planner.plan_pick_and_place(
        ducks,
        seen,
        replace(planner.NO_ERROR, release_m=(-0.08, 0.04)),
        kinematics=arm_kinematics(),
        joints_start_rad=HOME,
        max_joint_speed_rad_s=limit,
        plan_id="plan_0",
        condition="without_replanning",
        start_id="five_ducks_into_basket/9000000",
    )
    joints = np.array([waypoint.joints_rad for waypoint in plan.tau])
    assert np.abs(joints).max() <= np.pi + 1e-9
    speed = np.abs(np.diff(joints, axis=0)) / (np.diff(plan.times_ns())[:, None] * 1e-9)
    assert speed.max() <= limit + 1e-9
    wrist = dict(zip((stage.id for stage in plan.stages), _wrist_ways(plan), strict=True))
    assert wrist["pick_2"] > 2.0  # most of the way round, instead of past the limit
    grasped = [stage.id for stage in plan.stages if stage.grasp]
    assert grasped == [f"pick_{index}" for index in range(1, 6)]


def _wrist_ways(plan: Plan) -> list[float]:
    """How far the last joint turns in each stage [rad]."""
    times, last = plan.times_ns(), np.array([waypoint.joints_rad[5] for waypoint in plan.tau])
    return [
        float(np.ptp(last[(times >= stage.t_start_ns) & (times <= stage.t_end_ns)]))
        for stage in plan.stages
    ]


def test_a_pose_that_winds_a_joint_past_its_limit_names_the_joint() -> None:
    kinematics = arm_kinematics()
    wound = HOME.copy()
    wound[5] = 3.13
    past = wound.copy()
    past[5] = 3.16
    with pytest.raises(UnreachablePoseError, match="mm off with wrist_3_joint past 180 deg"):
        kinematics.joints_for(kinematics.T_base_tcp(past), wound)


CAMERA = Camera(width=40, height=30, fx=35.0, fy=35.0, cx=20.0, cy=15.0)
UP = np.array([0.0, 0.0, 1.0])


@pytest.fixture(scope="module")
def lab() -> list[Surface]:
    return lab_surfaces(9_000_000)


@pytest.fixture
def plain_sensor(cell_file: CellFile) -> SensorModel:
    return replace(cell_file.sensors, depth_noise_per_m=0.0, image_noise=0.0)


def plane_depth(T_base_camera: np.ndarray) -> np.ndarray:
    """Depth of the plane z = 0 through every pixel centre."""
    rays = CAMERA.rays() @ T_base_camera[:3, :3].T
    return -T_base_camera[2, 3] / rays[..., 2]


def test_depth_of_the_table_agrees_with_the_plane(lab: list[Surface]) -> None:
    T = se3.look_at(np.array([0.1, -0.2, 0.6]), np.array([0.35, 0.0, 0.0]), UP)
    picture = Renderer(lab).render(CAMERA, T, {})
    np.testing.assert_allclose(picture.depth_m, plane_depth(T), atol=1e-5)


def test_a_box_on_the_table_is_nearer_by_its_height(lab: list[Surface]) -> None:
    box = box_surface("cube", np.array([0.0, 0.0, 0.0]), np.array([0.1, 0.1, 0.1]), (1.0, 0.0, 0.0))
    T = se3.look_at(np.array([0.3, 0.0, 0.8]), np.array([0.3001, 0.0, 0.0]), UP)
    T_base_cube = np.eye(4)
    T_base_cube[:3, 3] = [0.3, 0.0, 0.05]
    picture = Renderer([*lab, box]).render(CAMERA, T, {"cube": T_base_cube})
    assert picture.depth_m[15, 20] == pytest.approx(0.7, abs=1e-3)
    red, green, blue = picture.image[15, 20]
    assert red > 0.5
    assert green == blue == 0.0


def test_a_backdrop_changes_no_depth(lab: list[Surface]) -> None:
    box = box_surface("cube", np.zeros(3), np.array([0.1, 0.1, 0.1]), (1.0, 0.0, 0.0))
    T = se3.look_at(np.array([0.8, -0.5, 0.5]), np.array([0.35, 0.0, 0.0]), UP)
    T_base_cube = np.eye(4)
    T_base_cube[:3, 3] = [0.35, 0.0, 0.05]
    renderer = Renderer([*lab, box])
    whole = renderer.render(CAMERA, T, {"cube": T_base_cube})
    kept = renderer.render(CAMERA, T, {"cube": T_base_cube}, renderer.backdrop(CAMERA, T))
    np.testing.assert_array_equal(whole.depth_m, kept.depth_m)
    assert np.mean(np.abs(whole.image - kept.image).max(axis=2) > 0.02) < 0.05


def flat_picture(depth_m: float, cosine: float = 1.0, shape: tuple[int, int] = (60, 80)) -> Picture:
    return Picture(
        image=np.full((*shape, 3), 0.5, dtype=np.float32),
        depth_m=np.full(shape, depth_m),
        cosine=np.full(shape, cosine, dtype=np.float32),
    )


def test_depth_is_biased_as_the_hidden_parameters_say(
    plain_sensor: SensorModel, nominal: HiddenParameters
) -> None:
    hidden = replace(nominal, depth_scale=1.01, depth_offset_m=0.002)
    rng = np.random.default_rng(0)
    measured = measure_depth(flat_picture(0.8), plain_sensor, hidden, rng)
    assert set(np.unique(measured)) == {810}


def test_depth_noise_grows_with_the_square_of_the_distance(
    cell_file: CellFile, nominal: HiddenParameters
) -> None:
    rng = np.random.default_rng(0)
    spread = [
        measure_depth(flat_picture(z), cell_file.sensors, nominal, rng).astype(float).std() * 1e-3
        for z in (1.0, 2.0)
    ]
    # Rounding to millimetres adds a variance of 1/12 mm^2 to each.
    noise = [np.sqrt(value**2 - 1e-6 / 12) for value in spread]
    assert noise[0] == pytest.approx(0.0012, rel=0.05)
    assert noise[1] / noise[0] == pytest.approx(4.0, rel=0.05)


@pytest.mark.parametrize(("depth_m", "cosine"), [(0.5, 0.05), (0.05, 1.0), (3.0, 1.0), (np.inf, 0)])
def test_there_is_no_depth_at_flat_angles_or_out_of_range(
    plain_sensor: SensorModel, nominal: HiddenParameters, depth_m: float, cosine: float
) -> None:
    picture = flat_picture(depth_m, cosine)
    measured = measure_depth(picture, plain_sensor, nominal, np.random.default_rng(0))
    assert not measured.any()


def test_holes_lie_on_the_far_side_of_an_edge_only(
    plain_sensor: SensorModel, nominal: HiddenParameters
) -> None:
    picture = flat_picture(0.5)
    picture.depth_m[:, 40:] = 1.0
    measured = measure_depth(picture, plain_sensor, nominal, np.random.default_rng(0))
    empty = np.unique(np.nonzero(measured == 0)[1])
    assert list(empty) == [40]


def test_colour_follows_the_hidden_gain(
    plain_sensor: SensorModel, nominal: HiddenParameters
) -> None:
    hidden = replace(nominal, image_gain=0.8)
    image = measure_color(flat_picture(0.5), plain_sensor, hidden, np.random.default_rng(0))
    assert set(np.unique(image)) == {102}
