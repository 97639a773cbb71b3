"""Paths around things: found, repeatable, checked, and clearly refused where there is none."""

from dataclasses import replace

import numpy as np
import pytest
from path_scene import EPS_M, WIDTH_M, Pairs, at, joints_at, tool_down

from twin.plan.path.planner import Mover, NoPathError, PathConfig
from twin.plan.path.world import Carried, build_world
from twin.plan.problem import TimedPath

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
