"""Predicates about two objects and more: hand-worked cases, laws, what is refused."""

import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import linprog
from upright import upright as pose

import bridge.task
from bridge.geometry import se3
from bridge.task import predicate
from bridge.task.check import task_problems
from bridge.task.relations import SIDES, WAYS, Box, footprint_gap_m
from bridge.task.summary import describe_predicate
from bridge.task.task_file import Task, TaskFile, load_task

TEMPLATE = Path(str(bridge.task.__file__)).parent / "template.toml"
BASE = TaskFile(TEMPLATE.read_bytes(), "template.toml").task()
"""A cube of 40 mm and a block of 140 x 140 x 50 mm."""
BLOCK = BASE.objects["block"]
LONG = replace(BLOCK, id="long", size_m=(0.1, 0.02, 0.06), symmetry="none")
BOX = load_task("cube_into_box").objects["box"]
"""162 mm wide, 56 mm high."""
TASK = replace(BASE, objects=BASE.objects | {"long": LONG, "box": BOX})
angles = st.floats(-np.pi, np.pi)
metres = st.floats(-0.3, 0.3)


def gap_m(a: Box, b: Box) -> float:
    """Of many at once: the second of three is asked for."""
    many = (
        replace(box, T_base_box=np.stack([np.eye(4), box.T_base_box, np.eye(4)])) for box in (a, b)
    )
    return float(footprint_gap_m(*many)[1])


def rotation(axis: np.ndarray, angle_rad: float) -> np.ndarray:
    q = np.concatenate(([np.cos(angle_rad / 2)], np.sin(angle_rad / 2) * axis))
    return np.asarray(se3.rotation_from_quaternion(q))


def found(spec: dict[str, Any], task: Task = TASK, **Ts: np.ndarray) -> predicate.PredicateResult:
    """What a predicate says of poses; of an array of two, first and last."""
    stacked = {name: T if T.ndim == 3 else np.stack([T, T]) for name, T in Ts.items()}
    stamps = np.arange(2, dtype=np.int64)
    rollout = predicate.Rollout(stamps_ns=stamps, Ts_base_object=stacked, finger_contact={})
    return predicate.evaluate_success(replace(task, success=(spec,)), rollout)[0]


BESIDE = {"kind": "beside", "object": "cube", "reference": "block"}
OUTSIDE = {"kind": "outside", "object": "cube", "container": "box"}
BETWEEN = {"kind": "between", "object": "cube", "first": "block", "second": "long"}
UPRIGHT = {"kind": "upright", "object": "long"}
ALIGNED = {"kind": "aligned", "object": "long", "reference": "block"}
ON_TABLE = {"kind": "on", "object": "cube", "support": "table"}
T_BLOCK = pose(0.5, 0.0, 0.025)


@pytest.mark.parametrize(
    ("x", "y", "answer"),
    [
        (0.5, 0.0901, True),  # the gap begins at 70 + 20 mm
        (0.5, 0.0899, False),
        (0.5, 0.1899, True),  # and ends 100 mm further
        (0.5, 0.1901, False),
        (0.59 + 0.06, 0.09 + 0.0799, True),  # from corner to corner: 3-4-5
        (0.59 + 0.06, 0.09 + 0.0801, False),
    ],
)
def test_beside_is_a_gap_seen_from_above(x: float, y: float, answer: bool) -> None:
    assert found(BESIDE, cube=pose(x, y, 0.02), block=T_BLOCK).value is answer


@pytest.mark.parametrize(("word", "way"), [*SIDES.items()])
def test_each_side_is_where_the_robot_sees_it(word: str, way: tuple[float, ...]) -> None:
    spec = {**BESIDE, "direction": word}
    for sign, answer in ((1.0, True), (-1.0, False)):
        p = np.array([0.5, 0.0, 0.02]) + sign * 0.12 * np.array(way)
        assert found(spec, cube=pose(*p), block=T_BLOCK).value is answer


@given(angles, st.floats(0.13, 0.18))
def test_every_place_around_is_on_exactly_one_side(angle: float, far: float) -> None:
    T = pose(0.5 + far * np.cos(angle), far * np.sin(angle), 0.02)
    specs = [{**BESIDE, "direction": word, "gap_m": [0.0, 1.0]} for word in SIDES]
    values = [found(spec, cube=T, block=T_BLOCK).value for spec in specs]
    assert sum(value is True for value in values) == 1


@given(angles, angles, metres, metres, angles)
def test_a_turn_about_the_vertical_and_a_shift_change_no_relation(
    yaw: float, other_yaw: float, x: float, y: float, turn: float
) -> None:
    moved = pose(x, y, 0.0, turn)
    Ts = {
        "cube": pose(0.62, 0.05, 0.02, yaw),
        "block": T_BLOCK,
        "long": pose(0.8, 0.08, 0.03, other_yaw),
        "box": pose(0.7, 0.02, 0.0, yaw),
    }
    shifted = {name: moved @ T for name, T in Ts.items()}
    for spec in (BESIDE, OUTSIDE, BETWEEN, UPRIGHT, ALIGNED, ON_TABLE):
        assert found(spec, **Ts).detail == found(spec, **shifted).detail
    along = {**BESIDE, "direction": [0.6, 0.8, 0.0]}
    turned = {**along, "direction": (moved[:3, :3] @ along["direction"]).tolist()}
    assert found(along, **Ts).detail == found(turned, **shifted).detail


random_boxes = st.tuples(st.integers(0, 2**32 - 1), st.booleans())


@given(random_boxes)
def test_the_gap_is_that_of_the_projected_corners(
    drawn: tuple[int, bool],
) -> None:
    rng = np.random.default_rng(drawn[0])
    boxes = []
    for _ in range(2):
        axis = rng.normal(size=3)
        angle = rng.uniform(-3, 3)
        axis = np.array([0.0, 0.0, 1.0]) if drawn[1] else axis / np.linalg.norm(axis)
        T = se3.transform_from(np.array([1.0, 0, 0, 0]), rng.uniform(-0.1, 0.1, 3))
        T[:3, :3] = rotation(axis, angle)
        boxes.append(Box(T_base_box=T, half_m=rng.uniform(0.01, 0.06, 3)))
    gap, back = (gap_m(*each) for each in (boxes, boxes[::-1]))
    assert gap == pytest.approx(back, abs=1e-12)
    signs = np.stack(np.meshgrid(*[[-1, 1]] * 3), axis=-1).reshape(-1, 3)
    first, second = (se3.apply(b.T_base_box, signs * b.half_m)[:, :2] for b in boxes)
    if abs(gap) > 1e-6:  # a common point exists exactly where the gap is negative
        system = np.zeros((4, 16))
        system[:2, :8], system[:2, 8:] = first.T, -second.T
        system[2, :8] = system[3, 8:] = 1.0
        common = linprog(np.zeros(16), A_eq=system, b_eq=[0, 0, 1, 1]).success
        assert common is bool(gap < 0)
    if gap > 0:  # the gap is the widest strip between them, over all its directions
        ways = np.linspace(0, 2 * np.pi, 721)
        normals = np.stack((np.cos(ways), np.sin(ways)))
        widest = np.max((first @ normals).min(axis=0) - (second @ normals).max(axis=0))
        assert widest <= gap + 1e-9
        assert gap - widest < 0.2 * np.radians(0.25)  # half a step of the directions


def test_outside_is_wholly_out_and_above_the_box_is_not() -> None:
    T_box = pose(0.5, 0.0, 0.0)
    for x, z, answer in ((0.5, 0.03, False), (0.5, 0.3, False), (0.6, 0.02, False)):
        assert found(OUTSIDE, cube=pose(x, 0.0, z), box=T_box).value is answer
    edge = 0.5 + 0.081 + 0.02
    assert found(OUTSIDE, cube=pose(edge + 1e-4, 0.0, 0.02), box=T_box).value is True
    far = {**OUTSIDE, "margin_m": 0.01}
    assert found(far, cube=pose(edge + 0.009, 0.0, 0.02), box=T_box).value is False
    assert found(far, cube=pose(edge + 0.011, 0.0, 0.02), box=T_box).value is True


def test_between_needs_room_on_both_sides_and_the_line() -> None:
    T_long = pose(0.5, 0.3, 0.03)
    for y, answer in ((0.0899, False), (0.0901, True), (0.2699, True), (0.2701, False)):
        assert found(BETWEEN, cube=pose(0.5, y, 0.02), block=T_BLOCK, long=T_long).value is answer
    for x, answer in ((0.529, True), (0.531, False)):
        assert found(BETWEEN, cube=pose(x, 0.18, 0.02), block=T_BLOCK, long=T_long).value is answer
    high = found(BETWEEN, cube=pose(0.5, 0.18, 0.3), block=T_BLOCK, long=T_long)
    assert high.value is False
    swapped = {**BETWEEN, "first": "long", "second": "block"}
    assert found(swapped, cube=pose(0.5, 0.18, 0.02), block=T_BLOCK, long=T_long).value is True


@given(angles, st.floats(0.0, np.pi), angles)
def test_upright_is_the_angle_of_the_own_axis_to_the_vertical(
    yaw: float, tilt: float, about: float
) -> None:
    axis = np.array([np.cos(about), np.sin(about), 0.0])
    T = pose(0.4, 0.1, 0.1, yaw)
    T[:3, :3] = rotation(axis, tilt) @ T[:3, :3]
    for limit in (0.17, 0.5):
        if abs(tilt - limit) > 1e-6:
            value = found({**UPRIGHT, "tolerance_rad": limit}, long=T).value
            assert value is (tilt < limit)


@given(angles)
def test_aligned_axes_may_point_either_way(yaw: float) -> None:
    off = abs((yaw + np.pi / 2) % np.pi - np.pi / 2)
    if abs(off - 0.17) > 1e-6:
        plain = replace(TASK, objects=TASK.objects | {"block": replace(BLOCK, symmetry="none")})
        value = found(ALIGNED, plain, long=pose(0.4, 0.2, 0.03, yaw), block=T_BLOCK).value
        assert value is (off < 0.17)
        across = {**ALIGNED, "axis": "y"}
        turned = pose(0.4, 0.2, 0.03, yaw - np.pi / 2)
        assert found(across, plain, long=turned, block=T_BLOCK).value is value


def test_the_table_has_no_edges() -> None:
    for z, answer in ((0.02, True), (0.0279, True), (0.0281, False), (0.07, False)):
        assert found(ON_TABLE, cube=pose(5.0, -3.0, z)).value is answer


@pytest.mark.parametrize(("word", "way"), [*WAYS.items()])
def test_moved_by_a_distance_along_a_named_way(word: str, way: tuple[float, ...]) -> None:
    spec = {"kind": "moved", "object": "cube", "by_m": 0.1, "direction": word}
    start = np.array([0.5, 0.1, 0.02])
    for length, answer in ((0.1, True), (0.119, True), (0.121, False), (0.0, False), (-0.1, False)):
        ends = np.stack([pose(*start), pose(*(start + length * np.array(way)))])
        assert found(spec, cube=ends).value is answer
    aside = start + 0.1 * np.array(way) + 0.021 * np.array([way[1], way[0], 0.0])
    assert found(spec, cube=np.stack([pose(*start), pose(*aside)])).value is False
    lower = start + 0.1 * np.array(way) - np.array([0.0, 0.0, 0.05])  # seen from above
    assert found(spec, cube=np.stack([pose(*start), pose(*lower)])).value is True


@pytest.mark.parametrize("spec", [BESIDE, OUTSIDE, BETWEEN, UPRIGHT, ALIGNED])
def test_what_is_not_localised_or_not_a_number_stays_open(spec: dict[str, Any]) -> None:
    Ts = {
        "cube": pose(0.4, 0.0, 0.02),
        "block": T_BLOCK,
        "long": pose(0.3, 0.0, 0.03),
        "box": pose(0.5, 0.5, 0.0),
    }
    named = predicate.bodies_of(spec)
    for name in named:
        answer = found(spec, **{key: T for key, T in Ts.items() if key != name})
        assert answer.value is None
        assert name in answer.detail
        assert found(spec, **{**Ts, name: np.full((4, 4), np.nan)}).value is None


def test_an_object_belongs_where_the_first_predicate_says() -> None:
    assert replace(TASK, success=(OUTSIDE, ON_TABLE)).goal_of("cube") == ("on", "table")
    assert replace(TASK, success=(OUTSIDE,)).goal_of("cube") == ("outside", "box")
    assert replace(TASK, success=(BETWEEN,)).goal_of("cube") == ("between", "block")
    assert replace(TASK, success=(UPRIGHT, BESIDE)).goal_of("cube") == ("beside", "block")
    assert replace(TASK, success=(UPRIGHT,)).goal_of("cube") is None


def problems(spec: dict[str, Any]) -> list[str]:
    table = tomllib.loads(TEMPLATE.read_text())
    table["success"] = [spec]
    return task_problems(table)


NEXT = {"kind": "beside", "object": "cube", "reference": "block"}
MOVED = {"kind": "moved", "object": "cube"}


@pytest.mark.parametrize(
    ("spec", "said"),
    [
        ({**NEXT, "direction": "lefft"}, "Did you mean 'left'"),
        ({**NEXT, "direction": [0, 0, 0]}, "has no length"),
        ({**NEXT, "direction": [0, 1, 1]}, "must be level"),
        ({**NEXT, "gap_m": [0.03, 0.01]}, "turn it round"),
        ({**NEXT, "reference": "cube"}, "beside itself"),
        ({**NEXT, "reference": "blok"}, "Did you mean 'block'"),
        ({**NEXT, "reference": "table"}, "no object 'table'"),
        ({**MOVED, "by_m": 0.1}, "needs a direction"),
        ({**MOVED, "by_m": 0.1, "direction": "up"}, "direction: 'up' is unknown"),
        ({**MOVED, "direction": "left"}, "says no limit"),
        ({**MOVED, "at_least_m": 1, "direction": [0, 0, 0]}, "success[0].direction: has no length"),
        ({**MOVED, "target_m": [1, 1]}, "belong together"),
        ({**MOVED, "at_least_m": 2, "at_most_m": 1}, "above"),
        ({**ON_TABLE, "support": "cube"}, "success[0].support: cube cannot be in, on"),
        ({"kind": "on", "object": "cube", "suport": "block"}, "Did you mean 'support'?"),
        ({**MOVED, "by_m": 0.1, "target_m": [0, 0], "direction": "left"}, "give one"),
        ({"kind": "outside", "object": "cube", "container": "block"}, "is no container"),
        (
            {"kind": "between", "object": "cube", "first": "block"},
            '"second" is a required property',
        ),
        ({"kind": "upright", "object": "cube", "tolerance_rad": 3}, "greater than the maximum"),
        ({"kind": "aligned", "object": "cube", "reference": "block", "axis": "w"}, "unknown"),
    ],
)
def test_a_relation_that_nobody_can_check_is_refused(spec: dict[str, Any], said: str) -> None:
    assert said in "\n".join(problems(spec))


@pytest.mark.parametrize(
    "spec",
    [
        {**NEXT, "direction": "in_front", "gap_m": [0.01, 0.03]},
        {**NEXT, "direction": [0.6, -0.8, 0]},
        ON_TABLE,
        {**MOVED, "by_m": 0.1, "direction": "right"},
        {"kind": "upright", "object": "cube"},
        {"kind": "aligned", "object": "cube", "reference": "block", "tolerance_rad": 0.1},
    ],
)
def test_a_good_relation_passes_and_is_said_in_words(spec: dict[str, Any]) -> None:
    assert problems(spec) == []
    assert "cube" in describe_predicate(spec)
