"""A yes allows one plan, from one posture, for a while."""

import hashlib
from typing import Any

import numpy as np
import pytest
from verdicts import verdict_of

from bridge.sources.standin.decisions import why_stale
from bridge.task.verdict import Verdict

PLAN = b'{"a": 0.0}'
BASIS: dict[str, Any] = {
    "plan_sha256": hashlib.sha256(PLAN).hexdigest(),
    "joints_rad": [0.1] * 6,
    "objects": {"cube": {"p_m": [0.5, 0.0, 0.0], "margin_m": 0.01}},
    "judged_ns": 10**9,
    "valid_s": 5.0,
    "scene_hash": "5cene",
    "calibration_id": None,
}
TWIN = {"scene_hash": "5cene", "calibration_id": None}


def verdict(value: bool | None = True, basis: dict[str, Any] | None = BASIS) -> Verdict:
    return verdict_of(terminal=value, basis=basis)


@pytest.mark.parametrize(
    ("plan", "at_s", "turned_rad", "moved_m", "words"),
    [
        (PLAN, 5.9, 0.049, 0.009, ""),
        (b'{"a": 0.00}', 1.0, 0.0, 0.0, "for another plan"),
        (PLAN, 6.1, 0.0, 0.0, "5.1 s old, and holds for 5 s"),
        (PLAN, 0.9, 0.0, 0.0, "-0.1 s old"),
        (PLAN, 1.0, -0.051, 0.0, "wrist_1_joint is 0.051 rad"),
        (PLAN, 1.0, np.nan, 0.0, "wrist_1_joint is nan rad"),
        (PLAN, 1.0, 0.0, 0.011, "cube is 11 mm from where it was judged, and 10 mm"),
    ],
)
def test_a_yes_holds_for_what_was_judged(
    plan: bytes, at_s: float, turned_rad: float, moved_m: float, words: str
) -> None:
    joints = np.full(6, 0.1)
    joints[3] += turned_rad
    moved = {"cube": np.array([0.0, -moved_m, 0.0])}
    found = why_stale(verdict(), plan, round(at_s * 1e9), joints, moved, TWIN)
    assert words in found
    assert bool(found) == bool(words)


@pytest.mark.parametrize("given", [verdict(False), verdict(None), verdict(basis=None)])
def test_what_is_no_yes_allows_nothing(given: Verdict) -> None:
    assert why_stale(given, PLAN, 10**9, np.full(6, 0.1), {}, TWIN) != ""


@pytest.mark.parametrize(
    ("now", "words"),
    [
        ({**TWIN, "scene_hash": "new"}, "its scene_hash was 5cene, and the gate has new now"),
        ({**TWIN, "calibration_id": "ab"}, "calibration_id was none, and the gate has ab now"),
        ({}, "the gate has nothing now"),
    ],
)
def test_a_yes_of_another_scene_or_calibration_is_void(now: dict[str, Any], words: str) -> None:
    assert words in why_stale(verdict(), PLAN, 10**9, np.full(6, 0.1), {}, now)


def test_the_basis_travels_with_the_verdict() -> None:
    assert Verdict.from_json(verdict().to_json()).basis == BASIS
    assert b"basis" not in verdict(basis=None).to_json()
