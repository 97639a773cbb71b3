"""Constraints decide as the success predicates do, on 10,000 random states of each kind."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from block_scene import BESIDE, IN_BOX, ON_BRICK, OUT, START, around, blocks, blocks_task

from bridge.task.predicate import Rollout, evaluate_success
from bridge.task.relations import RELATIONS, Box
from twin.plan.constrain.kinds import compile_constraint
from twin.plan.constrain.relations import constraint_of
from twin.plan.problem import State

pytestmark = pytest.mark.parity
COUNTS = (400, pytest.param(10_000, marks=pytest.mark.slow))
BOUNDARY = 1e-9
"""Metres or radians within which rounding may decide."""

PREDICATES: dict[str, tuple[dict[str, Any], State]] = {
    "on": ({"kind": "on", "object": "cube", "support": "brick", "margin_m": 0.004}, ON_BRICK),
    "on the table": (
        {"kind": "on", "object": "cube", "support": "table", "tolerance_m": 0.02},
        START,
    ),
    "outside": ({"kind": "outside", "object": "cube", "container": "box", "margin_m": 0.01}, OUT),
    "beside": ({"kind": "beside", "object": "cube", "reference": "brick"}, BESIDE),
    "beside, left": (
        {
            "kind": "beside",
            "object": "cube",
            "reference": "brick",
            "direction": "left",
            "gap_m": [0.005, 0.05],
        },
        BESIDE,
    ),
    "upright": ({"kind": "upright", "object": "brick"}, START),
    "upright cube": ({"kind": "upright", "object": "cube", "tolerance_rad": 0.3}, START),
    "aligned": (
        {
            "kind": "aligned",
            "object": "brick",
            "reference": "post",
            "axis": "y",
            "reference_axis": "y",
        },
        START,
    ),
    "aligned cube": ({"kind": "aligned", "object": "cube", "reference": "brick"}, START),
}


def box_of(name: str, T: np.ndarray) -> Box:
    model = blocks_task().objects[name]
    T = T.copy()
    if not model.origin_at_centre:
        T[:3, 3] += T[:3, 2] * model.size_m[2] / 2
    half = np.array(model.size_m) / 2
    return Box(T_base_box=T, half_m=half, is_cube=model.symmetry == "cube")


def compared(f: np.ndarray, decided: np.ndarray) -> None:
    """Equal decisions away from the boundary, both of them often."""
    clear = np.abs(f) > BOUNDARY
    np.testing.assert_array_equal(f[clear] <= 0, decided[clear])
    assert clear.mean() > 0.99
    assert 0.02 < decided.mean() < 0.98


@pytest.mark.parametrize("count", COUNTS)
@pytest.mark.parametrize("name", PREDICATES)
def test_relations_between_bodies(name: str, count: int) -> None:
    spec, start = PREDICATES[name]
    states = around(start, count, np.random.default_rng(8))
    record = constraint_of(spec, blocks_task())
    assert record is not None
    f = compile_constraint(record, blocks()).violation(states)
    rule, decided = RELATIONS[spec["kind"]], np.empty(count, dtype=bool)
    still = {key: box_of(key, Ts[0]) for key, Ts in states.Ts_base_object.items() if len(Ts) == 1}
    for index in range(count):
        moved = {
            key: box_of(key, Ts[index])
            for key, Ts in states.Ts_base_object.items()
            if key not in still
        }
        decided[index] = rule(spec, still | moved)[0]
    compared(f, decided)


@pytest.mark.parametrize("count", COUNTS)
@pytest.mark.parametrize(
    ("spec", "start"),
    [
        ({"kind": "inside", "object": "cube", "container": "box", "margin_m": 0.01}, IN_BOX),
        (
            {"kind": "moved", "object": "cube", "at_least_m": 0.16, "direction": [0.3, 1.0, 0.0]},
            ON_BRICK,
        ),
        ({"kind": "moved", "object": "cube", "at_most_m": 0.02}, START),
        (
            {"kind": "moved", "object": "cube", "target_m": [0.46, 0.01], "tolerance_m": 0.02},
            ON_BRICK,
        ),
        ({"kind": "moved", "object": "cube", "by_m": 0.16, "direction": "left"}, ON_BRICK),
    ],
)
def test_predicates_about_one_object(spec: dict[str, Any], start: State, count: int) -> None:
    states = around(start, count, np.random.default_rng(9))
    task = replace(blocks_task(), success=(spec,))
    record = constraint_of(spec, task)
    assert record is not None
    f = compile_constraint(record, blocks()).violation(states)
    box, before = START.Ts_base_object["box"][0], START.Ts_base_object["cube"][0]
    stamps = np.array([0, 10**9])
    decided = np.empty(count, dtype=bool)
    for index, T in enumerate(states.Ts_base_object["cube"]):
        rollout = Rollout(
            stamps_ns=stamps,
            Ts_base_object={"cube": np.stack([before, T]), "box": np.stack([box, box])},
            finger_contact={},
        )
        decided[index] = evaluate_success(task, rollout)[0].value
    compared(f, decided)


def test_what_is_about_no_pose_has_no_constraint() -> None:
    spec = {"kind": "settled", "object": "cube", "max_speed_m_s": 0.02, "for_s": 0.3}
    assert constraint_of(spec, blocks_task()) is None
