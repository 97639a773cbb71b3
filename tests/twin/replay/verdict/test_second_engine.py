"""MuJoCo beside PyBullet: the same plan, the same instants, and what MuJoCo cannot replay."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from bridge.errors import UsageError
from bridge.task.task_file import load_task
from twin.replay.config import ReplayConfig
from twin.replay.result import ReplayResult
from twin.replay.verdict import replay_plan


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
