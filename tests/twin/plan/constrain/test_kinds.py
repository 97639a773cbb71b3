"""Laws of every kind of constraint: sign, unit, derivative, invariance, both libraries."""

from dataclasses import replace

import numpy as np
import pytest
from block_scene import EXAMPLES, START, around, blocks, state

from bridge.errors import UsageError
from bridge.task.relations import RELATIONS
from twin.plan.constrain.bodies import box_of
from twin.plan.constrain.constraint import Constraint
from twin.plan.constrain.kinds import compile_constraint
from twin.plan.constrain.schema import KINDS

OTHERS = {"speed", "between", "aligned"}
"""Asked of a path; of three bodies; and tested below."""


def made(name: str) -> Constraint:
    return compile_constraint(EXAMPLES[name][0], blocks())


def test_every_kind_has_an_example() -> None:
    assert {record["kind"] for record, _, _ in EXAMPLES.values()} | OTHERS == set(KINDS)


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
    record = {"kind": "clearance", "object": "cube", "against": "scene", "min": 0.02}
    with pytest.raises(UsageError, match="there is no rebuilt scene"):
        compile_constraint(record, blocks())


def test_a_state_that_is_no_number_does_not_hold() -> None:
    for name in EXAMPLES:
        lost = {key: np.full((4, 4), np.nan) for key in ("cube", "brick", "tcp")}
        assert not made(name).violation(state(**lost))[0] <= 0, name


def test_a_margin_is_told_as_within_and_by_how_much_it_was_missed() -> None:
    record, good, bad = EXAMPLES["inside"]
    constraint = compile_constraint({**record, "margin_m": 0.03}, blocks())
    assert constraint.wanted(bad) == "the middle of cube at least 30 mm within the cavity of box"
    told = constraint.explain(good)
    assert "is 24 mm within the cavity of box (wanted at least 30 mm within the" in told
    assert told.endswith(", missed by 6 mm)")
    assert "is 268.3 mm beyond the cavity of box (wanted" in constraint.explain(bad)


def test_aligned_is_align_with_the_axis_or_its_opposite() -> None:
    spec = {"object": "brick", "reference": "post", "axis": "y", "reference_axis": "y"}
    states = around(START, 200, np.random.default_rng(8))
    record = {"kind": "align", "a": {"object": "brick", "axis": "y"}, "tolerance_rad": 0.17}
    ways = [{**record, "b": {"object": "post", "axis": axis}} for axis in ("y", "-y")]
    boxes = {key: box_of(states, key, blocks()) for key in ("brick", "post")}
    (wanted,) = RELATIONS["aligned"](spec, boxes)
    f = np.min([compile_constraint(way, blocks()).violation(states) for way in ways], axis=0)
    np.testing.assert_allclose(f, wanted.excess, atol=1e-9)
    same = compile_constraint({"kind": "aligned", **spec}, blocks()).violation(states)
    np.testing.assert_array_equal(same, wanted.excess)
    assert 0.02 < (f <= 0).mean() < 0.98
