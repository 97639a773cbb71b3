"""Paths around things and lines near contact: found, repeatable, timed within the limits."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from path_scene import EPS_M, WIDTH_M, Pairs, at, joints_at, tool_down

from bridge.geometry import se3
from twin.plan.grasp.reach import nearest_solutions
from twin.plan.path import planner
from twin.plan.path.planner import Mover, NoPathError, PathConfig, limits_of, timed_path
from twin.plan.path.transfer import Leg, PickAndPlace
from twin.plan.path.world import Carried, build_world
from twin.plan.problem import Grasp, Problem, Release, TimedPath
from twin.replay.motion import motion_failures
from twin.replay.path import JointPath

CONFIG = PathConfig()


def mover(pairs: Pairs, config: PathConfig = CONFIG) -> Mover:
    return Mover(problem=pairs.problem, config=config, width_m=WIDTH_M)


def moved(pairs: Pairs, index: int, config: PathConfig = CONFIG) -> TimedPath:
    return mover(pairs, config).around(pairs.starts[index], pairs.goals[index][None])


def straight(pairs: Pairs, index: int) -> TimedPath:
    shares = np.linspace(0, 1, 60)
    way = pairs.starts[index] + shares[:, None] * (pairs.goals[index] - pairs.starts[index])
    return TimedPath(times_s=shares, joints_rad=way)


def found(pairs: Pairs, index: int, seed: int = 0, shortcuts: int = 60) -> tuple:
    """Native search alone: outcome, pair, knots, postures."""
    start, goals = pairs.starts[index], pairs.goals[index][None]
    return pairs.world.motion.find(start, goals, seed, 1.0, 5000, 150_000, shortcuts)


def test_a_way_is_found_around_box_post_wall_and_the_arm_itself(pairs: Pairs) -> None:
    for index in range(len(pairs.kinds)):
        outcome, _, knots, postures = found(pairs, index)
        assert outcome == 0
        assert np.array_equal(knots[0], pairs.starts[index])
        assert np.array_equal(knots[-1], pairs.goals[index])
        assert pairs.world.motion.blocked(knots) < 0
        assert 0 < postures < 20_000


def test_where_going_straight_is_refused_the_planned_way_is_not(pairs: Pairs) -> None:
    index = pairs.kinds.index("post")
    assert not mover(pairs).refused(moved(pairs, index))
    refused = mover(pairs).refused(straight(pairs, index))
    assert "post" in {body for refusal in refused for body in refusal.bodies}


def test_the_same_seed_gives_the_same_bytes_and_another_one_another_way(pairs: Pairs) -> None:
    first, again, other = found(pairs, 4), found(pairs, 4), found(pairs, 4, seed=5)
    assert first[2].tobytes() == again[2].tobytes()
    assert first[3] == again[3]
    assert other[2].tobytes() != first[2].tobytes()
    fresh = build_world(pairs.problem, width_m=WIDTH_M, eps_col_m=EPS_M)
    anew = found(replace(pairs, world=fresh), 4)
    assert anew[2].tobytes() == first[2].tobytes()
    assert anew[3] == first[3]


def length_of(knots: np.ndarray) -> float:
    return float(np.linalg.norm(np.diff(knots, axis=0), axis=1).sum())


def test_shortcuts_make_a_way_shorter(pairs: Pairs) -> None:
    lengths = [
        sum(length_of(found(pairs, i, shortcuts=count)[2]) for i in range(len(pairs.kinds)))
        for count in (0, 200)
    ]
    assert lengths[1] < 0.97 * lengths[0]


def test_of_several_goals_one_is_reached_and_those_that_touch_are_left_out(pairs: Pairs) -> None:
    start, goal = pairs.starts[0], pairs.goals[0]
    inside = joints_at(pairs.problem, tool_down(0.42, 0.05, 0.1, 0.0), start)  # in the wall
    path = mover(pairs).around(start, np.stack([inside, goal]))
    assert np.array_equal(path.joints_rad[-1], goal)


@pytest.mark.parametrize("end", ["start", "goal"])
def test_an_end_that_touches_is_refused_by_the_names_of_the_pair(pairs: Pairs, end: str) -> None:
    inside = joints_at(pairs.problem, tool_down(0.42, 0.05, 0.2, np.pi / 2), None)
    ends = (inside, pairs.goals[0]) if end == "start" else (pairs.starts[0], inside)
    with pytest.raises(NoPathError, match=f"{end} touches: .* and wall") as caught:
        mover(pairs).around(ends[0], ends[1][None])
    assert caught.value.bodies[1] == "wall"


def test_numbers_that_are_none_limits_and_budgets_are_refused(pairs: Pairs) -> None:
    start, goal = pairs.starts[0], pairs.goals[0]
    for wrong, reason in ((np.nan, "outside the joint limits"), (50.0, "outside the joint limits")):
        beyond = goal.copy()
        beyond[2] = wrong
        with pytest.raises(NoPathError, match=reason):
            mover(pairs).around(start, beyond[None])
    few = replace(CONFIG, max_postures=60)
    with pytest.raises(NoPathError, match="budget spent"):
        mover(pairs, few).around(start, goal[None])
    outcome, *_, postures = pairs.world.motion.find(start, goal[None], 0, 1.0, 5000, 60, 60)
    assert outcome == 3
    assert 60 <= postures < 300


def test_a_goal_behind_walls_all_around_spends_the_budget_and_no_more(pairs: Pairs) -> None:
    scene = pairs.problem.scene
    model = replace(scene.task.objects["wall"], size_m=(1.2, 0.02, 1.6))
    task = replace(scene.task, objects={**scene.task.objects, "wall": model})
    poses = {**scene.Ts_base_object, "wall": at(0.75, 0.02, 0.8)}
    closed = replace(pairs.problem, scene=replace(scene, task=task, Ts_base_object=poses))
    index = pairs.kinds.index("wall")
    config = replace(CONFIG, max_nodes=150, max_postures=20_000)
    with pytest.raises(NoPathError) as caught:
        moved(replace(pairs, problem=closed), index, config)
    assert caught.value.reason in ("budget spent", "start touches", "goal touches")


def test_what_is_refused_is_searched_again_with_the_pair_farther_apart(
    pairs: Pairs, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A check that wants a link 10 mm farther from something between the ends gets it."""
    index = pairs.kinds.index("wall")
    near = moved(pairs, index)
    motion = pairs.world.motion

    def least_m(rows: np.ndarray, pair: int) -> float:
        return min(motion.distance(row, pair)[0] for row in rows)

    def at_ends_m(pair: int) -> float:
        return least_m(near.joints_rad[[0, -1]], pair)

    walls = [i for i, pair in enumerate(pairs.world.names) if pair[1] in ("wall", "post", "box")]
    rows = near.joints_rad
    nearer = max(walls, key=lambda pair: at_ends_m(pair) - least_m(rows, pair))
    bodies, before_m = pairs.world.names[nearer], least_m(rows, nearer)
    wanted_m = before_m + 0.01
    assert at_ends_m(nearer) > wanted_m
    asked: list[TimedPath] = []

    def strict(self: Mover, timed: TimedPath) -> tuple[NoPathError, ...]:
        asked.append(timed)
        if len(asked) > 1:
            return refused(self, timed)
        return (NoPathError(reason="refused", bodies=bodies, lacking_m=wanted_m),)

    refused = Mover.refused
    monkeypatch.setattr(Mover, "refused", strict)
    farther = moved(pairs, index)
    assert 2 <= len(asked) <= CONFIG.rounds  # margins grow with speed
    assert least_m(farther.joints_rad, nearer) >= wanted_m


def test_what_stays_refused_is_not_handed_out(
    pairs: Pairs, monkeypatch: pytest.MonkeyPatch
) -> None:
    refusal = NoPathError(reason="refused", bodies=("forearm_link", "post"), lacking_m=0.001)
    monkeypatch.setattr(Mover, "refused", lambda *asked: (refusal,))
    with pytest.raises(NoPathError, match="refused: forearm_link and post") as caught:
        moved(pairs, 0, replace(CONFIG, rounds=2))
    assert caught.value.bodies == ("forearm_link", "post")


def test_a_carried_object_is_taken_around_too(pairs: Pairs) -> None:
    """A cube in the hand passes higher over the wall than the empty hand does."""
    problem, index = pairs.problem, pairs.kinds.index("wall")
    long = np.eye(4)
    long[2, 3] = 0.03
    carried = Carried(object_id="cube", T_tcp_object=long)
    allowed = frozenset({frozenset(("gripper", "cube"))})
    full = build_world(problem, width_m=0.04, eps_col_m=EPS_M, carried=carried, allowed=allowed)
    holding = replace(mover(pairs), width_m=0.04, carried=carried, allowed=allowed)
    path = holding.around(pairs.starts[index], pairs.goals[index][None])
    assert not holding.refused(path)
    wall = [i for i, pair in enumerate(full.names) if pair == ("cube", "wall")]
    least = min(full.motion.distance(row, wall[0])[0] for row in path.joints_rad)
    assert least >= EPS_M
    # The way that was found without it leads it into the wall.
    outcome, *_, knots, _ = found(pairs, index)
    assert outcome == 0
    assert full.motion.blocked(knots) >= 0 or least > EPS_M


def grasp_of(problem: Problem) -> Grasp:
    T = problem.scene.Ts_base_object["cube"]
    T_tool = tool_down(*T[:2, 3], 0.022, float(np.arctan2(T[1, 0], T[0, 0])))
    joints = joints_at(problem, T_tool, None)
    assert joints is not None
    return Grasp(
        object_id="cube", T_object_tcp=se3.invert(T) @ T_tool, width_m=0.04, open_m=0.085,
        margin=1.0, joints_rad=joints, pregrasp_m=0.08,
    )  # fmt: skip


def release_of(grasp: Grasp, T_base_object: np.ndarray) -> Release:
    return Release(
        object_id="cube", T_base_object=T_base_object, cost=0.0,
        T_base_tcp=T_base_object @ grasp.T_object_tcp,
    )  # fmt: skip


def planned(problem: Problem, grasp: Grasp, release: Release) -> tuple[Leg, ...]:
    move = PickAndPlace(problem=problem, grasp=grasp, release=release, config=CONFIG)
    return move.legs(problem.robot.home_rad)


def test_a_straight_line_is_straight_on_one_branch_and_slow(pairs: Pairs) -> None:
    problem, robot = pairs.problem, pairs.problem.robot
    grasp = grasp_of(problem)
    T = robot.T_base_tcp(grasp.joints_rad)
    goal = T.copy()
    goal[2, 3] += 0.1
    allowed = problem.contacts_of("grasp", "cube")
    mover = planner.Mover(problem=problem, config=CONFIG, width_m=0.085, allowed=allowed)
    path = mover.straight(grasp.joints_rad, goal)
    tips = robot.Ts_base_tcp(path.joints_rad)
    assert np.abs(tips[:, :2, 3] - T[:2, 3]).max() < 0.0005
    assert np.abs(tips[:, :3, :3] - T[:3, :3]).max() < 0.002
    assert tips[-1] == pytest.approx(goal, abs=1e-6)
    assert (np.diff(tips[:, 2, 3]) > 0).all()
    assert np.abs(np.diff(path.joints_rad, axis=0)).max() < 0.1
    speeds = np.linalg.norm(np.diff(tips[:, :3, 3], axis=0), axis=1) / np.diff(path.times_s)
    assert speeds.max() <= 1.01 * planner.CONTACT_M_S
    back = planner.reversed_path(path)
    assert np.array_equal(back.joints_rad[0], path.joints_rad[-1])
    assert back.times_s[0] == 0.0
    assert (np.diff(back.times_s) > 0).all()


def test_a_straight_line_into_something_or_out_of_reach_is_refused(pairs: Pairs) -> None:
    problem = pairs.problem
    start = joints_at(problem, tool_down(0.42, -0.1, 0.1, 0.0), None)
    assert start is not None
    mover = planner.Mover(problem=problem, config=CONFIG, width_m=0.085)
    with pytest.raises(planner.NoPathError, match=r"refused: gripper_.* and wall"):
        mover.straight(start, tool_down(0.42, 0.1, 0.1, 0.0))
    with pytest.raises(planner.NoPathError, match=r"unreachable .* of 1\d{3} mm"):
        mover.straight(start, tool_down(0.42, -1.5, 0.1, 0.0))


def test_a_cube_is_taken_into_the_box_around_what_stands_between(pairs: Pairs) -> None:
    problem, robot = pairs.problem, pairs.problem.robot
    grasp = grasp_of(problem)
    release = release_of(grasp, at(0.5, 0.25, 0.027, 0.1))
    legs = planned(problem, grasp, release)
    assert [leg.name for leg in legs] == ["around", "approach", "lift", "carry", "lower", "leave"]
    assert [leg.g for leg in legs] == [0, 0, 1, 1, 1, 0]
    assert np.array_equal(legs[0].path.joints_rad[0], robot.home_rad)
    for before, after in pairwise(legs):
        ends = before.path.joints_rad[-1], after.path.joints_rad[0]
        assert np.array_equal(*ends)
    assert np.array_equal(legs[1].path.joints_rad[-1], grasp.joints_rad)
    tool = robot.T_base_tcp(legs[4].path.joints_rad[-1])
    assert tool == pytest.approx(release.T_base_tcp, abs=1e-6)


def test_the_movement_that_does_not_exist_is_named(pairs: Pairs) -> None:
    problem = pairs.problem
    grasp = grasp_of(problem)
    beyond = release_of(grasp, at(1.6, 0.2, 0.03))
    with pytest.raises(planner.NoPathError, match="unreachable"):
        planned(problem, grasp, beyond)
    in_wall = release_of(grasp, at(0.42, 0.05, 0.03))
    with pytest.raises(planner.NoPathError, match="for 'lower'") as caught:
        planned(problem, grasp, in_wall)
    assert caught.value.leg == "lower"


def test_all_branches_come_nearest_first(pairs: Pairs) -> None:
    robot = pairs.problem.robot
    near = pairs.starts[0]
    found = nearest_solutions(robot, robot.T_base_tcp(near), near)
    assert len(found) > 2
    assert found[0] == pytest.approx(near, abs=1e-6)
    away = [np.abs(joints - near).sum() for joints in found]
    assert away == sorted(away)
    for joints in found:
        assert robot.T_base_tcp(joints) == pytest.approx(robot.T_base_tcp(near), abs=1e-6)


FAST = replace(CONFIG, speed_share=1.0, acceleration_share=1.0)


def timed(pairs: Pairs, rows: np.ndarray, *, tool: float = 0.0, rounding: bool = True) -> tuple:
    speed, acceleration, _ = limits_of(pairs.problem.robot, FAST)
    times, joints, *_ = pairs.world.motion.time(rows, speed, acceleration, tool, 0.02, rounding)
    return times, joints


def knots_of(pairs: Pairs, index: int) -> np.ndarray:
    return pairs.world.motion.find(
        pairs.starts[index], pairs.goals[index][None], 3, 1.0, 5000, 150_000, 60
    )[2]


@pytest.mark.parametrize("length_rad", [0.05, 0.3, 1.4])
def test_one_joint_takes_the_time_of_a_trapezoid(pairs: Pairs, length_rad: float) -> None:
    speed, acceleration, _ = limits_of(pairs.problem.robot, FAST)
    home = pairs.problem.robot.home_rad
    goal = home + np.eye(6)[0] * length_rad
    times, joints = timed(pairs, np.stack([home, goal]))
    v, a = float(speed[0]), float(acceleration[0])
    triangle = 2 * np.sqrt(length_rad / a)
    expected = triangle if length_rad < v**2 / a else length_rad / v + v / a
    assert times[-1] == pytest.approx(expected, rel=0.01)
    assert np.array_equal(joints[-1], goal)
    assert (np.diff(joints[:, 0]) > 0).all()


def test_limits_of_speed_acceleration_and_tool_are_kept(pairs: Pairs) -> None:
    robot = pairs.problem.robot
    speed, acceleration, tool = limits_of(robot, CONFIG)
    for index in range(0, len(pairs.kinds), 3):
        path = timed_path(pairs.world, knots_of(pairs, index), CONFIG)
        step = np.diff(path.times_s)
        rates = np.diff(path.joints_rad, axis=0) / step[:, None]
        assert (np.abs(rates) <= 1.01 * speed).all()
        # At rest before and after.
        rates = np.vstack([np.zeros(6), rates, np.zeros(6)])
        middles = np.concatenate([[step[0]], (step[1:] + step[:-1]) / 2, [step[-1]]])
        assert (np.abs(np.diff(rates, axis=0)) / middles[:, None] <= 1.01 * acceleration).all()
        tips = robot.Ts_base_tcp(path.joints_rad)[:, :3, 3]
        assert (np.linalg.norm(np.diff(tips, axis=0), axis=1) / step).max() <= 1.01 * tool
        knots = JointPath(
            times_ns=np.round(path.times_s * 1e9).astype(np.int64),
            joints_rad=path.joints_rad,
            width_times_ns=np.array([0]),
            width_m=np.array([WIDTH_M]),
            first_close_ns=None,
        )
        assert motion_failures(knots, robot) == []


def test_rounded_corners_are_passed_without_a_stop_and_sharp_ones_with_one(pairs: Pairs) -> None:
    home = pairs.problem.robot.home_rad
    rows = home + np.array([[0, 0, 0, 0, 0, 0], [0.4, 0, 0, 0, 0, 0], [0.4, 0, 0, 0.4, 0, 0.0]])
    quick, quick_rows = timed(pairs, rows)
    slow, slow_rows = timed(pairs, rows, rounding=False)
    assert quick[-1] < 0.8 * slow[-1]
    speeds = np.linalg.norm(np.diff(quick_rows, axis=0), axis=1) / np.diff(quick)
    assert speeds[3:-3].min() > 0.3
    corner = np.abs(slow_rows - rows[1]).max(axis=1)
    assert corner.min() == pytest.approx(0.0, abs=1e-9)  # it is passed exactly
    assert np.abs(quick_rows - rows[1]).max(axis=1).min() > 0.01


def test_the_tool_is_no_faster_than_asked(pairs: Pairs) -> None:
    robot = pairs.problem.robot
    rows = np.stack([pairs.starts[0], pairs.starts[0] + 0.2])
    path = timed_path(pairs.world, rows, CONFIG, tool_m_s=0.05)
    tips = robot.Ts_base_tcp(path.joints_rad)[:, :3, 3]
    speeds = np.linalg.norm(np.diff(tips, axis=0), axis=1) / np.diff(path.times_s)
    assert 0.045 < speeds.max() <= 0.0505


def test_a_corner_beside_an_obstacle_is_rounded_less(pairs: Pairs) -> None:
    """Whatever was rounded, the way that is followed is free."""
    for index in range(len(pairs.kinds)):
        path = timed_path(pairs.world, knots_of(pairs, index), CONFIG)
        assert pairs.world.motion.blocked(path.joints_rad) < 0
