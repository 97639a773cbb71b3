"""Reasons of verdicts: only what failed or is open, each thing once."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from bridge.task.verdict import Factor
from twin.gate.gate import no_verdict
from twin.replay.config import ReplayConfig
from twin.replay.result import ReplayResult
from twin.replay.scene import ReplayScene
from twin.replay.verdict import reason_of, terminal_factor

CONFIG = ReplayConfig()
STEPS = 120


def at_rest(script: SimpleNamespace, scene: ReplayScene, **settings: object) -> ReplayResult:
    """Everything stands where it began, and no finger touches anything."""
    return ReplayResult(
        verdict=no_verdict(script.plan(script.scene()), ""),
        stamps_ns=(np.arange(STEPS) * 16_666_667).astype(np.int64),
        joints_rad=np.zeros((STEPS, 6)),
        width_m=np.zeros(STEPS),
        Ts_base_tcp=np.tile(np.eye(4), (STEPS, 1, 1)),
        Ts_base_object={
            name: np.tile(T, (STEPS, 1, 1)) for name, T in scene.Ts_base_object.items()
        },
        finger_contact={
            name: np.zeros(STEPS, dtype=bool) for name in scene.Ts_base_object if name != "box"
        },
        clearance_m=np.zeros(STEPS),
        contacts=[],
        **settings,
    )


def terminal(scene: ReplayScene, result: ReplayResult) -> Factor:
    return terminal_factor(result, scene, CONFIG, unreachable_ns=None)


def test_a_rejection_names_what_failed_and_nothing_that_held(script: SimpleNamespace) -> None:
    scene = script.scene()
    factor = terminal(scene, at_rest(script, scene))
    assert (factor.value, factor.cause) == (False, "inside")
    assert "mm beyond the cavity of box" in str(factor.detail)
    assert "finger" not in str(factor.detail)
    assert "mm/s" not in str(factor.detail)


def test_everything_that_failed_is_named(script: SimpleNamespace) -> None:
    scene = script.scene()
    touching = {"cube": np.ones(STEPS, dtype=bool)}
    factor = terminal(scene, replace(at_rest(script, scene), finger_contact=touching))
    assert "mm beyond the cavity of box" in str(factor.detail)
    assert "a finger touches cube" in str(factor.detail)


@pytest.mark.parametrize("lost", [("cube",), ("box",), ("cube", "box")])
def test_what_was_not_localised_is_said_once_for_both_factors(
    script: SimpleNamespace, lost: tuple[str, ...]
) -> None:
    scene = replace(script.scene(missing=lost), reasons=dict.fromkeys(lost, "hidden by the arm"))
    result = at_rest(script, scene)
    open_for_it = Factor(value=None, detail=scene.describe_missing())
    verdict = replace(
        result.verdict,
        ik=Factor(value=True),
        clearance=open_for_it,
        terminal=terminal(scene, result),
    )
    reason = str(reason_of(verdict))
    assert reason.startswith("undecided: clearance and terminal: not localised: ")
    for told in (*lost, "hidden by the arm", "not localised"):
        assert reason.count(told) == 1


def test_what_is_open_for_another_reason_is_told_beside(script: SimpleNamespace) -> None:
    scene = script.scene()
    inside = scene.Ts_base_object["box"].copy()
    inside[2, 3] += 0.03
    poses = {**scene.Ts_base_object, "cube": inside}
    result = at_rest(script, replace(scene, Ts_base_object=poses))
    factor = terminal(scene, replace(result, finger_contact={}))
    assert (factor.value, factor.detail) == (None, "finger contact is not known")
