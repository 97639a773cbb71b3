"""Probes simulated in the replays' own physics: laws of friction, and parameters recovered."""

import os
import signal
import threading
from typing import Any

import numpy as np
import pytest

from bridge.geometry import se3
from bridge.robots.default import MAX_WIDTH_M, ROBOT
from bridge.sources.standin.cell_file import load_cell
from bridge.sources.standin.kinematics import arm_kinematics, tool_down
from bridge.sources.standin.probes import plan_probe
from bridge.task.plan import Plan
from bridge.task.task_file import load_task
from twin.calibrate.config import CalibrateConfig
from twin.calibrate.physics import simulate
from twin.calibrate.physics.cases import Case, Prediction, planar
from twin.calibrate.physics.fit import fit
from twin.calibrate.physics.parameters import (
    FINGER_FRICTION,
    SURFACE_FRICTION,
    rigid_parameters,
)
from twin.calibrate.physics.simulate import Evaluator, LostPieceError, gripper_only, predict
from twin.physics.config import PhysicsConfig
from twin.physics.world import World

TASK = load_task("cube_into_box")
CONFIG = PhysicsConfig()
HOME_SEED_RAD = np.array([-0.263, -1.709, 1.365, -1.227, -1.571, 1.308])
BOX = se3.transform_from(np.array([1.0, 0, 0, 0]), np.array([0.5, 0.19, 0.0]))


def cube_at(x: float, y: float, yaw: float) -> np.ndarray:
    q = np.array([np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)])
    return se3.transform_from(q, np.array([x, y, 0.02]))


def plan_of(kind: str, T: np.ndarray) -> Plan:
    kinematics = arm_kinematics()
    home = kinematics.joints_for(
        tool_down(np.array(load_cell("standin").home_m), 0.0), HOME_SEED_RAD
    )
    return plan_probe(
        kind,
        TASK,
        {"cube": T, "box": BOX},
        kinematics=kinematics,
        joints_start_rad=home,
        max_joint_speed_rad_s=1.6,
        plan_id=kind,
        start_id="test",
    )


def case_of(kind: str, T: np.ndarray, number: int = 0) -> Case:
    """The probe as it would be executed by an arm that follows at once, cut to what matters."""
    plan = plan_of(kind, T)
    times_s = plan.times_ns() * 1e-9
    low = plan.positions_m()[:, 2] < 0.05
    edges = np.flatnonzero(np.diff(low.astype(int))).reshape(-1, 2)
    stretches = np.stack([times_s[edges[:, 0]], times_s[edges[:, 1]] + 0.05], axis=1)
    widths = np.array([MAX_WIDTH_M if w.width_m is None else w.width_m for w in plan.tau])
    opened = times_s[np.flatnonzero(np.diff(widths) > 0.01)]
    holds = opened[:1] - 0.05 if kind == "squeeze" else np.zeros(0)
    covariance = np.diag([1e-6, 1e-6, 1e-4])[None]
    return Case(
        episode=f"{kind}_{number}",
        sha256=f"{number:064x}",
        kind=kind,
        task=TASK,
        urdf=ROBOT.urdf_text(),
        joint_times_s=times_s,
        joints_rad=np.array([w.joints_rad for w in plan.tau], dtype=np.float64),
        # A width holds for the time before its waypoint, as the cell executes it.
        width_times_s=np.concatenate([[-1.0], times_s[:-1]]),
        width_commands_m=widths,
        stretches_s=stretches,
        Ts_base_start={"cube": T, "box": BOX},
        objects=("cube",),
        start_covariance=np.zeros((1, 3, 3)),
        settled=planar(T)[None],
        settled_covariance=covariance,
        turn_period_rad=np.array([np.pi / 2]),
        hold_times_s=holds,
        held_widths_m=np.zeros(len(holds)),
    )


@pytest.fixture(scope="module")
def slide() -> Case:
    return case_of("slide", cube_at(0.48, -0.1, 0.3))


@pytest.fixture(scope="module")
def squeeze() -> Case:
    return case_of("squeeze", cube_at(0.48, -0.12, 0.0))


def told(case: Case, **values: float) -> Prediction:
    return predict(case, values, CONFIG)


def test_twice_the_friction_halves_how_far_a_pushed_object_slides_on(slide: Case) -> None:
    rough, middle, smooth = (
        told(slide, **{SURFACE_FRICTION: mu}).settled[0] for mu in (0.6, 0.45, 0.3)
    )
    # x = release + d / mu, so that two differences cancel the release point.
    ratio = np.linalg.norm((smooth - rough)[:2]) / np.linalg.norm((middle - rough)[:2])
    assert ratio == pytest.approx((1 / 0.3 - 1 / 0.6) / (1 / 0.45 - 1 / 0.6), rel=0.15)


@pytest.mark.slow
def test_fingers_askew_jam_wider_on_rougher_pads_whatever_the_force(squeeze: Case) -> None:
    smooth, rough = (told(squeeze, **{FINGER_FRICTION: mu}).held_widths_m[0] for mu in (0.6, 0.8))
    assert smooth + 1e-3 < rough
    strong = told(squeeze, **{FINGER_FRICTION: 0.6, "grip_force_N": 30.0}).held_widths_m[0]
    assert strong == pytest.approx(smooth, abs=1.5e-3)


@pytest.mark.slow
def test_a_slow_push_ends_where_the_fingers_stopped_and_shows_a_bias_of_localisation() -> None:
    push = case_of("push", cube_at(0.46, -0.08, 0.2))
    smooth, rough = (told(push, **{SURFACE_FRICTION: mu}).settled[0] for mu in (0.3, 0.6))
    assert np.linalg.norm((smooth - rough)[:2]) < 1.5e-3
    biased = told(push, bias_x_m=0.003, bias_y_m=-0.002, **{SURFACE_FRICTION: 0.6}).settled[0]
    # The true end is the fingers' place either way; it is reported 3 mm less and 2 mm more.
    np.testing.assert_allclose((biased - rough)[:2], [-0.003, 0.002], atol=1e-3)


def test_every_run_and_every_process_gives_the_same_bits(slide: Case) -> None:
    first, again = told(slide), told(slide)
    np.testing.assert_array_equal(first.settled, again.settled)


def test_what_lies_still_is_not_watched_longer_and_would_have_stayed(
    slide: Case, monkeypatch: pytest.MonkeyPatch
) -> None:
    steps = []

    class Counted(World):
        def step(self) -> None:
            steps.append(None)
            super().step()

    monkeypatch.setattr(simulate, "World", Counted)
    soon, quick = told(slide), len(steps)
    monkeypatch.setattr(simulate, "REST", -1.0)
    late = told(slide)
    assert len(steps) - quick > quick + 0.3 * CONFIG.rate_hz
    np.testing.assert_allclose(soon.settled, late.settled, atol=5e-5)


@pytest.mark.slow
def test_friction_of_simulated_slides_is_recovered_within_its_interval_in_processes() -> None:
    some = tuple(item for item in rigid_parameters(CONFIG) if item.name == SURFACE_FRICTION)
    rng = np.random.default_rng(3)
    cases = []
    for number, yaw in enumerate((0.3, -0.4, 0.1)):
        case = case_of("slide", cube_at(0.48, -0.1, yaw), number)
        seen = predict(case, {SURFACE_FRICTION: 0.45}, CONFIG)
        noise = rng.standard_normal((1, 3)) * [0.001, 0.001, 0.01]
        cases.append(Case(**{**vars(case), "settled": seen.settled + noise}))
    with Evaluator(cases, some, CONFIG, workers=2) as evaluator:
        found = fit(evaluator, some, CalibrateConfig(evaluations=8))
        (pooled,) = evaluator.predict(np.zeros((1, 1)), [0])
    (item,) = found.estimates
    assert item.identified
    assert item.low <= 0.45 <= item.high
    assert (item.high - item.low) / 2 / item.value < 0.25
    assert found.promoted
    alone = told(cases[0], **{SURFACE_FRICTION: some[0].value(0.0)})
    np.testing.assert_array_equal(pooled[0].settled, alone.settled)


def test_only_the_gripper_collides() -> None:
    text = gripper_only(ROBOT.urdf_text())
    assert text.count("<collision") == 3
    assert "<visual" not in text


@pytest.mark.slow
def test_a_process_that_is_killed_while_it_simulates_costs_nothing(slide: Case) -> None:
    """Whenever it is killed: the pool of the standard library waits for ever after some deaths."""
    parameters = rigid_parameters(CONFIG)
    points = np.zeros((12, len(parameters)))
    points[:, 0] = np.linspace(-1, 1, len(points))
    alone = Evaluator([slide], parameters, CONFIG).predict(points, [0])
    with Evaluator([slide], parameters, CONFIG, workers=2) as evaluator:
        evaluator.predict(points[:2], [0])
        assert evaluator._pool is not None
        first, second = [worker.pid for worker in evaluator._pool.workers]
        os.kill(first, signal.SIGKILL)
        killer = threading.Timer(0.05, os.kill, (second, signal.SIGKILL))
        killer.start()
        side = evaluator.predict(points, [0])
        killer.join()
    assert len(side) == len(alone)
    for (one,), (other,) in zip(alone, side, strict=True):
        np.testing.assert_array_equal(one.settled, other.settled)


@pytest.mark.slow
def test_a_case_no_process_survives_ends_a_calibration_with_a_sentence(
    slide: Case, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Memory runs out each time, say."""
    monkeypatch.setattr(simulate, "_predict", _die)
    with (
        Evaluator([slide], rigid_parameters(CONFIG), CONFIG, workers=2) as evaluator,
        pytest.raises(LostPieceError, match=r"SIGKILL.*2 times\. Nothing.*fewer --workers"),
    ):
        evaluator.predict(np.zeros((1, 7)), [0])


def _die(piece: Any) -> None:
    os.kill(os.getpid(), signal.SIGKILL)
