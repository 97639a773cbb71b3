"""The audit of a clearance by python-fcl: each planted over-estimate is found, none is invented."""

import sys
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scripted_plans import joints_over
from verdicts import verdict_of

from bridge.geometry import se3
from bridge.task.plan import Plan
from bridge.task.verdict import Factor
from twin.replay.audit import NEAR_M, audit
from twin.replay.checks import limited_to_task
from twin.replay.clearance.monitor import ClearanceMonitor
from twin.replay.config import ReplayConfig
from twin.replay.result import ReplayResult
from twin.replay.scene import ReplayScene
from twin.robot.collision import RobotHulls, convex_hull, hulls_of
from twin.robot.model import load_robot
from twin.scene.shape.sdf import SdfGrid
from twin.scene.shape.static import StaticSdf

CONFIG = ReplayConfig()
PLANTED = 100
OVER_M = 0.002
"""A plant says at least this much more than what is there."""


def held(
    scene: ReplayScene, postures_rad: list[np.ndarray], width_m: float, said_m: float
) -> ReplayResult:
    """A replay that goes through postures, whose clearance said the same of each."""
    count = len(postures_rad)
    return ReplayResult(
        verdict=verdict_of(),
        stamps_ns=10_000_000 * np.arange(count),
        joints_rad=np.stack(postures_rad),
        width_m=np.full(count, width_m),
        Ts_base_tcp=np.tile(np.eye(4), (count, 1, 1)),
        Ts_base_object={
            name: np.repeat(T[None], count, axis=0) for name, T in scene.Ts_base_object.items()
        },
        finger_contact={},
        clearance_m=np.full(count, said_m),
        contacts=[],
    )


def standing(
    scene: ReplayScene, joints_rad: np.ndarray, width_m: float, said_m: float
) -> ReplayResult:
    return held(scene, [joints_rad, joints_rad], width_m, said_m)


def measured(
    scene: ReplayScene, plan: Plan, hulls: RobotHulls, joints_rad: np.ndarray, width_m: float
) -> float:
    monitor = ClearanceMonitor(scene, plan, hulls, CONFIG)
    return monitor.measure(0, joints_rad, width_m, scene.movable())


def shrunken(scene: ReplayScene, rng: np.random.Generator) -> tuple[ReplayScene, RobotHulls]:
    """The fingers' hulls are smaller than the fingers."""
    hulls = RobotHulls(load_robot(scene.urdf))
    for index, hull in enumerate(hulls.hulls):
        if hull.link.endswith("finger"):
            middle = hull.points_m.mean(axis=0)
            points = middle + rng.uniform(0.6, 0.9) * (hull.points_m - middle)
            hulls.hulls[index] = replace(hull, points_m=points, shape=convex_hull(points))
    return scene, hulls


def sunken(scene: ReplayScene, rng: np.random.Generator) -> tuple[ReplayScene, RobotHulls]:
    """The table is lower than it is."""
    lower = replace(scene, table_height_m=-float(rng.uniform(0.003, 0.03)))
    return lower, hulls_of(load_robot(scene.urdf))


def shifted(name: str) -> Callable[..., tuple[ReplayScene, RobotHulls]]:
    """An object is farther away, or lies turned."""

    def plant(scene: ReplayScene, rng: np.random.Generator) -> tuple[ReplayScene, RobotHulls]:
        T = scene.Ts_base_object[name].copy()
        T[:2, 3] += rng.uniform(-0.05, 0.05, 2)
        T[2, 3] -= rng.uniform(0.003, 0.02)
        there = {**scene.Ts_base_object, name: T}
        return replace(scene, Ts_base_object=there), hulls_of(load_robot(scene.urdf))

    return plant


def forgotten(scene: ReplayScene, rng: np.random.Generator) -> tuple[ReplayScene, RobotHulls]:
    there = {name: T for name, T in scene.Ts_base_object.items() if name != "box"}
    return replace(scene, Ts_base_object=there), hulls_of(load_robot(scene.urdf))


PLANTS = (shrunken, sunken, shifted("box"), shifted("cube"), forgotten)


def test_every_planted_over_estimate_is_found_and_no_true_one_is_called_wrong(
    script: SimpleNamespace,
) -> None:
    scene = script.scene()
    hulls = hulls_of(load_robot(scene.urdf))
    strict = replace(
        script.plan(scene),
        stages=tuple(replace(s, allowed_contacts=()) for s in script.plan(scene).stages),
    )
    rng = np.random.default_rng(7)
    found, tried = dict.fromkeys(range(len(PLANTS)), 0), 0
    while sum(found.values()) < PLANTED:
        kind = tried % len(PLANTS)
        tried += 1
        over = scene.Ts_base_object["cube" if kind == 3 else "box"][:3, 3]
        p = over + np.append(rng.uniform(-0.1, 0.1, 2), rng.uniform(0.025, 0.1))
        joints, width = joints_over(scene, *p.tolist()), float(rng.uniform(0.02, 0.085))
        true_m = measured(scene, strict, hulls, joints, width)
        if not 0.0 < true_m < NEAR_M - 0.005:
            continue
        there, planted = PLANTS[kind](scene, rng)
        said_m = measured(there, strict, planted, joints, width)
        if said_m < true_m + OVER_M:
            continue
        honest = audit(standing(scene, joints, width, true_m), strict, scene, CONFIG)
        assert honest.value is True, honest.detail
        factor = audit(standing(scene, joints, width, said_m), strict, scene, CONFIG)
        assert factor.value is None, (PLANTS[kind], p, true_m, said_m)
        assert f"the clearance said {said_m * 1e3:.1f} mm" in str(factor.detail)
        found[kind] += 1
        assert tried < 40 * PLANTED
    assert min(found.values()) >= 3, found


def test_a_clearance_that_is_a_millimetre_too_large_somewhere_is_found(
    script: SimpleNamespace, good: ReplayResult
) -> None:
    plan = limited_to_task(script.plan(script.scene()), script.scene().task)
    said = good.clearance_m.copy()
    said[int(np.argmin(said))] += 0.001
    factor = audit(replace(good, clearance_m=said), plan, script.scene(), CONFIG)
    assert factor.value is None
    low, high = said.min() * 1e3 - 0.2, good.clearance_m.min() * 1e3 + 1.05
    assert f"the clearance said {good.clearance_m.min() * 1e3 + 1:.1f} mm" in str(factor.detail)
    assert low < high


def test_a_contact_between_two_states_is_found(script: SimpleNamespace) -> None:
    """The tips are 28 mm over the table at both ends, and in it half way."""
    scene, plan = script.scene(), script.plan(script.scene())
    above, below = (joints_over(scene, 0.62, -0.1, z) for z in (0.038, 0.005))
    assert audit(held(scene, [above, above], 0.08, 0.028), plan, scene, CONFIG).value is True
    dip = audit(held(scene, [above, below, above], 0.08, 0.028), plan, scene, CONFIG)
    assert dip.value is None
    assert "0.0 mm from table at 0.01 s" in str(dip.detail)
    # The shoulder swings the tips through the box; at both ends they are far beside it.
    left, right = (joints_over(scene, 0.4, y, 0.03) for y in (-0.4, 0.4))
    for ends in ([left, left], [right, right]):
        assert audit(held(scene, ends, 0.08, 0.0195), plan, scene, CONFIG).value is True
    swing = audit(held(scene, [left, right], 0.08, 0.0195), plan, scene, CONFIG)
    assert swing.value is None
    assert "0.0 mm from" in str(swing.detail)
    assert audit(
        held(scene, [left, right], 0.08, 0.0195), plan, scene, CONFIG, max_queries=50
    ) == Factor(
        value=None, detail="the audit needs more than 50 distances; nothing is said without it"
    )


def test_what_has_no_name_in_the_scene_is_measured_by_its_surface(script: SimpleNamespace) -> None:
    """A block of 10 cm stands where nobody knows of it; the tool hangs 25 mm beside it."""
    scene = script.scene()
    voxel = 0.01
    axes = [np.arange(n) * voxel for n in (40, 40, 30)]
    origin = np.array([0.5, -0.3, 0.0])
    x, y, z = np.meshgrid(*axes, indexing="ij")
    inside = np.stack([np.abs(x - 0.2) - 0.05, np.abs(y - 0.2) - 0.05, z - 0.2])
    outside = np.linalg.norm(np.maximum(inside, 0.0), axis=0)
    values = (outside + np.minimum(inside.max(axis=0), 0.0)).astype(np.float32)
    grid = SdfGrid(values_m=values, origin_m=origin, voxel_m=voxel, closed=False)
    static = StaticSdf(
        conservative=grid, observed=grid,
    )  # fmt: skip
    cluttered = replace(scene, static_sdf=static)
    joints = joints_over(scene, 0.7, -0.1 + 0.05 + 0.045, 0.12)
    plan = script.plan(scene)
    blind = standing(scene, joints, 0.02, 0.0285)  # the upper arm is so far from the table
    assert audit(blind, plan, scene, CONFIG).value is True
    factor = audit(blind, plan, cluttered, CONFIG)
    assert factor.value is None
    assert "from scene" in str(factor.detail)
    knowing = measured(cluttered, plan, hulls_of(load_robot(scene.urdf)), joints, 0.02)
    assert audit(standing(scene, joints, 0.02, knowing), plan, cluttered, CONFIG).value is True


def test_without_the_library_there_is_no_yes(
    script: SimpleNamespace, good: ReplayResult, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "fcl", None)
    factor = audit(good, script.plan(script.scene()), script.scene(), CONFIG)
    assert factor == Factor(
        value=None, detail="the clearance cannot be audited: install python-fcl ([replay])"
    )


def test_toys_and_baskets_are_audited_by_their_own_meshes(script: SimpleNamespace) -> None:
    """The basket's rim is where its mesh is, whatever the boxes are that stand for its walls."""
    scene = script.toy_scene()
    T = scene.Ts_base_object["basket"]
    rim = se3.apply(T, np.array([[0.0, 0.06, 0.12]]))[0]
    joints = joints_over(scene, *rim.tolist())
    plan = script.toy_plan(scene)
    inside = audit(standing(scene, joints, 0.085, 0.028), plan, scene, CONFIG)
    assert inside.value is None
    assert "from basket" in str(inside.detail)
