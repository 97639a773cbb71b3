"""Laws of every kind of constraint: sign, unit, derivative, invariance, both libraries."""

from dataclasses import replace

import numpy as np
import pytest
from block_scene import EXAMPLES, IN_BOX, START, around, blocks, pose, state

from bridge.errors import UsageError
from bridge.geometry import se3
from twin.plan.constrain.constraint import Constraint, violated, worst_along
from twin.plan.constrain.kinds import KINDS, compile_constraint
from twin.plan.problem import State
from twin.scene.shape.sdf import SdfGrid
from twin.scene.shape.static import StaticSdf

PATH_KINDS = {"speed"}
RIGID = ("distance at least", "inside", "clearance", "align bodies")
"""Only what is between bodies counts."""


def made(name: str) -> Constraint:
    return compile_constraint(EXAMPLES[name][0], blocks())


def moved(start: State, T: np.ndarray) -> State:
    """All of the states seen from another base frame."""
    return State(
        Ts_base_object={key: T @ Ts for key, Ts in start.Ts_base_object.items()},
        T_base_tcp=T @ start.T_base_tcp,
        width_m=start.width_m,
    )


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
def test_many_states_are_judged_as_each_alone(name: str) -> None:
    constraint = made(name)
    states = around(EXAMPLES[name][1], 40, np.random.default_rng(1))
    f = constraint.violation(states)
    assert f.shape == (40,)
    for index in range(40):
        one = State(
            Ts_base_object={
                key: Ts if len(Ts) == 1 else Ts[index : index + 1]
                for key, Ts in states.Ts_base_object.items()
            },
            T_base_tcp=states.T_base_tcp[index : index + 1],
            width_m=states.width_m[index : index + 1],
        )
        assert constraint.violation(one)[0] == pytest.approx(f[index], abs=1e-12)


@pytest.mark.parametrize("name", RIGID)
def test_a_rigid_motion_of_everything_changes_nothing(name: str) -> None:
    rng = np.random.default_rng(3)
    record = EXAMPLES[name][0] | ({"b": {"obj": "box"}} if name == "distance at least" else {})
    constraint = compile_constraint(record, blocks())
    states = around(EXAMPLES[name][1], 50, rng)
    q = rng.normal(size=4)
    T = se3.transform_from(q / np.linalg.norm(q), rng.normal(size=3))
    f = constraint.violation(moved(states, T))
    np.testing.assert_allclose(f, constraint.violation(states), atol=1e-9)


@pytest.mark.parametrize("name", [name for name in EXAMPLES if name != "beside left"])
def test_f_is_in_metres_or_radians(name: str) -> None:
    """Nothing changes f by more than the shift of a body, and along some way all of it counts."""
    constraint = made(name)
    rng = np.random.default_rng(5)
    states = around(EXAMPLES[name][2], 400, rng, turn_rad=0.0)
    size = 1e-4
    if constraint.unit == "m":
        way = rng.normal(size=(400, 3))
        step = np.tile(np.eye(4), (400, 1, 1))
        step[:, :3, 3] = way / np.linalg.norm(way, axis=1, keepdims=True) * size
    else:
        axis = rng.normal(size=(400, 3))
        axis *= size / np.linalg.norm(axis, axis=1, keepdims=True)
        step = np.tile(np.eye(4), (400, 1, 1))
        step[:, :3, :3] = se3.rotation_from_vector(axis)

    def stepped(T: np.ndarray) -> np.ndarray:
        shifted = T.copy() if len(T) > 1 else np.repeat(T, 400, axis=0)
        shifted[:, :3, 3] += step[:, :3, 3]
        shifted[:, :3, :3] = step[:, :3, :3] @ shifted[:, :3, :3]
        return shifted

    objects = dict(states.Ts_base_object)
    tcp, mover = states.T_base_tcp, "cube" if name != "upright" else "brick"
    if constraint.kind in ("distance", "align"):
        tcp = stepped(tcp)
    if constraint.kind != "distance" and name != "align":
        objects[mover] = stepped(objects[mover])
    after = State(Ts_base_object=objects, T_base_tcp=tcp, width_m=states.width_m)
    if name == "distance at least":
        objects["cube"] = stepped(objects["cube"])
    ratio = np.abs(constraint.violation(after) - constraint.violation(states)) / size
    assert ratio.max() <= 1 + 1e-6
    assert ratio.max() > 0.45
    assert constraint.scale == (0.01 if constraint.unit == "m" else np.radians(10))


def test_parts_have_the_violation_as_their_greatest() -> None:
    constraint = made("above")
    states = around(EXAMPLES["above"][1], 20, np.random.default_rng(6))
    parts = constraint.parts(states)
    assert parts.shape == (20, 2)
    np.testing.assert_array_equal(parts.max(axis=1), constraint.violation(states))


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


def test_a_speed_needs_times() -> None:
    constraint = compile_constraint({"kind": "speed", "max": 0.25}, blocks())
    assert constraint.unit == "m/s"
    tcp = np.tile(START.T_base_tcp[0], (4, 1, 1))
    tcp[:, 0, 3] += np.linspace(0.0, 0.3, 4)
    objects = {key: T[None] for key, T in START.Ts_base_object.items()}
    way = State(Ts_base_object=objects, T_base_tcp=tcp[None], width_m=np.zeros((1, 4)))
    times_s = np.array([0.0, 0.5, 1.0, 1.2])
    assert worst_along(constraint, way, times_s=times_s)[0] == pytest.approx(0.25)
    assert worst_along(constraint, way)[0] == pytest.approx(-0.25)


def test_contradicting_constraints_are_both_named_at_the_best_compromise() -> None:
    above, height = (
        {
            "kind": "above",
            "a": {"obj": "cube", "anchor": "bottom"},
            "b": {"obj": "box", "anchor": "opening"},
            "height": 0.02,
            "tol": 0.01,
            "xy_tol": 0.03,
        },
        {"kind": "height", "a": {"obj": "cube", "anchor": "bottom"}, "min": 0.5, "max": 0.6},
    )
    constraints = [compile_constraint(record, blocks()) for record in (above, height)]
    heights = np.linspace(0.0, 0.8, 801)
    cube = np.tile(IN_BOX.Ts_base_object["cube"][0], (801, 1, 1))
    cube[:, 2, 3] = heights
    states = State(
        Ts_base_object=IN_BOX.Ts_base_object | {"cube": cube},
        T_base_tcp=np.repeat(IN_BOX.T_base_tcp, 801, axis=0),
        width_m=np.zeros(801),
    )
    cost = sum(np.square(np.maximum(c.violation(states), 0) / c.scale) for c in constraints)
    best = cube[int(np.argmin(cost))]
    told = violated(constraints, state(cube=best))
    assert [text.split()[0] for text in told] == ["above", "height"]


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


def test_a_rebuilt_scene_says_how_far_it_is() -> None:
    """A floor at 5 cm, as a grid: the cube's lowest corner counts."""
    z = 0.02 * np.arange(40) - 0.2
    values = np.broadcast_to((z - 0.05).astype(np.float32), (60, 60, 40)).copy()
    grid = SdfGrid(values_m=values, origin_m=np.array([0.0, -0.6, -0.2]), voxel_m=0.02)
    still = StaticSdf(conservative=grid, observed=grid)
    problem = replace(blocks(), scene=replace(blocks().scene, static_sdf=still))
    record = {"kind": "clearance", "obj": "cube", "against": "scene", "min": 0.03}
    constraint = compile_constraint(record, problem)
    found = constraint.violation(state(cube=pose(0.5, 0.0, 0.1, 0.3)))[0]
    assert found == pytest.approx(0.03 - (0.1 - 0.02 - 0.05), abs=1e-6)


def test_a_state_that_is_no_number_does_not_hold() -> None:
    for name in EXAMPLES:
        lost = {key: np.full((4, 4), np.nan) for key in ("cube", "brick", "tcp")}
        assert not made(name).violation(state(**lost))[0] <= 0, name
