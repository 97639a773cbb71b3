"""No contact outside the allowed pairs, over the whole execution."""

from dataclasses import replace

import numpy as np
import pytest

from bridge.task import predicate
from bridge.task.task_file import load_task
from bridge.task.verdict import Factor, Verdict

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
    verdict = Verdict(
        plan_id="p", trajectory="executed", mode="kinematic", ik=Factor(value=True),
        clearance=Factor(value=True), terminal=Factor(value=None), engine="e", seed=0,
        warnings=("the goal held before anything moved",),
        findings=({"side": "recorded", "kind": "inside", "object": "cube", "value": None,
                   "detail": "cube was not localised"},),
    )  # fmt: skip
    assert Verdict.from_json(verdict.to_json()) == verdict
