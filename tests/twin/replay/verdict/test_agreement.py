"""Several engines asked about one plan: who decides, and what is said."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from bridge.errors import UsageError
from bridge.task.task_file import load_task
from bridge.task.verdict import Factor, Verdict
from twin.replay.agreement import compared, disagreement_of, in_each_engine
from twin.replay.config import ReplayConfig
from twin.replay.dynamics import num_steps
from twin.replay.result import ReplayResult
from twin.replay.verdict import replay_plan


def verdict(engine: str, ik: bool | None, clearance: bool | None, terminal: bool | None) -> Verdict:
    made = {
        name: Factor(value=value, cause=None if value is not False else "inside")
        for name, value in (("ik", ik), ("clearance", clearance), ("terminal", terminal))
    }
    return Verdict(plan_id="p", trajectory="planned", mode="dynamic", engine=engine, seed=0, **made)


@pytest.fixture(scope="module")
def both(script: SimpleNamespace) -> tuple[ReplayResult, ...]:
    scene = script.scene()
    plan = script.plan(scene)
    results = []

    def judge(config: ReplayConfig) -> Verdict:
        results.append(replay_plan(plan, scene, config))
        return results[-1].verdict

    verdicts = in_each_engine(scene.task, replace(ReplayConfig(), engine="both"), judge)
    return tuple(replace(r, verdict=v) for r, v in zip(results, verdicts, strict=True))


def test_both_engines_hold_and_place_and_name_themselves(both: tuple[ReplayResult, ...]) -> None:
    assert [result.verdict.engine.split("-")[0] for result in both] == ["pybullet", "mujoco"]
    assert [result.verdict.accepted for result in both] == [True, True]
    assert disagreement_of(both[0].verdict) is None
    first, second = (result.Ts_base_object["cube"][-1, :3, 3] for result in both)
    assert np.linalg.norm(first - second) < 0.01, "both let it fall into the box at one place"
    assert np.array_equal(both[0].stamps_ns, both[1].stamps_ns)


def test_engines_that_differ_keep_their_answers_and_say_so() -> None:
    verdicts = [verdict("pybullet-1", True, True, True), verdict("mujoco-2", True, True, False)]
    told = compared(verdicts)
    assert [each.accepted for each in told] == [True, False]
    assert [each.engine for each in told] == ["pybullet-1", "mujoco-2"]
    assert all(disagreement_of(each) is not None for each in told)
    alike = [verdicts[0], verdict("mujoco-2", True, True, True)]
    assert compared(alike) == alike


def test_what_is_said_names_each_engine_its_answer_and_why() -> None:
    verdicts = [
        verdict("pybullet-1", True, True, True),
        replace(verdict("mujoco-2", True, True, False), reason="terminal: inside: 30 mm outside"),
    ]
    expected = (
        "engines disagree: pybullet-1 accepted; mujoco-2 rejected (terminal: inside: 30 mm outside)"
    )
    first, second = compared(verdicts)
    assert disagreement_of(first) == disagreement_of(second) == expected
    assert first.reason == expected, "a yes has no other reason to show"
    assert second.reason == "terminal: inside: 30 mm outside"


def test_a_kinematic_replay_is_made_once() -> None:
    asked = []
    config = replace(ReplayConfig(), mode="kinematic", engine="both")

    def judge(each: ReplayConfig) -> Verdict:
        asked.append(each)
        return verdict("pinocchio", True, True, None)

    in_each_engine(load_task("sloth_into_basket"), config, judge)
    assert asked == [config]


def test_both_engines_take_twice_the_steps() -> None:
    one = ReplayConfig()
    assert num_steps(10**9, replace(one, engine="both")) == 2 * num_steps(10**9, one)


@pytest.mark.parametrize("engine", ["mujoco", "both"])
def test_a_soft_task_is_refused_before_anything_is_replayed(engine: str) -> None:
    config = replace(ReplayConfig(), engine=engine)
    with pytest.raises(UsageError, match=r"sloth cannot be replayed: .* rigid objects only"):
        in_each_engine(load_task("sloth_into_basket"), config, lambda each: pytest.fail("replayed"))
