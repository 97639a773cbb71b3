"""``on`` and ``moved``: hand-worked cases, laws, and what stays open."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from upright import upright as pose

import bridge.task
from bridge.geometry import se3
from bridge.task import predicate
from bridge.task.summary import describe_predicate
from bridge.task.task_file import Task, TaskFile

TEXT = (Path(str(bridge.task.__file__)).parent / "template.toml").read_bytes()
TASK = TaskFile(TEXT, "template.toml").task()
"""A cube of 40 mm on a block of 140 x 140 x 50 mm."""
ON = {"kind": "on", "object": "cube", "support": "block"}
MOVED = {"kind": "moved", "object": "cube"}
metres = st.floats(-0.1, 0.1)


def asked(
    spec: dict[str, Any], poses: dict[str, list[np.ndarray]], task: Task = TASK
) -> predicate.PredicateResult:
    count = max(map(len, poses.values()))
    stacked = {name: np.stack(Ts if len(Ts) > 1 else Ts * count) for name, Ts in poses.items()}
    stamps = np.arange(count, dtype=np.int64)
    rollout = predicate.Rollout(stamps_ns=stamps, Ts_base_object=stacked, finger_contact={})
    return predicate.evaluate_success(replace(task, success=(spec,)), rollout)[0]


def on(T_cube: np.ndarray, T_block: np.ndarray | None = None, **limits: float) -> bool | None:
    block = pose(0.5, 0.2, 0.025) if T_block is None else T_block
    return asked({**ON, **limits}, {"cube": [T_cube], "block": [block]}).value


@pytest.mark.parametrize(
    ("x", "y", "z", "answer"),
    [
        (0.5, 0.2, 0.07, True),  # the block's top is at 50 mm, the cube's middle 20 mm above it
        (0.5, 0.2, 0.0779, True),
        (0.5, 0.2, 0.0781, False),  # 8.1 mm in the air
        (0.5, 0.2, 0.0619, False),  # 8.1 mm inside the block
        (0.5, 0.2, 0.02, False),  # beside or inside: at the height of the table
        (0.5699, 0.2, 0.07, True),  # the edge is at x 570 mm
        (0.5701, 0.2, 0.07, False),
        (0.5, 0.1301, 0.07, True),
        (0.5, 0.1299, 0.07, False),
    ],
)
def test_a_cube_is_on_the_block_at_its_top_and_within_its_edges(
    x: float, y: float, z: float, answer: bool
) -> None:
    assert on(pose(x, y, z)) is answer


def test_a_cube_on_its_edge_is_higher_and_still_on() -> None:
    turned = pose(0.5, 0.2, 0.05 + 0.02 * np.sqrt(2))
    turned[:3, :3] = se3.rotation_from_quaternion(
        np.array([np.cos(np.pi / 8), np.sin(np.pi / 8), 0.0, 0.0])
    )
    assert on(turned, tolerance_m=0.001) is True
    turned[2, 3] = 0.07
    assert on(turned, tolerance_m=0.001) is False


def test_the_face_that_looks_up_counts_whichever_it_is() -> None:
    lying = {"block": replace(TASK.objects["block"], size_m=(0.05, 0.14, 0.14))}
    task = replace(TASK, objects=TASK.objects | lying)
    T_block = pose(0.5, 0.2, 0.025)
    T_block[:3, :3] = np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])  # x looks up
    for x, answer in ((0.5, True), (0.56, True), (0.58, False)):
        places = {"cube": [pose(x, 0.2, 0.07)], "block": [T_block]}
        assert asked(ON, places, task).value is answer


def test_on_a_soft_thing_its_present_extents_count() -> None:
    task = replace(TASK, success=(ON,))
    rollout = predicate.Rollout(
        stamps_ns=np.array([0]),
        Ts_base_object={"cube": pose(0.5, 0.2, 0.055)[None], "block": pose(0.5, 0.2, 0.025)[None]},
        finger_contact={},
    )
    assert predicate.evaluate_success(task, rollout)[0].value is False
    pressed = replace(rollout, extents_m={"cube": np.array([[0.05, 0.05, 0.012]])})
    assert predicate.evaluate_success(task, pressed)[0].value is True


@given(metres, metres, st.floats(0.05, 0.09), st.floats(0.0, 0.05), st.floats(0.0, 0.02))
def test_a_margin_takes_away_and_a_tolerance_adds(
    x: float, y: float, z: float, margin: float, tolerance: float
) -> None:
    T = pose(0.5 + x, 0.2 + y, z)
    plain = on(T, tolerance_m=0.008)
    if on(T, tolerance_m=0.008, margin_m=margin):
        assert plain is True
    if plain:
        assert on(T, tolerance_m=0.008 + tolerance) is True


def test_what_was_not_localised_leaves_the_answer_open() -> None:
    assert asked(ON, {"cube": [pose(0, 0, 0)]}).value is None
    assert asked(ON, {"block": [pose(0, 0, 0)]}).value is None
    assert asked({**MOVED, "at_least_m": 0.1}, {"block": [pose(0, 0, 0)]}).value is None
    unknown = [np.full((4, 4), np.nan), pose(0.3, 0, 0)]
    found = asked({**MOVED, "at_least_m": 0.1}, {"cube": unknown})
    assert (found.value, found.detail) == (None, "cube was not localised before")


def moved(dx: float, dy: float, dz: float = 0.0, **spec: Any) -> bool | None:
    way = [pose(0.4, -0.1, 0.02), pose(9.0, 9.0, 9.0), pose(0.4 + dx, -0.1 + dy, 0.02 + dz)]
    return asked({**MOVED, **spec}, {"cube": way}).value


def test_the_way_is_straight_from_the_first_state_to_the_last() -> None:
    assert moved(0.03, 0.04, at_least_m=0.0499) is True
    assert moved(0.03, 0.04, at_least_m=0.0501) is False
    assert moved(0.03, 0.04, at_most_m=0.0501) is True
    assert moved(0.03, 0.04, at_least_m=0.02, at_most_m=0.04) is False


def test_a_direction_counts_forwards_only_and_need_not_have_length_one() -> None:
    assert moved(0.1, 0.5, at_least_m=0.09, direction=[0.5, 0, 0]) is True
    assert moved(0.1, 0.5, at_most_m=0.11, direction=[0.5, 0, 0]) is True
    assert moved(-0.1, 0.0, at_least_m=0.09, direction=[1, 0, 0]) is False
    assert moved(-0.1, 0.0, at_most_m=0.0, direction=[1, 0, 0]) is True


def test_a_target_is_a_point_or_seen_from_above_a_place() -> None:
    assert moved(0.1, 0.0, 0.3, target_m=[0.5, -0.1], tolerance_m=0.01) is True
    assert moved(0.1, 0.0, 0.3, target_m=[0.5, -0.1, 0.02], tolerance_m=0.01) is False
    assert moved(0.1, 0.02, target_m=[0.5, -0.1], tolerance_m=0.0199) is False


@given(metres, metres, metres, st.floats(0.001, 0.2), st.floats(0.0, 0.1))
def test_limits_are_monotone(x: float, y: float, z: float, limit: float, more: float) -> None:
    assert moved(x, y, z, at_least_m=limit + more) in (moved(x, y, z, at_least_m=limit), False)
    if moved(x, y, z, at_most_m=limit):
        assert moved(x, y, z, at_most_m=limit + more) is True
    if moved(x, y, target_m=[0.4, -0.1], tolerance_m=limit):
        assert moved(x, y, target_m=[0.4, -0.1], tolerance_m=limit + more) is True


def start_of(T_cube: np.ndarray, *success: dict[str, Any]) -> bool:
    poses = {"cube": T_cube[None], "block": pose(0.5, 0.2, 0.025)[None]}
    rollout = predicate.Rollout(stamps_ns=np.array([0]), Ts_base_object=poses, finger_contact={})
    return predicate.already_true_at_start(replace(TASK, success=success), rollout)


def test_a_goal_that_holds_at_the_start_is_noticed_whatever_its_kind() -> None:
    there, elsewhere = pose(0.5, 0.2, 0.07), pose(0.3, 0.0, 0.02)
    still = {**MOVED, "at_most_m": 0.01}
    target = {**MOVED, "target_m": [0.5, 0.2], "tolerance_m": 0.01}
    assert start_of(there, ON)
    assert start_of(there, ON, still)
    assert start_of(there, target)
    assert not start_of(elsewhere, ON)
    assert not start_of(there, ON, {**MOVED, "at_least_m": 0.1})
    assert not start_of(there, still)  # to leave a thing where it is, is no goal
    assert [predicate.is_goal(spec) for spec in (ON, still, target)] == [True, False, True]


def test_words_name_every_limit() -> None:
    assert describe_predicate(ON).startswith("cube rests on block")
    text = describe_predicate({**MOVED, "at_least_m": 0.1, "direction": [1, 0, 0]})
    assert text == "cube has moved from its start (at_least_m 0.1, direction [1, 0, 0])"
