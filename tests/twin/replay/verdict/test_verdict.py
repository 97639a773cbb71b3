"""I(tau): what is accepted, what is rejected, by which factor, when and between whom."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from bridge.geometry import se3
from twin.physics.world import World
from twin.replay.config import Mode, ReplayConfig
from twin.replay.failure import NotEvaluatedError
from twin.replay.path import UnusablePlanError
from twin.replay.result import ReplayResult
from twin.replay.verdict import replay_joints, replay_plan

KINEMATIC = ReplayConfig(mode="kinematic")


def test_the_cube_is_carried_between_the_fingers(good: ReplayResult) -> None:
    """While held, the cube moves with the tool: the slip is millimetres."""
    held = good.finger_contact["cube"] & (good.Ts_base_object["cube"][:, 2, 3] > 0.08)
    assert held.sum() > 60
    T_tcp_cube = se3.invert(good.Ts_base_tcp[held]) @ good.Ts_base_object["cube"][held]
    slip = np.linalg.norm(T_tcp_cube[:, :3, 3] - T_tcp_cube[0, :3, 3], axis=1)
    assert slip.max() < 4e-3


@pytest.mark.parametrize("mode", ["kinematic", pytest.param("dynamic", marks=pytest.mark.slow)])
def test_a_dip_below_the_table_is_rejected_by_clearance(
    script: SimpleNamespace, mode: Mode
) -> None:
    scene = script.scene()
    plan = script.plan(scene, grasp_offset_m=(0.12, 0.0, -0.04))
    clearance = replay_plan(plan, scene, ReplayConfig(mode=mode)).verdict.clearance
    assert clearance.value is False
    assert clearance.bodies[0].startswith("gripper_")
    assert clearance.bodies[1] == "table"
    assert clearance.first_t_ns is not None
    assert 0.7e9 < clearance.first_t_ns < 1.1e9, "the tool arrives at 1 s"


def test_a_finger_that_lands_on_the_cube_is_named(script: SimpleNamespace) -> None:
    scene = script.scene()
    T = scene.Ts_base_object["cube"]
    along_opening = T[:3, 1] * 0.035
    plan = script.plan(scene, grasp_offset_m=tuple(along_opening.tolist()))
    clearance = replay_plan(plan, scene, KINEMATIC).verdict.clearance
    assert clearance.value is False
    assert clearance.cause == "pre_grasp_penetration"
    assert clearance.bodies[1] == "cube"
    assert "finger" in clearance.bodies[0]


@pytest.mark.slow
def test_a_contact_the_stage_does_not_allow_is_rejected(script: SimpleNamespace) -> None:
    scene = script.scene()
    plan = script.plan(scene)
    strict = tuple(replace(stage, allowed_contacts=()) for stage in plan.stages)
    clearance = replay_plan(replace(plan, stages=strict), scene, ReplayConfig()).verdict.clearance
    assert clearance.value is False
    assert "cube" in clearance.bodies


def test_a_carry_through_the_wall_of_the_box_is_rejected(script: SimpleNamespace) -> None:
    scene = script.scene()
    plan = script.plan(scene, carry_height_m=0.03)
    clearance = replay_plan(plan, scene, KINEMATIC).verdict.clearance
    assert clearance.value is False
    assert clearance.cause == "deep_contact"
    assert clearance.bodies[1] == "box"


@pytest.mark.parametrize("index", [0, 40])
def test_an_unreachable_waypoint_is_rejected_by_ik_at_its_time(
    script: SimpleNamespace, index: int
) -> None:
    scene = script.scene()
    plan = script.with_joints(script.plan(scene), scene, 0.04)
    tau = list(plan.tau)
    tau[index] = replace(tau[index], p_m=(2.0, 0.0, 0.3), joints_rad=None)
    verdict = replay_plan(replace(plan, tau=tuple(tau)), scene, KINEMATIC).verdict
    assert verdict.ik.value is False
    assert verdict.ik.cause == "unreachable"
    assert verdict.ik.first_t_ns == tau[index].t_ns
    assert verdict.clearance.value is None, "what comes after the pose is not known"
    assert verdict.accepted is False


def test_joints_that_contradict_the_pose_are_rejected(script: SimpleNamespace) -> None:
    scene = script.scene()
    plan = script.with_joints(script.plan(scene), scene)
    tau = list(plan.tau)
    joints = np.array(tau[10].joints_rad) + np.array([0.01, 0, 0, 0, 0, 0])
    tau[10] = replace(tau[10], joints_rad=tuple(joints.tolist()))
    ik = replay_plan(replace(plan, tau=tuple(tau)), scene, KINEMATIC).verdict.ik
    assert (ik.value, ik.cause, ik.first_t_ns) == (False, "joints_disagree", tau[10].t_ns)


def test_given_joints_and_solved_joints_lead_to_the_same_motion(script: SimpleNamespace) -> None:
    scene = script.scene()
    plan = script.plan(scene)
    solved = replay_plan(plan, scene, KINEMATIC)
    given = replay_plan(script.with_joints(plan, scene, 0.04), scene, KINEMATIC)
    assert given.verdict.ik.value is True
    path = np.array(
        [
            np.interp(given.stamps_ns, solved.stamps_ns, solved.Ts_base_tcp[:, i, 3])
            for i in range(3)
        ]
    ).T
    gap = np.linalg.norm(path - given.Ts_base_tcp[:, :3, 3], axis=1)
    assert gap.max() < 5e-3, "waypoints each 40 ms cut the corners by a few millimetres"


def test_a_branch_flip_is_a_joint_jump(script: SimpleNamespace) -> None:
    """Full turns of the wrist reach the same pose, but nobody turns so fast."""
    scene = script.scene()
    plan = script.with_joints(script.plan(scene), scene)
    turned = np.array([0, 0, 0, 0, 0, 2 * np.pi])
    tau = list(plan.tau)
    sign = -1.0 if tau[60].joints_rad[5] > 0 else 1.0
    for index in range(60, len(tau)):
        joints = np.array(tau[index].joints_rad) + sign * turned
        tau[index] = replace(tau[index], joints_rad=tuple(joints.tolist()))
    ik = replay_plan(replace(plan, tau=tuple(tau)), scene, KINEMATIC).verdict.ik
    assert (ik.value, ik.cause) == (False, "joint_jump")
    assert ik.bodies == ("wrist_3_joint",)
    assert abs(ik.first_t_ns - tau[59].t_ns) <= 40_000_000


def test_a_kinematic_replay_leaves_the_terminal_state_open(script: SimpleNamespace) -> None:
    scene = script.scene()
    result = replay_plan(script.plan(scene), scene, KINEMATIC)
    assert result.verdict.ik.value is True
    assert result.verdict.clearance.value is True
    assert result.verdict.terminal.value is None
    assert "kinematic" in (result.verdict.terminal.detail or "")
    assert result.verdict.accepted is None
    assert set(result.Ts_base_object) == {"box"}, "nothing is known of the cube"


@pytest.mark.slow
@pytest.mark.parametrize("lost", ["cube", "box"])
def test_an_object_that_was_not_localised_leaves_the_verdict_open(
    script: SimpleNamespace, lost: str
) -> None:
    plan = script.plan(script.scene())
    scene = replace(script.scene(missing=(lost,)), reasons={lost: "hidden by the arm"})
    verdict = replay_plan(plan, scene, ReplayConfig()).verdict
    assert verdict.terminal.value is None
    assert verdict.clearance.value is None
    assert "hidden by the arm" in (verdict.reason or "")
    assert verdict.accepted is None


def test_a_kinematic_replay_follows_recorded_joints_exactly(
    script: SimpleNamespace, good: ReplayResult
) -> None:
    scene = script.scene()
    track, widths = script.recorded_tracks(good)
    result = replay_joints(track, widths, scene, KINEMATIC, plan=script.plan(scene))
    assert np.allclose(result.joints_rad, track.at(result.stamps_ns), atol=1e-9)
    assert result.verdict.clearance.value is True


def test_recorded_joints_in_another_order_are_sorted_by_name(
    script: SimpleNamespace, good: ReplayResult
) -> None:
    scene = script.scene()
    track, widths = script.recorded_tracks(good)
    mixed = replace(track, names=track.names[::-1], position=track.position[:, ::-1])
    plan = script.plan(scene)
    one = replay_joints(track, widths, scene, KINEMATIC, plan=plan)
    other = replay_joints(mixed, widths, scene, KINEMATIC, plan=plan)
    assert np.array_equal(one.joints_rad, other.joints_rad)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"tau": ()}, "no waypoints"),
        ({"frame": "camera"}, "frame 'camera'"),
        ({"joint_names": ("a", "b")}, "names the joints a, b"),
    ],
)
def test_a_plan_that_cannot_be_replayed_is_refused(
    script: SimpleNamespace, change: dict[str, object], message: str
) -> None:
    scene = script.scene()
    with pytest.raises(UnusablePlanError, match=message):
        replay_plan(replace(script.plan(scene), **change), scene, KINEMATIC)


def test_a_rigid_body_that_physics_lost_is_not_judged(
    script: SimpleNamespace, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No distance to it is ever below a limit, so it would touch nothing and lie well."""
    monkeypatch.setattr(World, "object_pose", lambda *_: (np.nan,) * 7)
    scene = script.scene()
    plan = script.plan(scene)
    with pytest.raises(NotEvaluatedError, match="physics lost cube: its place is no"):
        replay_plan(replace(plan, tau=plan.tau[:1]), scene, ReplayConfig(settle_after_s=0.1))
