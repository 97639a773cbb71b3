"""Varied replays that take over the arm's motion: what they say, against whole ones."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import coal
import numpy as np
import pytest

from twin.physics.world import World
from twin.replay.clearance.bodies import placement_of
from twin.replay.config import ReplayConfig
from twin.replay.result import ReplayResult
from twin.replay.varied import AWAY_M, hand_near
from twin.replay.verdict import replay_plan
from twin.robot.collision import hulls_of, signed_distance
from twin.robot.model import load_robot

CASES = [("box", 0.003, None), ("cube", 0.03, "terminal"), ("box", 0.2, "terminal")]
"""A little to the side; beside the fingers; where nothing is put down."""


@pytest.mark.parametrize("case", CASES)
def test_it_ends_as_a_whole_replay_does_and_simulates_less(
    script: SimpleNamespace, good: ReplayResult, monkeypatch: pytest.MonkeyPatch, case: Any
) -> None:
    name, y_m, fails = case
    scene, steps, one_step = script.scene(), list[int](), World.step
    monkeypatch.setattr(World, "step", lambda world: (steps.append(1), one_step(world)))
    plan, config = script.plan(scene), ReplayConfig(grip_delay_s=0.05)
    there = replace(scene, Ts_base_object={n: T.copy() for n, T in scene.Ts_base_object.items()})
    there.Ts_base_object[name][1, 3] += y_m
    whole = replay_plan(plan, there, config)
    count = len(steps)
    taken = replay_plan(plan, there, config, known=good)
    assert whole.verdict.first_failing == taken.verdict.first_failing == fails
    assert len(steps) - count < 0.75 * count
    np.testing.assert_array_equal(taken.stamps_ns, whole.stamps_ns)
    np.testing.assert_allclose(taken.joints_rad, whole.joints_rad, atol=2e-3)
    ends = [each.Ts_base_object["cube"][-1, :3, 3] for each in (whole, taken)]
    np.testing.assert_allclose(*ends, atol=0.004)  # how it bounces is left to chance


def test_the_hand_is_near_wherever_a_hull_of_it_is(
    script: SimpleNamespace, good: ReplayResult
) -> None:
    scene = script.scene()
    hulls, T = hulls_of(load_robot(scene.urdf)), scene.Ts_base_object["cube"]
    near = hand_near(good, {"cube": T[:3, 3]}, scene, hulls)
    assert 0 < near.sum() < len(near) / 2
    cube = coal.Box(*scene.task.objects["cube"].size_m), placement_of(T)
    fingers = hulls.robot.record.gripper.links
    hand = [(k, hull.shape) for k, hull in enumerate(hulls.hulls) if hull.link in fingers]
    for index in np.flatnonzero(~near):
        hulls.place(good.joints_rad[index], float(good.width_m[index]))
        assert min(signed_distance(s, hulls.placement(k), *cube) for k, s in hand) > AWAY_M
