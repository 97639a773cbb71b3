"""The twin's arm follows as the cell's did: identified from what was sent and what it did."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from drawn_run import HOME, at_positions
from scipy.signal import lsim

from bridge.episode import schema
from bridge.episode.cdr.messages import CompressedColor, string_to_cdr
from bridge.episode.metadata import EpisodeInfo
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.episode.streams import JointTrack
from bridge.episode.writer import EpisodeWriter
from bridge.robots.default import ARM_JOINTS, ROBOT
from bridge.robots.robot import GRIPPER_WIDTH
from twin.policies.cell import TwinCell
from twin.policies.identify import Sent, grip_of, lags_of, response_of, stiffness_of
from twin.policies.response import AT_ONCE, Controller, Response
from twin.policies.shutter import ALWAYS, shutter_of
from twin.policies.starts import Start
from twin.robot.inverse import solve_ik
from twin.robot.model import load_robot

DELAY_S, LAGS_S = 0.06, (0.045, 0.045, 0.04, 0.03, 0.025, 0.03)
STIFFNESS = (9000.0, 8000.0, 6000.0, 2500.0, 2000.0, 1500.0)
TICK_S = 0.008


def track(times_s: np.ndarray, rows: np.ndarray, names: tuple[str, ...] = ARM_JOINTS) -> JointTrack:
    return JointTrack(
        names=names, stamps_ns=np.round(times_s * 1e9).astype(np.int64), position=rows
    )


def recorded(rng: np.random.Generator) -> Sent:
    """Waypoints every 0.4 s; followed as scipy solves it, and pressed on half the way."""
    times_s = np.arange(0.0, 12.0, TICK_S)
    knots_s = np.arange(0.0, 12.4, 0.4)
    knots = HOME + np.cumsum(rng.uniform(-0.15, 0.15, (len(knots_s), 6)), axis=0)
    knots[12:16] = knots[12]  # it rests, and something leans on it
    targets = track(knots_s, knots)
    late = targets.at(np.round((times_s - DELAY_S) * 1e9))
    loads_Nm = np.zeros_like(late)
    leaned = (times_s > 5.6) & (times_s < 6.3)
    loads_Nm[leaned] = np.array([40.0, -50.0, 30.0, 8.0, -9.0, 7.0])
    inputs = late - loads_Nm / np.array(STIFFNESS)
    columns = [
        lsim(([1.0], [lag_s, 1.0]), x - x[0], times_s)[1] + x[0]
        for lag_s, x in zip(LAGS_S, inputs.T, strict=True)
    ]
    joints = np.stack(columns, axis=1) + rng.normal(0.0, 5e-5, late.shape)
    widths_m = np.clip(0.085 - 0.15 * (times_s - 3.09), 0.04, 0.085)
    widths = track(times_s, widths_m[:, None], ("gripper_width",))
    closed_ns = [(3_000_000_000, 6_000_000_000)]
    return Sent(targets, track(times_s, joints), closed_ns, widths, loads_Nm)


def test_delay_lags_stiffness_and_fingers_are_found_again(start: Start) -> None:
    trials = [recorded(np.random.default_rng(seed)) for seed in (1, 2)]
    delay_s, lags_s = lags_of(trials)
    assert delay_s == pytest.approx(DELAY_S, abs=0.005)
    np.testing.assert_allclose(lags_s, LAGS_S, atol=0.006)
    robot = load_robot(start.scene.urdf)
    found = stiffness_of(trials, delay_s, lags_s, robot)
    np.testing.assert_allclose(found, STIFFNESS, rtol=0.15)
    assert grip_of(trials) == pytest.approx((0.09, 0.15), abs=1e-3)
    slow_m = 0.085 - (0.085 - trials[0].widths.position) / 3
    held_up = trials[0]._replace(widths=replace(trials[0].widths, position=slow_m))
    assert grip_of([held_up, trials[0], held_up]) == pytest.approx((0.09, 0.15), abs=1e-3)
    free = [each._replace(loads_Nm=0.0 * each.loads_Nm) for each in trials]
    assert set(stiffness_of(free, delay_s, lags_s, robot)) == {np.inf}


def write_trial(
    run: RunFolder, trial: Sent, name: str, first_ns: int, *, fingers: bool = False
) -> Episode:
    """Joints and fingers as they were, targets one period ahead, pictures 60 ms late.

    With ``fingers`` the width is said by a finger among the joint states, as many drivers do.
    """
    path = run.episodes_dir / f"{name}.mcap"
    with EpisodeWriter(path) as writer:
        writer.describe(EpisodeInfo(id=name, kind="trial", task="cube_into_box"))

        def say(topic: str, kind: str, stamp_ns: int, message: Any, late_ns: int = 0) -> None:
            data = message.to_cdr() if hasattr(message, "to_cdr") else message
            came_ns = 10**15 + stamp_ns + late_ns  # by another clock
            writer.write(topic, data, type_name=kind, log_time_ns=came_ns, publish_time_ns=stamp_ns)

        say("/robot_description", schema.STRING, first_ns, string_to_cdr(ROBOT.urdf_text()))
        width_m = np.where(trial.targets.stamps_ns < 2.79e9, 0.085, 0.0)[:-1]
        ahead = np.column_stack([trial.targets.position[1:], width_m])
        finger, widths_m = ROBOT.gripper.fingers[0], trial.widths.at(trial.joints.stamps_ns)
        joints, arm = ARM_JOINTS, trial.joints.position
        if fingers:
            joints, arm = (*joints, finger.joint), np.hstack([arm, finger.value(widths_m)])
        for topic, names, stamps_ns, rows in (
            ("joint_states", joints, trial.joints.stamps_ns, arm),
            ("policy/targets", (*ARM_JOINTS, GRIPPER_WIDTH), trial.targets.stamps_ns[:-1], ahead),
            ("gripper/state", (GRIPPER_WIDTH,), trial.widths.stamps_ns, trial.widths.position),
        ):
            if fingers and topic == "gripper/state":
                continue
            for stamp_ns, row in zip((first_ns + stamps_ns).tolist(), rows, strict=True):
                sample = at_positions(stamp_ns, names, row)
                say(f"/cell/{topic}", schema.JOINT_STATE, stamp_ns, sample)
        for stamp_ns in range(first_ns, first_ns + 3 * 10**9, 200_000_000):
            picture = CompressedColor(stamp_ns=stamp_ns, frame_id="side", format="jpeg", data=b"-")
            topic = "/cell/cam/side/color/image"
            say(topic, schema.COMPRESSED_IMAGE, stamp_ns, picture, 60_000_000)
    return Episode.open(path)


@pytest.mark.parametrize("fingers", [False, True])
def test_a_trial_teaches_the_others_of_its_run(
    tmp_path: Path, run: RunFolder, fingers: bool
) -> None:
    robot, folder = load_robot(ROBOT.urdf_text()), RunFolder.create(tmp_path / "taught")
    first, _ = (
        write_trial(
            folder, recorded(np.random.default_rng(n)), f"trial_{n}", n * 10**11, fingers=fingers
        )
        for n in (1, 2)
    )
    once = recorded(np.random.default_rng(3))
    two = track(np.array([0.0, 0.1]), once.joints.position[:2])  # of which one is sent
    write_trial(folder, once._replace(targets=two), "trial_0", 10**10)
    found = response_of(folder, first, robot)
    assert found.delay_s == pytest.approx(DELAY_S, abs=0.009)  # one reading every 8 ms
    np.testing.assert_allclose(found.lags_s, LAGS_S, atol=0.009)
    assert (found.grip_delay_s, found.grip_speed_m_s) == pytest.approx((0.29, 0.15), abs=2e-3)
    assert found.stiffness_Nm_rad == ()  # nobody measured efforts
    assert "at 0.15 m/s, as the cell's" in found.describe()
    nothing_sent = Episode.open(run.episodes_dir / "trial_1.mcap")
    assert response_of(run, nothing_sent, robot) == AT_ONCE
    shutter = shutter_of(first, "side", 10**11 + 500_000_000)
    assert (shutter.period_ns, shutter.first_ns) == (200_000_000, -100_000_000)
    assert shutter.late_ns == pytest.approx(60_000_000, abs=8_000_000)
    late = replace(shutter, late_ns=60)
    assert [late.newest_ns(100_000_000 + k) for k in (59, 60)] == [-100_000_000, 100_000_000]
    assert ALWAYS.newest_ns(12345) == 12345


def test_a_ramp_is_followed_by_its_speed_times_delay_and_lag() -> None:
    speed = np.array([0.5, -0.4, 0.3, 0.2, 0.1, 0.6])
    response = Response(delay_s=0.05, lags_s=LAGS_S, grip_delay_s=0.14, grip_speed_m_s=0.12)
    told = Controller(response, HOME, 0.08, 240)
    for step in range(1, 241):
        told.step(HOME + speed * step / 240, 0.0)
    behind = HOME + speed - told.joints_rad
    np.testing.assert_allclose(behind, speed * (0.05 + np.array(LAGS_S)), atol=2e-3)
    np.testing.assert_allclose(told.velocity_rad_s, speed, atol=1e-6)
    for step, width_m in ((20, 0.08), (64, 0.08 - 0.12 * 40 / 240)):
        told = Controller(response, HOME, 0.08, 240)
        for _ in range(step):
            told.step(HOME, 0.0)
        assert told.width_m == pytest.approx(width_m, abs=1e-9)


def test_a_pressed_arm_gives_way_like_its_springs(start: Start) -> None:
    """Statics: what presses at the tool is what the springs pull with."""
    response = Response(lags_s=LAGS_S, stiffness_Nm_rad=STIFFNESS)
    cell = TwinCell(replace(start, response=response))
    try:
        np.testing.assert_allclose(cell.posture()[0], HOME, atol=2e-3)  # its weight is carried
        T = cell.robot.T_base_tcp(HOME)
        while cell._world.arm_force_N() < 60.0:
            T[2, 3] -= 0.004
            target = solve_ik(cell.robot, T, warm_start_rad=cell.target_rad).joints_rad
            cell.go(target, 0.0, 0.1)
        cell.hold(1.0)
        joints_rad = cell.posture()[0]
        q, ids = cell.robot.configuration(joints_rad), cell.robot.arm_velocity_ids
        frame = (cell.robot.tcp_id, pin.LOCAL_WORLD_ALIGNED)
        data = cell.robot.model.createData()
        J = pin.computeFrameJacobian(cell.robot.model, data, q, *frame)[:3, ids]
        pull_Nm = np.array(STIFFNESS) * (cell.target_rad - joints_rad)
        down_N = -np.linalg.lstsq(J.T, pull_Nm, rcond=None)[0][2]
        assert down_N > 30.0, T[2, 3]
        assert cell._world.arm_force_N() == pytest.approx(down_N, rel=0.25)
    finally:
        cell.close()
