"""Laws of every kind of constraint: sign, unit, derivative, invariance, both libraries."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from block_scene import EXAMPLES, START, around, blocks, blocks_task, state

from bridge.errors import UsageError
from bridge.task.relations import RELATIONS
from twin.plan.constrain.bodies import box_of
from twin.plan.constrain.constraint import Constraint
from twin.plan.constrain.kinds import KINDS, compile_constraint
from twin.plan.constrain.relations import constraint_of, predicate_of

PATH_KINDS = {"speed"}
GOALS: list[dict[str, Any]] = [
    {"kind": "on", "object": "cube", "support": "brick", "margin_m": 0.004, "tolerance_m": 0.02},
    {"kind": "inside", "object": "cube", "container": "box", "margin_m": 0.01},
    {"kind": "beside", "object": "cube", "reference": "brick", "gap_m": [0.005, 0.05]},
    {"kind": "upright", "object": "cube", "tolerance_rad": 0.3},
    {"kind": "moved", "object": "cube", "at_least_m": 0.16, "direction": [0.3, 1.0, 0.0]},
    {"kind": "moved", "object": "cube", "target_m": [0.46, 0.01], "tolerance_m": 0.02},
    {"kind": "moved", "object": "cube", "by_m": 0.16, "direction": "left", "tolerance_m": 0.02},
]


def made(name: str) -> Constraint:
    return compile_constraint(EXAMPLES[name][0], blocks())


def test_every_kind_has_an_example() -> None:
    assert {record["kind"] for record, _, _ in EXAMPLES.values()} | PATH_KINDS == set(KINDS)


@pytest.mark.parametrize("name", EXAMPLES)
def test_f_is_at_most_zero_where_it_holds_and_above_zero_where_not(name: str) -> None:
    record, good, bad = EXAMPLES[name]
    constraint = compile_constraint(record, blocks())
    assert constraint.violation(good) <= 0, constraint.explain(good)
    assert constraint.violation(bad) > 0, constraint.explain(bad)
    assert "holds" in constraint.explain(good)
    assert "is violated" in constraint.explain(bad)
    assert "missed by" in constraint.explain(bad)


@pytest.mark.parametrize("name", EXAMPLES)
def test_along_a_path_the_worst_step_counts(name: str) -> None:
    constraint, steps = made(name), around(START, 5, np.random.default_rng(7))
    worst = constraint.worst_along(steps, np.arange(5.0))
    assert worst == constraint.violation(steps).max()


def test_what_was_not_localised_cannot_be_planned_with() -> None:
    scene = blocks().scene
    left = {key: T for key, T in scene.Ts_base_object.items() if key != "box"}
    lost = replace(scene, Ts_base_object=left, reasons={"box": "hidden by the arm"})
    problem = replace(blocks(), scene=lost)
    for name in ("inside", "above", "keepout over"):
        with pytest.raises(UsageError, match=r"box was not localised \(hidden by the arm\)"):
            compile_constraint(EXAMPLES[name][0], problem)
    compile_constraint(EXAMPLES["on"][0], problem)


def test_a_scene_that_was_not_rebuilt_has_no_distances() -> None:
    record = {"kind": "clearance", "obj": "cube", "against": "scene", "min": 0.02}
    with pytest.raises(UsageError, match="there is no rebuilt scene"):
        compile_constraint(record, blocks())


def test_a_state_that_is_no_number_does_not_hold() -> None:
    for name in EXAMPLES:
        lost = {key: np.full((4, 4), np.nan) for key in ("cube", "brick", "tcp")}
        assert not made(name).violation(state(**lost))[0] <= 0, name


@pytest.mark.parametrize("spec", GOALS)
def test_a_goal_is_the_same_predicate_again_when_it_was_a_constraint(spec: dict[str, Any]) -> None:
    record = constraint_of(spec, blocks_task())
    assert record is not None
    back = predicate_of(record)
    assert back.keys() == spec.keys()
    assert back == spec | {
        key: pytest.approx(spec[key]) for key in ("tolerance_rad",) if key in spec
    }


def test_what_is_about_no_pose_has_no_constraint() -> None:
    spec = {"kind": "settled", "object": "cube", "max_speed_m_s": 0.02, "for_s": 0.3}
    assert constraint_of(spec, blocks_task()) is None


def test_aligned_is_align_with_axes_that_may_point_either_way() -> None:
    spec = {"object": "brick", "reference": "post", "axis": "y", "reference_axis": "y"}
    states = around(START, 200, np.random.default_rng(8))
    record = constraint_of({"kind": "aligned", **spec}, blocks_task())
    boxes = {key: box_of(states, key, blocks()) for key in ("brick", "post")}
    (wanted,) = RELATIONS["aligned"](spec, boxes)
    f = compile_constraint(record or {}, blocks()).violation(states)
    np.testing.assert_allclose(f, wanted.excess, atol=1e-9)
    assert 0.02 < (f <= 0).mean() < 0.98
