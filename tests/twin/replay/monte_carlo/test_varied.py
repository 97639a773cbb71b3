"""Varied replays that take over the arm's motion: what they say, against whole ones."""

from dataclasses import replace
from types import SimpleNamespace

import coal
import numpy as np
import pytest

from twin.physics.world import World
from twin.replay.config import ReplayConfig
from twin.replay.monte_carlo import draw_variation, sample_rng
from twin.replay.result import ReplayResult
from twin.replay.scene import ReplayScene
from twin.replay.varied import AWAY_M, hand_near
from twin.replay.verdict import replay_plan
from twin.robot.collision import hulls_of, signed_distance
from twin.robot.model import load_robot

UNSURE = np.diag([4e-5] * 2 + [1e-6] * 3 + [1e-3])


def moved(scene: ReplayScene, name: str, y_m: float) -> ReplayScene:
    T = scene.Ts_base_object[name].copy()
    T[1, 3] += y_m
    return replace(scene, Ts_base_object={**scene.Ts_base_object, name: T})


def test_it_ends_as_a_whole_replay_does_and_simulates_half_of_it(
    script: SimpleNamespace, good: ReplayResult, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene, config, steps = script.scene(), ReplayConfig(), []
    scene = replace(scene, covariances=dict.fromkeys(scene.Ts_base_object, UNSURE))
    plan, whole_step = script.plan(scene), World.step
    monkeypatch.setattr(World, "step", lambda world: (steps.append(1), whole_step(world)))
    drawn = [draw_variation(sample_rng(0, "x", i), scene, config, index=i) for i in range(6)]
    # Beside the cube, onto the rim, and so near to the box that the hand runs into it.
    drawn += [(moved(scene, *by), config) for by in (("cube", 0.03), ("box", 0.06), ("box", 0.2))]
    for there, physics in drawn:
        counts, found = [], []
        for known in (None, good):
            steps.clear()
            found.append(replay_plan(plan, there, physics, known=known))
            counts.append(len(steps))
        whole, taken = found
        assert taken.verdict.accepted is whole.verdict.accepted
        assert taken.verdict.first_failing == whole.verdict.first_failing
        assert counts[1] < 0.75 * counts[0]
        np.testing.assert_array_equal(taken.stamps_ns, whole.stamps_ns)
        np.testing.assert_allclose(taken.joints_rad, whole.joints_rad, atol=2e-3)
        ends = [each.Ts_base_object["cube"][-1, :3, 3] for each in found]
        assert np.linalg.norm(ends[0] - ends[1]) < 0.005  # how it bounces is left to chance


def test_the_hand_is_near_wherever_a_hull_of_it_is(
    script: SimpleNamespace, good: ReplayResult
) -> None:
    scene = script.scene()
    robot = load_robot(scene.urdf)
    hulls = hulls_of(robot)
    T = scene.Ts_base_object["cube"]
    found = hand_near(good, {"cube": T[:3, 3]}, scene, hulls)
    assert 0 < found.sum() < len(found) / 2
    cube = coal.Box(*scene.task.objects["cube"].size_m)
    hand = [k for k, hull in enumerate(hulls.hulls) if hull.link in robot.record.gripper.links]
    for index in np.flatnonzero(~found):
        hulls.place(good.joints_rad[index], float(good.width_m[index]))
        place = coal.Transform3s(T[:3, :3], T[:3, 3])
        gaps = [
            signed_distance(hulls.hulls[k].shape, hulls.placement(k), cube, place) for k in hand
        ]
        assert min(gaps) > AWAY_M
