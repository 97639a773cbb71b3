"""What the native world says against pinocchio, coal and hulls looked at point by point."""

from collections import defaultdict
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from path_scene import EPS_M, WIDTH_M, Pairs, at, joints_at, problem_of_test, tool_down
from small_plans import plan_of
from twin.plan.path._motion import Motion

from bridge.robots.robot import read_robot
from twin.plan.path.world import BOX, Carried, build_world
from twin.replay.clearance.bodies import SCENE
from twin.replay.clearance.monitor import ClearanceMonitor
from twin.replay.clearance.surroundings import Surroundings
from twin.replay.config import ReplayConfig
from twin.robot.collision import RobotHulls, hulls_of
from twin.scene.shape.sdf import SdfGrid, distances_of_solid
from twin.scene.shape.static import StaticSdf

ROBOTS = (
    "ur5_parallel_gripper",
    pytest.param("panda", marks=pytest.mark.slow),
    pytest.param("kinova_j2s6s200", marks=pytest.mark.slow),
)


def exact_distances(surroundings: Surroundings, hulls: RobotHulls, Ts: dict) -> dict:
    """By coal, by the names of the pairs."""
    found = defaultdict(list)
    measured, _ = surroundings.measure(Ts, [], near_m=100.0, counts=lambda body, other: True)
    for (body, _, other, _), distance in measured.items():
        found[body, other].append(distance)
    for index, (one, other) in enumerate(hulls.pairs):
        names = hulls.hulls[one].link, hulls.hulls[other].link
        found[names].append(hulls.distance_m(*hulls.pairs[index]))
    return found


@pytest.mark.parametrize("name", ROBOTS)
def test_poses_are_pinocchios_and_distances_coals_for_every_arm(name: str) -> None:
    problem = problem_of_test(read_robot(name).description())
    robot = problem.robot
    world = build_world(problem, width_m=robot.record.gripper.max_width_m, eps_col_m=EPS_M)
    hulls = hulls_of(robot)
    surroundings = Surroundings(problem.scene, hulls, EPS_M)
    rng = np.random.default_rng(1)
    for _ in range(6):
        span = np.minimum(1.2, (robot.upper_rad - robot.lower_rad) / 2)
        joints = np.clip(
            robot.home_rad + rng.uniform(-span, span), robot.lower_rad, robot.upper_rad
        )
        assert world.motion.tool(joints) == pytest.approx(robot.T_base_tcp(joints)[:3, 3], abs=1e-9)
        hulls.place(joints, robot.record.gripper.max_width_m)
        expected = exact_distances(surroundings, hulls, problem.scene.movable())
        ours, spheres = defaultdict(list), defaultdict(list)
        for index, names in enumerate(world.names):
            least, most, bound = world.motion.distance(joints, index)
            assert least <= most + 1e-6
            ours[names].append(least)
            spheres[names].append(bound)
        assert set(ours) == set(expected)
        for names, distances in expected.items():
            for coal_m, own_m in zip(sorted(distances), sorted(ours[names]), strict=True):
                if coal_m > 1e-4:
                    assert own_m == pytest.approx(coal_m, abs=5e-6)
                else:
                    assert own_m <= 1e-4
            if min(distances) > 0:
                assert min(spheres[names]) <= min(distances) + 1e-6


def test_a_way_that_is_called_free_is_free_by_coal_all_along(pairs: Pairs) -> None:
    problem, world = pairs.problem, pairs.world
    hulls = hulls_of(problem.robot)
    surroundings = Surroundings(problem.scene, hulls, EPS_M)
    rng = np.random.default_rng(3)
    free = blocked = 0
    while free < 20:
        start = problem.robot.home_rad + rng.uniform(-1, 1, 6)
        way = np.stack([start, start + rng.uniform(-0.8, 0.8, 6)])
        if world.motion.blocked(way) >= 0:
            blocked += 1
            continue
        free += 1
        for share in np.linspace(0, 1, 21):
            hulls.place(way[0] + share * (way[1] - way[0]), WIDTH_M)
            distances, _ = surroundings.measure(
                problem.scene.movable(), [], near_m=EPS_M, counts=lambda body, other: True
            )
            assert min(distances.values()) >= EPS_M
            assert hulls.self_distance()[0] > 0
    assert blocked > 2


def slider(*, axis: tuple[float, float, float], slides: bool) -> Motion:
    """One joint with a small cube 0.3 m beside it."""
    motion = Motion(
        np.eye(4)[None], np.array([axis]), np.array([slides]), np.array([-3.0]), np.array([3.0]),
        np.array([0.3, 0.0, 0.0]),
    )  # fmt: skip
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * 0.01
    shift = np.array([0.3, 0.0, 0.0])
    motion.add_body(1, corners + shift, 0.0, 0, 0)
    return motion


def with_sheet(motion: Motion, T: np.ndarray) -> Motion:
    """A sheet of half a millimetre."""
    motion.add_box(T, np.array([0.2, 0.00025, 0.2]))
    motion.add_pair(0, BOX, 0, 0.001)
    motion.prepare()
    return motion


@pytest.mark.parametrize("slides", [True, False])
def test_a_sheet_between_two_free_postures_is_not_missed(slides: bool) -> None:
    """Also by joints that slide: no posture of the way's ends, nor of its middle, touches it."""
    axis = (0.0, 1.0, 0.0) if slides else (0.0, 0.0, 1.0)
    motion = with_sheet(slider(axis=axis, slides=slides), at(0.3, 0.06, 0.0))
    ends = np.array([[0.0], [0.7 if slides else 1.5]])
    for share in (0.0, 0.5, 1.0):
        assert motion.touching(ends[0] + share * (ends[1] - ends[0])) < 0
    assert motion.blocked(ends) == 0
    assert motion.blocked(np.array([[0.0], [-0.5]])) < 0
    # Close beside it: three millimetres are enough, half a one is not.
    for gap_m, free in ((0.003, True), (0.0005, False)):
        beside = 0.06 - 0.00025 - 0.01 - gap_m
        turned = beside if slides else None
        if turned is not None:
            assert (motion.blocked(np.array([[-0.4], [turned]])) < 0) is free


def test_what_is_carried_is_kept_away_from_what_stands_and_from_the_arm(pairs: Pairs) -> None:
    problem = pairs.problem
    carried = Carried(object_id="cube", T_tcp_object=np.eye(4))
    allowed = frozenset({frozenset(("gripper", "cube"))})
    empty = build_world(problem, width_m=0.04, eps_col_m=EPS_M)
    full = build_world(problem, width_m=0.04, eps_col_m=EPS_M, carried=carried, allowed=allowed)
    names = {pair for pair in full.names if "cube" in pair}
    assert {("cube", "table"), ("cube", "wall"), ("cube", "box")} <= names
    assert ("forearm_link", "cube") in names
    assert not {pair for pair in names if "finger" in pair[0] or "gripper" in pair[0]}
    assert ("gripper_base", "cube") in empty.names  # it stands on the table, and is not allowed


def test_what_only_a_scenes_grid_shows_is_kept_away_from(pairs: Pairs) -> None:
    """Distances are those of the clearance, and a post without a name is gone around."""
    voxel_m = 0.01
    solid = np.zeros((60, 70, 60), dtype=bool)
    solid[30:36, 30:36, :30] = True  # from (0.4, -0.2) on, six centimetres wide
    grid = SdfGrid(
        values_m=distances_of_solid(solid, voxel_m), origin_m=np.array([0.1, -0.5, -0.01]),
        voxel_m=voxel_m, closed=False,
    )  # fmt: skip
    static = StaticSdf(
        conservative=grid, observed=grid,
    )  # fmt: skip
    problem = replace(pairs.problem, scene=replace(pairs.problem.scene, static_sdf=static))
    world = build_world(problem, width_m=WIDTH_M, eps_col_m=EPS_M)
    hulls = hulls_of(problem.robot)
    surroundings = Surroundings(problem.scene, hulls, EPS_M)
    pairs_of_grid = {names[0]: i for i, names in enumerate(world.names) if names[1] == SCENE}
    assert len(pairs_of_grid) > 5
    rng = np.random.default_rng(5)
    near = 0
    for joints in problem.robot.home_rad + rng.uniform(-0.7, 0.7, (25, 6)):
        hulls.place(joints, WIDTH_M)
        measured, _ = surroundings.measure({}, [], near_m=9.0, counts=lambda a, b: True)
        for (body, _, other, _), distance in measured.items():
            if other == SCENE:
                least, _, bound = world.motion.distance(joints, pairs_of_grid[body])
                assert least == pytest.approx(distance, rel=0.021, abs=1e-6)
                assert bound <= least + 0.021 * abs(least) + 1e-6
                near += distance < 0.2
    assert near > 10
    start = joints_at(problem, tool_down(0.43, -0.32, 0.12, 0.0), None)
    goal = joints_at(problem, tool_down(0.43, -0.05, 0.14, np.pi / 2), start)
    assert start is not None
    assert goal is not None
    assert world.motion.blocked(np.stack([start, goal])) == 0
    outcome, _, knots, _ = world.motion.find(start, goal[None], 0, 1.0, 5000, 150_000, 60)
    assert outcome == 0
    nothing = plan_of(robot=problem.robot.name, tau=())
    monitor = ClearanceMonitor(problem.scene, nothing, hulls, ReplayConfig())
    for index, joints in enumerate(dense(knots)):
        assert monitor.measure(index, joints, WIDTH_M, {}) >= EPS_M


def dense(knots: np.ndarray) -> np.ndarray:
    shares = np.linspace(0, 1, 12)[:, None]
    return np.concatenate([a + shares * (b - a) for a, b in pairwise(knots)])
