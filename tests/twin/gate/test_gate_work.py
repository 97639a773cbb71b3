"""What the gate's process replays with: the run's calibration, and the force of the task."""

import itertools
import json
import time
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from foreign_scene import write_scene_of
from small_plans import plan_of
from verdicts import verdict_of

from bridge.episode.run_folder import RunFolder
from bridge.geometry import se3
from bridge.robots.default import ROBOT, ROBOT_NAME
from bridge.robots.robot import read_robot
from bridge.task.plan import Plan, Waypoint
from bridge.task.task_file import load_task
from bridge.task.verdict import Factor, Verdict
from twin.gate.gate import UndecidedError
from twin.gate.twin_process import Question, answer
from twin.replay import audit as auditor
from twin.replay import verdict as verdict_module
from twin.replay.config import ReplayConfig
from twin.replay.path import UnusablePlanError
from twin.replay.scene import ReplayScene
from twin.scene.store.calibration import write_physics

STANDS = Waypoint(t_ns=0, p_m=(0.4, 0.0, 0.3), q_wxyz=(0.0, 1.0, 0.0, 0.0), g=0)


class SeenError(Exception):
    """Ends the replay where it would begin."""


def asked(run: RunFolder, monkeypatch: pytest.MonkeyPatch) -> tuple[ReplayScene, ReplayConfig]:
    """Where and with which settings a plan for the sloth would be replayed."""
    seen: list[tuple[ReplayScene, ReplayConfig]] = []

    def replay_plan(plan: Plan, scene: ReplayScene, config: ReplayConfig, **_: Any) -> Any:
        seen.append((scene, config))
        raise SeenError

    monkeypatch.setattr(verdict_module, "replay_plan", replay_plan)
    with pytest.raises(SeenError):
        answer(question_of(run))
    return seen[0]


def question_of(run: RunFolder, **changes: Any) -> Question:
    """A plan for the sloth, which lies somewhere."""
    task = load_task("sloth_into_basket")
    lying = se3.transform_from(np.array([1.0, 0, 0, 0]), np.array([0.5, -0.1, 0.03]))
    question = Question(
        run_path=run.path,
        plan=plan_of(robot=ROBOT_NAME, tau=(STANDS,)),
        seen=ReplayScene(
            task=task,
            Ts_base_object={"sloth": lying, "basket": np.eye(4)},
            urdf=ROBOT.urdf_text(),
        ),
        config=ReplayConfig(),
        max_steps=100_000,
    )
    return replace(question, **changes)


YES = Factor(value=True)
ACCEPTED = verdict_of()


def accepting(monkeypatch: pytest.MonkeyPatch) -> list[ReplayConfig]:
    """Let every replay and its audit succeed; the settings of each."""
    asked: list[ReplayConfig] = []
    monkeypatch.setattr(auditor, "audit", lambda *_, **__: YES)

    def replay_plan(plan: Plan, scene: ReplayScene, config: ReplayConfig, **_: Any) -> Any:
        asked.append(config)
        return SimpleNamespace(verdict=ACCEPTED)

    monkeypatch.setattr(verdict_module, "replay_plan", replay_plan)
    return asked


NOMINAL_STEPS = 60 + 240
"""A plan that stands settles for 0.25 s before and 1 s after, at 240 Hz."""


@pytest.mark.parametrize(("more_steps", "count"), [(0, 0), (899, 0), (900, 1), (4500, 5)])
def test_as_many_samples_are_run_as_fit_into_the_steps_on_any_machine(
    run: RunFolder, monkeypatch: pytest.MonkeyPatch, more_steps: int, count: int
) -> None:
    """One with a soft object costs as much as three rigid ones."""
    question = question_of(
        run, config=ReplayConfig(samples=5), max_steps=NOMINAL_STEPS + more_steps
    )
    asked = accepting(monkeypatch)
    idle = answer(question)
    assert len(asked) == 1 + count
    assert (idle.p_success or {"n": 0})["n"] == count
    hours = itertools.count(step=3600.0)
    monkeypatch.setattr(time, "monotonic", lambda: next(hours))
    assert answer(question).to_json() == idle.to_json()


def test_a_plan_that_alone_needs_too_many_steps_gets_no_verdict(
    run: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = accepting(monkeypatch)
    with pytest.raises(UndecidedError, match="300 simulated steps, and a verdict at most 299"):
        answer(question_of(run, max_steps=NOMINAL_STEPS - 1))
    assert not asked
    late = replace(STANDS, t_ns=1_700_000_000_000_000_000)
    question = question_of(run)
    with pytest.raises(UnusablePlanError, match="from the start of the trajectory, not from 1970"):
        answer(replace(question, plan=replace(question.plan, tau=(late,))))


def test_a_gate_presses_as_the_task_says_until_a_calibration_knows_better(
    run: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene, config = asked(run, monkeypatch)
    assert config.physics.grip_force_N == 9.0
    assert scene.Ts_base_object["sloth"][:3, 3] == pytest.approx([0.5, -0.1, 0.03])
    force = {"grip_force_N": {"value": 11.0, "low": 10.0, "high": 12.0, "sigma_log": 0.05}}
    write_physics(run, {"promoted": True, "identified": force, "id": "x"})
    scene, config = asked(run, monkeypatch)
    assert config.physics.grip_force_N == 11.0
    assert scene.calibration_id is not None


def test_a_yes_that_knows_less_than_a_scene_could_tell_says_what_is_missing(
    run: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A rebuilt scene without distances and without the toy: the task file stands in for both."""
    run.scene_dir.mkdir(exist_ok=True)
    record = {"schema_version": 1, "key": "k", "scene_hash": "abc", "background": {},
              "sources": [], "views": []}  # fmt: skip
    (run.scene_dir / "scene.json").write_text(json.dumps(record))
    accepting(monkeypatch)
    said = answer(question_of(run))
    assert said.accepted is True
    assert said.warnings == (
        "sloth: shape of the task file (not scanned)",
        "the scene has no sdf.npz: only the table and the containers are in the way",
    )
    assert said.reason == said.warnings[0]


@pytest.mark.parametrize("now", ["abc", None])
def test_a_plan_of_a_scene_that_was_rebuilt_since_gets_no_verdict(
    run: RunFolder, monkeypatch: pytest.MonkeyPatch, now: str | None
) -> None:
    if now is not None:
        run.scene_dir.mkdir(exist_ok=True)
        record = {"schema_version": 1, "key": "k", "scene_hash": now, "background": {},
                  "sources": [], "views": []}  # fmt: skip
        (run.scene_dir / "scene.json").write_text(json.dumps(record))
    asked = accepting(monkeypatch)
    question = question_of(run)
    stale = replace(question, plan=replace(question.plan, scene_hash="0ld5cene"))
    said = f"plan p was made in scene 0ld5cene; the run now has {now or 'none'}. Start its planner"
    with pytest.raises(UndecidedError, match=said):
        answer(stale)
    assert not asked
    fresh = replace(question, plan=replace(question.plan, scene_hash=now))
    assert answer(fresh).accepted is True


def test_a_scene_that_another_robot_recorded_gives_no_verdict(
    run: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = read_robot("ur10_parallel_gripper")
    write_scene_of(run, other)
    asked = accepting(monkeypatch)
    question = question_of(run)
    said = f"with robot {other.name} .scan., and plan p is for {ROBOT_NAME}. Scan"
    with pytest.raises(UndecidedError, match=said):
        answer(question)
    assert not asked
    assert answer(replace(question, any_robot=True)).accepted is True
    plan = replace(question.plan, robot=other.name)
    there = replace(question.seen, urdf=other.description())
    assert answer(replace(question, plan=plan, seen=there)).accepted is True


def test_a_yes_that_the_audit_does_not_confirm_is_null_with_both_numbers(
    run: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    accepting(monkeypatch)
    assert answer(question_of(run)).checks["audit"] == YES
    detail = "forearm_link is 3.0 mm from box at 1.20 s by python-fcl, the clearance said 8.0 mm"
    monkeypatch.setattr(auditor, "audit", lambda *_: Factor(value=None, detail=detail))
    said = answer(question_of(run))
    assert said.accepted is None
    assert said.reason == f"undecided: audit: {detail}"
    assert Verdict.from_json(said.to_json()).checks["audit"].detail == detail
