"""Laws of every kind of constraint: sign, unit, derivative, invariance, both libraries."""

from dataclasses import replace

import numpy as np
import pytest
from block_scene import EXAMPLES, START, around, blocks, state

from bridge.errors import UsageError
from twin.plan.constrain.constraint import Constraint, worst_along
from twin.plan.constrain.kinds import KINDS, compile_constraint
from twin.plan.problem import State

PATH_KINDS = {"speed"}


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


def paths(num_states: int, num_steps: int) -> State:
    states = around(START, num_states * num_steps, np.random.default_rng(7))
    objects = {
        key: T.reshape(num_states, num_steps, 4, 4) if len(T) > 1 else T[None]
        for key, T in states.Ts_base_object.items()
    }
    return State(
        Ts_base_object=objects,
        T_base_tcp=states.T_base_tcp.reshape(num_states, num_steps, 4, 4),
        width_m=np.zeros((num_states, num_steps)),
    )


def at_step(states: State, index: int) -> State:
    return State(
        Ts_base_object={
            key: T[:, min(index, T.shape[1] - 1)] for key, T in states.Ts_base_object.items()
        },
        T_base_tcp=states.T_base_tcp[:, index],
        width_m=states.width_m[:, index],
    )


@pytest.mark.parametrize("name", EXAMPLES)
def test_along_a_path_the_worst_step_counts(name: str) -> None:
    constraint, states = made(name), paths(6, 5)
    each = np.stack([constraint.violation(at_step(states, step)) for step in range(5)], axis=1)
    np.testing.assert_allclose(worst_along(constraint, states), each.max(axis=1), atol=1e-15)


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
