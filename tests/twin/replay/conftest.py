"""Lets the tests here import ``scripted_plans``, and replays the plan that works once."""

import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

sys.path.insert(0, str(Path(__file__).parent))

from scripted_plans import (
    pick_and_place,
    recorded_tracks,
    scene_of_test,
    toy_plan,
    toy_scene,
    with_joints,
)

from twin.replay.config import ReplayConfig
from twin.replay.result import ReplayResult
from twin.replay.verdict import replay_plan


@pytest.fixture(scope="session")
def script() -> SimpleNamespace:
    """The functions above, for the test files beside this one."""
    return SimpleNamespace(
        scene=scene_of_test,
        plan=pick_and_place,
        with_joints=with_joints,
        recorded_tracks=recorded_tracks,
        toy_scene=toy_scene,
        toy_plan=toy_plan,
    )


@pytest.fixture(scope="session")
def good() -> ReplayResult:
    """A replay of the plan that works."""
    scene = scene_of_test()
    return replay_plan(pick_and_place(scene), scene, ReplayConfig())
