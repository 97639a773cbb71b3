"""Grasps of the task files' objects: what holds of each, and each way of having none."""

from collections.abc import Mapping
from dataclasses import replace

import coal
import numpy as np
import pytest

from bridge.geometry import se3
from bridge.robots.robot import read_robot
from bridge.task.task_file import Task, load_task
from twin.plan.grasp.search import (
    CAUSES,
    CLEARANCE_M,
    CONE_RAD,
    MOST_TILT_RAD,
    GraspConfig,
    GraspSearch,
    GraspSearcher,
)
from twin.plan.problem import NoPlanError, Problem
from twin.plan.shapes import shapes_of
from twin.plan.stage.solver import ANGLE_RAD, LENGTH_M
from twin.replay.scene import ReplayScene
from twin.robot.collision import hulls_of, signed_distance
from twin.robot.model import load_robot

UR5 = "ur5_parallel_gripper"
SURE = np.diag(np.square([0.001, 0.001, 0.0005, 0.004, 0.004, 0.012]))
FEW = GraspConfig(samples=120, most=20)


def standing(x_m: float, y_m: float, z_m: float, yaw_rad: float = 0.3) -> np.ndarray:
    q = np.array([np.cos(yaw_rad / 2), 0.0, 0.0, np.sin(yaw_rad / 2)])
    return se3.transform_from(q, np.array([x_m, y_m, z_m]))


def problem(
    task: Task,
    poses: Mapping[str, np.ndarray],
    *,
    robot: str = UR5,
    covariances: Mapping[str, np.ndarray] | None = None,
) -> Problem:
    urdf = read_robot(robot).description()
    sure = dict.fromkeys(poses, SURE) if covariances is None else covariances
    scene = ReplayScene(task=task, urdf=urdf, Ts_base_object=dict(poses), covariances=sure)
    return Problem(scene=scene, robot=load_robot(urdf), shapes=shapes_of(None, task))


def cube_problem(
    cube: np.ndarray | None = None, *, robot: str = UR5, mass_kg: float = 0.05
) -> Problem:
    task = load_task("cube_into_box")
    objects = task.objects | {"cube": replace(task.objects["cube"], mass_kg=mass_kg)}
    poses = {
        "cube": standing(0.48, -0.15, 0.02) if cube is None else cube,
        "box": standing(0.5, 0.19, 0.0, 0.0),
    }
    return problem(replace(task, objects=objects), poses, robot=robot)


def two_cubes(lower: np.ndarray, other: np.ndarray) -> Problem:
    task = load_task("stack_two_cubes")
    names = list(task.objects)
    return problem(task, dict(zip(names, (lower, other), strict=False)))


def refusal(given: Problem, object_id: str) -> NoPlanError:
    with pytest.raises(NoPlanError) as caught:
        GraspSearcher(given, replace(FEW, samples=400)).search(object_id)
    return caught.value


@pytest.fixture(scope="module")
def cube_search() -> tuple[Problem, GraspSearch]:
    given = cube_problem()
    return given, GraspSearcher(given).search("cube")


@pytest.mark.parametrize(
    ("name", "key"),
    [
        ("cube_into_box", "cube"),
        ("five_ducks_into_basket", "duck_1"),
        ("sloth_into_basket", "sloth"),
    ],
)
def test_there_are_many_grasps_and_none_is_wider_than_the_hand(name: str, key: str) -> None:
    task = load_task(name)
    poses = task.draw_start(np.random.default_rng(1))
    found = GraspSearcher(problem(task, poses)).search(key)
    limit_m = read_robot(UR5).gripper.max_width_m - 2 * CLEARANCE_M
    assert len(found.grasps) >= 50
    assert max(grasp.width_m for grasp in found.grasps) <= limit_m
    margins = [grasp.margin for grasp in found.grasps]
    assert margins == sorted(margins, reverse=True)
    assert min(margins) >= GraspConfig().least_margin
    assert set(found.rejected) <= set(CAUSES)


def test_the_arm_is_where_its_joints_put_the_hand(
    cube_search: tuple[Problem, GraspSearch],
) -> None:
    given, search = cube_search
    for grasp in search.grasps:
        T = given.scene.Ts_base_object["cube"] @ grasp.T_object_tcp
        np.testing.assert_allclose(given.robot.T_base_tcp(grasp.joints_rad), T, atol=1e-6)
        assert (grasp.joints_rad >= given.robot.lower_rad).all()
        assert (grasp.joints_rad <= given.robot.upper_rad).all()


def test_pads_face_each_other_across_the_object_and_the_hand_comes_from_above(
    cube_search: tuple[Problem, GraspSearch],
) -> None:
    given, search = cube_search
    for grasp in search.grasps:
        T = grasp.T_object_tcp
        across = np.abs(T[:3, 1]).argmax()  # from one face of the cube to the one opposite
        assert grasp.width_m * abs(T[across, 1]) == pytest.approx(0.04, abs=4e-5)
        away = np.delete(T[:3, 3], across)
        assert (np.abs(away) < 0.02 + 0.012).all()
        assert np.abs(T[:3, 1]).max() >= np.cos(CONE_RAD) - 1e-9
        approach = given.scene.Ts_base_object["cube"][:3, :3] @ T[:3, 2]
        assert approach[2] <= -np.cos(MOST_TILT_RAD) + 1e-9


def test_no_hull_of_the_open_hand_is_in_the_object_or_the_table(
    cube_search: tuple[Problem, GraspSearch],
) -> None:
    """Against coal's exact distances, which the search does not use."""
    given, search = cube_search
    hulls = hulls_of(given.robot)
    T = given.scene.Ts_base_object["cube"]
    cube, place = coal.Box(0.04, 0.04, 0.04), coal.Transform3s(T[:3, :3], T[:3, 3])
    grasps = search.grasps
    for grasp in grasps[::4]:
        hulls.place(grasp.joints_rad, grasp.open_m)
        for index, hull in enumerate(hulls.hulls):
            if hull.link not in given.robot.record.gripper.links:
                continue
            away = signed_distance(hull.shape, hulls.placement(index), cube, place)
            corners = hull.points_m @ hulls.rotations[index].T + hulls.translations[index]
            assert away > 0
            assert corners[:, 2].min() > 0


def test_no_two_grasps_are_alike(cube_search: tuple[Problem, GraspSearch]) -> None:
    found = cube_search[1].grasps
    Ts = np.stack([grasp.T_object_tcp for grasp in found])
    for i, T in enumerate(Ts):
        others = Ts[i + 1 :]
        near = np.linalg.norm(others[:, :3, 3] - T[:3, 3], axis=1) <= LENGTH_M
        for sign in (1.0, -1.0):
            R = np.einsum("nji,jk->nik", others[:, :3, :3], T[:3, :3] * [sign, sign, 1.0])
            assert not (near & (se3.rotation_angle_rad(R) < ANGLE_RAD - 1e-6)).any()


def test_the_surest_grasp_of_a_cube_is_near_its_middle(
    cube_search: tuple[Problem, GraspSearch],
) -> None:
    T = cube_search[1].grasps[0].T_object_tcp
    sideways = T[:3, 3] @ T[:3, 0]
    assert abs(sideways) < 0.008


@pytest.mark.parametrize("robot", ["panda", "xarm7_parallel_gripper", "ur10e_parallel_gripper"])
def test_other_arms_with_fingers_find_grasps(robot: str) -> None:
    given = cube_problem(standing(0.45, 0.05, 0.02), robot=robot)
    found = GraspSearcher(given, replace(FEW, most=3)).search("cube")
    for grasp in found.grasps:
        T = given.scene.Ts_base_object["cube"] @ grasp.T_object_tcp
        off = given.robot.T_base_tcp(grasp.joints_rad) - T
        assert np.abs(off[:3, 3]).max() < 0.0005
        assert grasp.open_m == given.robot.record.gripper.max_width_m


def test_what_stands_beside_is_kept_clear_of() -> None:
    free = two_cubes(standing(0.45, -0.1, 0.02, 0.0), standing(0.45, 0.2, 0.02, 0.0))
    tight = two_cubes(standing(0.45, -0.1, 0.02, 0.0), standing(0.45, -0.055, 0.02, 0.0))
    key = next(iter(free.scene.task.objects))
    assert "neighbour" not in GraspSearcher(free, FEW).search(key).rejected
    found = GraspSearcher(tight, FEW).search(key)
    assert found.rejected["neighbour"] > 0
    # 5 mm between the cubes: no finger fits there, so none closes along the line between them
    for grasp in found.grasps:
        assert abs(grasp.T_object_tcp[1, 1]) < 0.7


def among_cubes(gap_m: float) -> Problem:
    """A cube with one at each end of its y axis, so far away, and one right before it."""
    side_m, task = 0.035, load_task("sort_by_colour")
    far = {key: standing(0.3, 0.5, 0.0, 0.0) for key in ("pink_box", "cyan_box")}
    near = {
        "red": standing(0.45, -0.1, side_m / 2, 0.0),
        "yellow": standing(0.45, -0.1 + side_m + gap_m, side_m / 2, 0.0),
        "blue": standing(0.45, -0.1 - side_m - gap_m, side_m / 2, 0.0),
        "green": standing(0.45 + side_m + 0.005, -0.1, side_m / 2, 0.0),
    }
    return problem(task, far | near)


def test_where_no_finger_fits_the_neighbours_are_named() -> None:
    assert refusal(among_cubes(0.008), "red").cause == "neighbour"


def test_a_less_certain_pose_leaves_less_margin() -> None:
    task, poses = load_task("cube_into_box"), {"cube": standing(0.48, -0.15, 0.02)}
    margins = [
        GraspSearcher(problem(task, poses, covariances={"cube": SURE * scale}), FEW)
        .search("cube")
        .grasps[0]
        .margin
        for scale in (1.0, 16.0)
    ]
    assert margins[0] > margins[1] + 0.5


def test_what_stood_in_for_something_unknown_is_said() -> None:
    task, poses = load_task("cube_into_box"), {"cube": standing(0.48, -0.15, 0.02)}
    said = " ".join(GraspSearcher(problem(task, poses, covariances={}), FEW).search("cube").remarks)
    assert "task file" in said
    assert "5 mm assumed" in said


def test_what_lies_under_something_is_not_grasped_and_that_is_named() -> None:
    given = two_cubes(standing(0.45, -0.1, 0.02), standing(0.455, -0.1, 0.06))
    lower, upper = list(given.scene.task.objects)[:2]
    error = refusal(given, lower)
    assert error.cause == "covered"
    assert upper in str(error)
    assert GraspSearcher(given, FEW).search(upper).grasps


def test_what_is_too_far_away_is_not_reached() -> None:
    error = refusal(cube_problem(standing(1.3, 0.0, 0.02)), "cube")
    assert error.cause == "reach"
    assert "reach " in str(error)


@pytest.mark.parametrize(
    ("size_m", "causes", "text"),
    [((0.1, 0.1, 0.1), ("width",), "85 mm"), ((0.05, 0.05, 0.005), ("table", "tilt"), "")],
)
def test_what_is_wider_than_the_hand_or_flat_on_the_table_is_not_grasped(
    size_m: tuple[float, float, float], causes: tuple[str, ...], text: str
) -> None:
    task = load_task("cube_into_box")
    objects = task.objects | {"cube": replace(task.objects["cube"], size_m=size_m)}
    given = problem(replace(task, objects=objects), {"cube": standing(0.48, 0.0, size_m[2] / 2)})
    error = refusal(given, "cube")
    assert error.cause in causes
    assert text in str(error)


def test_what_is_too_heavy_for_the_pads_is_not_grasped() -> None:
    assert refusal(cube_problem(mass_kg=3.0), "cube").cause == "weight"


def test_an_arm_without_fingers_grasps_nothing() -> None:
    given = cube_problem(robot="kinova_j2s6s200")
    with pytest.raises(NoPlanError) as caught:
        GraspSearcher(given)
    assert caught.value.cause == "no_gripper"
    assert "kinova" in str(caught.value)
