"""Laws of the hard predicates, of contacts outside the allowed pairs too: what decides each."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from verdicts import verdict_of

from bridge.geometry import se3
from bridge.task import predicate
from bridge.task.predicate import Rollout, all_hold, already_true_at_start, evaluate_success
from bridge.task.task_file import Task, load_task
from bridge.task.verdict import Verdict

STEP_NS = 20_000_000
STEPS = 100
STAMPS_NS = np.arange(STEPS, dtype=np.int64) * STEP_NS
SETTLED = {"kind": "settled", "object": "cube", "max_speed_m_s": 0.02, "for_s": 0.4}
FOR_STEPS = 20
FULL_STEP_M = SETTLED["max_speed_m_s"] * STEP_NS * 1e-9  # type: ignore[operator]


def task_with(*success: dict[str, Any]) -> Task:
    return replace(load_task("cube_into_box"), success=success)


def track(p_m: np.ndarray) -> np.ndarray:
    return se3.transform_from(np.tile([1.0, 0.0, 0.0, 0.0], (len(p_m), 1)), p_m)


def along_x(steps_m: np.ndarray) -> Rollout:
    """A cube that moves by one step after the other."""
    p = np.zeros((len(steps_m) + 1, 3))
    p[1:, 0] = np.cumsum(steps_m)
    stamps = np.arange(len(p), dtype=np.int64) * STEP_NS
    return Rollout(stamps_ns=stamps, Ts_base_object={"cube": track(p)}, finger_contact={})


def settled(steps_m: np.ndarray) -> bool | None:
    return evaluate_success(task_with(SETTLED), along_x(steps_m))[0].value


@given(st.integers(1, FOR_STEPS))
def test_one_fast_step_among_the_last_is_not_settled(back: int) -> None:
    steps = np.zeros(STEPS)
    steps[-back] = 1.5 * FULL_STEP_M
    assert settled(steps) is False


@given(st.floats(0.0, 0.99), st.floats(0.0, 50.0))
def test_only_the_last_part_decides_whether_it_settled(late: float, early: float) -> None:
    steps = np.full(STEPS, late * FULL_STEP_M)
    steps[: STEPS - FOR_STEPS - 1] = early * FULL_STEP_M
    assert settled(steps) is True


def test_what_is_shorter_than_the_time_asked_for_is_open() -> None:
    assert settled(np.zeros(FOR_STEPS - 2)) is None
    assert settled(np.zeros(FOR_STEPS)) is True


def inside(p_box_cube: np.ndarray, margin_m: float, Ts_box: np.ndarray | None = None) -> bool:
    spec = {"kind": "inside", "object": "cube", "container": "box", "margin_m": margin_m}
    boxes = np.tile(np.eye(4), (STEPS, 1, 1)) if Ts_box is None else Ts_box
    cube = track(np.tile(se3.apply(boxes[-1], p_box_cube), (STEPS, 1)))
    poses = {"cube": cube, "box": boxes}
    rollout = Rollout(stamps_ns=STAMPS_NS, Ts_base_object=poses, finger_contact={})
    value = evaluate_success(task_with(spec), rollout)[0].value
    assert value is not None
    return value


@given(
    st.sampled_from([0, 1]),
    st.sampled_from([-1.0, 1.0]),
    st.floats(-0.02, 0.02),
    st.floats(-0.03, 0.03).filter(lambda gap: abs(gap) > 1e-6),
)
def test_a_margin_moves_the_walls_inwards(
    axis: int, side: float, margin_m: float, beyond_m: float
) -> None:
    box = load_task("cube_into_box").objects["box"]
    p = np.array([0.0, 0.0, box.wall_m + box.inner_m[2] / 2])  # type: ignore[index]
    p[axis] = side * (box.inner_m[axis] / 2 - margin_m + beyond_m)  # type: ignore[index]
    assert inside(p, margin_m) is (beyond_m <= 0)


def test_the_cavity_begins_on_the_floor_and_ends_at_the_rim() -> None:
    box = load_task("cube_into_box").objects["box"]
    assert box.inner_m is not None
    rim = box.wall_m + box.inner_m[2]
    heights = {box.wall_m - 1e-4: False, box.wall_m + 1e-4: True, rim - 1e-4: True}
    for z, wanted in {**heights, rim + 1e-4: False}.items():
        assert inside(np.array([0.0, 0.0, z]), 0.0) is wanted, z


def test_a_container_that_was_pushed_counts_where_it_ended() -> None:
    boxes = np.tile(np.eye(4), (STEPS, 1, 1))
    boxes[:, 0, 3] = np.linspace(0.0, 0.4, STEPS)
    middle = np.array([0.0, 0.0, 0.03])
    assert inside(middle, 0.0, boxes)
    assert not inside(middle - [0.4, 0.0, 0.0], 0.0, boxes)


def test_only_a_touch_at_the_end_counts() -> None:
    spec = {"kind": "no_finger_contact", "object": "cube"}
    for end in (False, True):
        touching = np.ones(STEPS, dtype=bool)
        touching[-1] = end
        rollout = replace(along_x(np.zeros(STEPS - 1)), finger_contact={"cube": touching})
        assert evaluate_success(task_with(spec), rollout)[0].value is not end


def test_a_task_that_asks_for_nothing_is_no_success() -> None:
    assert all_hold([]) is None


@pytest.mark.parametrize("other_inside", [True, False])
def test_the_goal_held_before_only_where_every_object_was_inside(other_inside: bool) -> None:
    specs = [
        {"kind": "inside", "object": name, "container": "box", "margin_m": 0.0}
        for name in ("cube", "other")
    ]
    here, there = np.array([[0.0, 0.0, 0.03]]), np.array([[0.5, 0.0, 0.03]])
    rollout = Rollout(
        stamps_ns=STAMPS_NS[:1],
        Ts_base_object={
            "cube": track(here),
            "other": track(here if other_inside else there),
            "box": np.eye(4)[None],
        },
        finger_contact={},
    )
    task = task_with(*specs)
    task = replace(task, objects={**task.objects, "other": task.objects["cube"]})
    assert already_true_at_start(task, rollout) is other_inside


@pytest.mark.parametrize("ik", [True, None, False])
@pytest.mark.parametrize("clearance", [True, None, False])
@pytest.mark.parametrize("terminal", [True, None, False])
def test_a_verdict_is_the_and_of_its_factors_and_names_the_first_that_fails(
    ik: bool | None, clearance: bool | None, terminal: bool | None
) -> None:
    factors = {"ik": ik, "clearance": clearance, "terminal": terminal}
    verdict = verdict_of(**factors)
    failing = [name for name, value in factors.items() if value is False]
    assert verdict.first_failing == (failing[0] if failing else None)
    # Kleene's logic: false beats unknown, unknown beats true.
    order = {False: 0, None: 1, True: 2}
    assert verdict.accepted is min(factors.values(), key=lambda value: order[value])


CUBE = load_task("cube_into_box")


def touch(depth_m: float, *, allowed: bool = False, start_s: float = 1.0) -> predicate.Contact:
    return predicate.Contact(
        start_ns=round(start_s * 1e9),
        end_ns=round(start_s * 1e9) + 10,
        bodies=("forearm_link", "box"),
        allowed=allowed,
        min_distance_m=-depth_m,
    )


def rollout(*contacts: predicate.Contact, **change: object) -> predicate.Rollout:
    state = predicate.Rollout(
        stamps_ns=np.array([0, 1]), Ts_base_object={}, finger_contact={}, contacts=contacts
    )
    return replace(state, **change)


def test_nothing_is_said_where_contacts_are_not_known() -> None:
    assert predicate.evaluate_contacts(CUBE, rollout(contacts=None)).value is None


@pytest.mark.parametrize(
    ("contacts", "holds"),
    [
        ((), True),
        ((touch(0.02, allowed=True),), True),
        ((touch(-0.001),), True),
        ((touch(0.0),), False),
        ((touch(0.001),), False),
    ],
)
def test_only_a_touch_that_was_not_allowed_breaks_it(
    contacts: tuple[predicate.Contact, ...], holds: bool
) -> None:
    assert predicate.evaluate_contacts(CUBE, rollout(*contacts)).value is holds


def test_the_first_wrong_touch_is_told_with_its_time_and_depth() -> None:
    finding = predicate.evaluate_contacts(
        CUBE, rollout(touch(0.004, start_s=3.0), touch(0.002, start_s=2.0))
    )
    assert "forearm_link touched box at 2.00 s, 2.0 mm deep" in finding.detail


def test_a_task_may_ask_for_it_like_for_any_other_predicate() -> None:
    task = replace(CUBE, success=({"kind": predicate.ALLOWED_CONTACTS, "tolerance_m": 0.003},))
    assert predicate.all_hold(predicate.evaluate_success(task, rollout(touch(0.002)))) is True
    assert predicate.all_hold(predicate.evaluate_success(task, rollout(touch(0.004)))) is False
    listed = predicate.evaluate_contacts(task, rollout(touch(0.002)))
    assert listed.value is True, "the task's own tolerance counts"


def test_a_task_may_ask_it_of_one_object_only() -> None:
    task = replace(CUBE, success=({"kind": predicate.ALLOWED_CONTACTS, "object": "cube"},))
    assert predicate.all_hold(predicate.evaluate_success(task, rollout(touch(0.01)))) is True


def test_a_broken_body_has_no_shape_whatever_its_extents() -> None:
    task = load_task("sloth_into_basket")
    size = np.array(task.objects["sloth"].size_m)
    state = rollout(
        Ts_base_object={"sloth": np.tile(np.eye(4), (2, 1, 1))},
        extents_m={"sloth": np.tile(size, (2, 1))},
        broken={"sloth": "burst: an edge is 9.0 times as long as at rest"},
    )
    task = replace(task, success=({"kind": "shape", "object": "sloth", "tolerance_fraction": 0.2},))
    (finding,) = predicate.evaluate_success(task, state)
    assert (finding.value, "burst" in finding.detail) == (False, True)
    whole = predicate.evaluate_success(task, replace(state, broken={}))
    assert whole[0].value is True
    nowhere = replace(state, broken={}, extents_m={"sloth": np.full((2, 3), np.nan)})
    assert predicate.evaluate_success(task, nowhere)[0].value is False


def test_a_verdict_keeps_warnings_and_findings_on_disk() -> None:
    verdict = verdict_of(
        trajectory="executed", mode="kinematic", terminal=None,
        warnings=("the goal held before anything moved",),
        findings=({"side": "recorded", "kind": "inside", "object": "cube", "value": None,
                   "detail": "cube was not localised"},),
    )  # fmt: skip
    assert Verdict.from_json(verdict.to_json()) == verdict
