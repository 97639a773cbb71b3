"""Constraints decide as the success predicates do, on 10,000 random states of each kind."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from block_scene import BESIDE, IN_BOX, ON_BRICK, OUT, START, around, blocks, blocks_task

from bridge.task.predicate import Rollout, evaluate_success
from twin.plan.constrain.kinds import compile_constraint
from twin.plan.constrain.relations import constraint_of
from twin.plan.problem import State

pytestmark = pytest.mark.parity
BOUNDARY = 1e-9
"""Metres or radians within which rounding may decide."""
CUBE, BRICK = {"object": "cube"}, {"object": "brick"}
BY_ITS_LEFT = {"reference": "brick", "direction": "left", "gap_m": [0.005, 0.05]}
SIDES = {"reference": "post", "axis": "y", "reference_axis": "y"}
SLANTED = {"at_least_m": 0.16, "direction": [0.3, 1.0, 0.0]}
PREDICATES: dict[str, tuple[dict[str, Any], State]] = {
    "on": ({"kind": "on", **CUBE, "support": "brick", "margin_m": 0.004}, ON_BRICK),
    "on the table": ({"kind": "on", **CUBE, "support": "table", "tolerance_m": 0.02}, START),
    "outside": ({"kind": "outside", **CUBE, "container": "box", "margin_m": 0.01}, OUT),
    "beside": ({"kind": "beside", **CUBE, "reference": "brick"}, BESIDE),
    "beside, left": ({"kind": "beside", **CUBE, **BY_ITS_LEFT}, BESIDE),
    "upright": ({"kind": "upright", **BRICK}, START),
    "upright cube": ({"kind": "upright", **CUBE, "tolerance_rad": 0.3}, START),
    "aligned": ({"kind": "aligned", **BRICK, **SIDES}, START),
    "aligned cube": ({"kind": "aligned", **CUBE, "reference": "brick"}, START),
    "inside": ({"kind": "inside", **CUBE, "container": "box", "margin_m": 0.01}, IN_BOX),
    "moved": ({"kind": "moved", **CUBE, **SLANTED}, ON_BRICK),
    "hardly moved": ({"kind": "moved", **CUBE, "at_most_m": 0.02}, START),
    "to": ({"kind": "moved", **CUBE, "target_m": [0.46, 0.01], "tolerance_m": 0.02}, ON_BRICK),
    "by": ({"kind": "moved", **CUBE, "by_m": 0.16, "direction": "left"}, ON_BRICK),
}


@pytest.mark.parametrize("count", [400, pytest.param(10_000, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", PREDICATES)
def test_a_constraint_decides_as_its_predicate(name: str, count: int) -> None:
    spec, start = PREDICATES[name]
    states = around(start, count, np.random.default_rng(8))
    task = replace(blocks_task(), success=(spec,))
    record = constraint_of(spec, task)
    assert record is not None
    f = compile_constraint(record, blocks()).violation(states)
    before = {key: Ts[0] for key, Ts in START.Ts_base_object.items()}
    decided = np.empty(count, dtype=bool)
    for index in range(count):
        after = {key: Ts[min(index, len(Ts) - 1)] for key, Ts in states.Ts_base_object.items()}
        rollout = Rollout(
            stamps_ns=np.array([0, 10**9]),
            Ts_base_object={key: np.stack([before[key], after[key]]) for key in before},
            finger_contact={},
        )
        decided[index] = evaluate_success(task, rollout)[0].value
    clear = np.abs(f) > BOUNDARY
    np.testing.assert_array_equal(f[clear] <= 0, decided[clear])
    assert clear.mean() > 0.99
    assert 0.02 < decided.mean() < 0.98, "equal decisions, both of them often"


def test_what_is_about_no_pose_has_no_constraint() -> None:
    spec = {"kind": "settled", "object": "cube", "max_speed_m_s": 0.02, "for_s": 0.3}
    assert constraint_of(spec, blocks_task()) is None
