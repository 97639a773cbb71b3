"""Reasons of verdicts: what failed or is open, once each, by factor and engine, at the gate."""

import math
import time
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bridge.episode.run_folder import RunFolder
from bridge.errors import UsageError
from bridge.task.causes import Cause
from bridge.task.task_file import load_task
from bridge.task.verdict import Factor
from bridge.terminal import Output
from twin.gate.config import GateConfig
from twin.gate.gate import UndecidedError, no_verdict
from twin.gate.twin_process import TwinProcess
from twin.replay.config import ReplayConfig
from twin.replay.failure import Failure, factor_from
from twin.replay.result import ReplayResult
from twin.replay.scene import ReplayScene
from twin.replay.verdict import reason_of, replay_plan, terminal_factor

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


def test_both_engines_hold_and_place_and_name_themselves(
    script: SimpleNamespace, good: ReplayResult
) -> None:
    scene = script.scene()
    other = replay_plan(script.plan(scene), scene, ReplayConfig(engine="mujoco"))
    both = (good, other)
    assert [result.verdict.engine.split("-")[0] for result in both] == ["pybullet", "mujoco"]
    assert [result.verdict.accepted for result in both] == [True, True]
    first, second = (result.Ts_base_object["cube"][-1, :3, 3] for result in both)
    assert np.linalg.norm(first - second) < 0.01, "both let it fall into the box at one place"
    assert np.array_equal(good.stamps_ns, other.stamps_ns)


def test_soft_tasks_are_refused_in_an_engine_that_has_none() -> None:
    soft = load_task("sloth_into_basket").soft_objects
    config = ReplayConfig(engine="mujoco")
    with pytest.raises(UsageError, match=r"sloth cannot be replayed: .* rigid objects only"):
        config.refuse_soft(soft)
    replace(config, mode="kinematic").refuse_soft(soft)
    ReplayConfig().refuse_soft(soft)


@given(st.lists(st.integers(0, 10**10), min_size=1, max_size=6, unique=True))
def test_a_factor_names_the_earliest_failure_in_whatever_order_they_were_found(
    times_ns: list[int],
) -> None:
    causes = dict(zip(times_ns, Cause, strict=False))
    failures = [
        Failure(t_ns=t, cause=cause, detail="", bodies=(str(t),)) for t, cause in causes.items()
    ]
    factor = factor_from(failures, undecided="open, too")
    first = sorted(times_ns)[0]
    assert (factor.value, factor.first_t_ns) == (False, first)
    assert (factor.cause, factor.bodies) == (causes[first], (str(first),))
    assert factor_from([]).value is True
    assert factor_from([], undecided="why").value is None


def soon(seconds: float) -> float:
    return time.monotonic() + seconds


def as_localised(scene: Any) -> dict[str, Any]:
    unsure = np.diag([1e-8, 1e-8, 0.0, 0.0, 0.0, 1e-8])
    return {
        name: SimpleNamespace(found=True, reason=None, T_base_object=T, covariance=unsure)
        for name, T in scene.Ts_base_object.items()
    }


@pytest.mark.slow
def test_the_gates_process_says_what_the_replay_says_and_adds_samples(
    run: RunFolder, script: SimpleNamespace, good: ReplayResult
) -> None:
    scene = script.scene()
    plan, found = script.plan(scene), as_localised(scene)
    config = GateConfig(samples=1, replay=ReplayConfig())
    with TwinProcess(run.path, config, Output(quiet=True)) as twin:
        start_rad = good.joints_rad[0]
        first = twin.replay(plan, scene.task, found, scene.urdf, start_rad, soon(120))
        assert first.p_success is not None
        assert (first.p_success["k"], first.p_success["n"]) == (1, 1)
        # Beside what a replay checks, the gate knows where the arm is, and audits its yes.
        more = {name: first.checks[name].value for name in ("start", "audit")}
        assert more == {"start": True, "audit": True}
        assert first.samples is not None
        assert first.samples["accepted"] == [True]
        same = replace(first, p_success=None, samples=None, reason=None, checks=good.verdict.checks)
        assert same == good.verdict
        assert "within the cavity of box" in str(first.reason)
        assert first.checks.items() >= good.verdict.checks.items()
        nowhere = replace(plan.tau[3], p_m=(math.nan, 0.0, 0.2))
        lost = replace(plan, tau=(*plan.tau[:3], nowhere, *plan.tau[4:]))
        with pytest.raises(UndecidedError, match="not finite"):
            twin.replay(lost, scene.task, found, scene.urdf, start_rad, soon(60))
