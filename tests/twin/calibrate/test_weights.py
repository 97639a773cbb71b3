"""A weight in the hand, found again from efforts that another engine's inverse dynamics makes."""

import re
from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np
import pytest

from bridge.robots.default import ROBOT
from twin.calibrate.weights import NoWeightError, smoothed, weight_of
from twin.robot.model import load_robot

ARM = load_robot(ROBOT.description())
TIMES_S = np.arange(0, 12, 0.008)
FREE, HELD = TIMES_S < 5.5, (TIMES_S > 6) & (TIMES_S < 11.5)
MOST_NM = np.array([150.0, 150, 150, 28, 28, 28])


def model_with(mass_kg: float, centre_m: tuple[float, float, float]) -> mujoco.MjModel:
    """The arm's description in MuJoCo, with a ball at the tool."""
    text = re.sub(r"<(visual|collision)\b.*?</\1>", "", ARM.urdf, flags=re.DOTALL)
    x, y, z = centre_m
    ball = f"""<link name="ball"><inertial><origin xyz="{x} {y} {z}"/><mass value="{mass_kg}"/>
      <inertia ixx="1e-5" iyy="1e-5" izz="1e-5" ixy="0" ixz="0" iyz="0"/></inertial></link>
      <joint name="held" type="fixed"><parent link="{ARM.record.tool_frame}"/><child link="ball"/>
      </joint></robot>"""
    return mujoco.MjModel.from_xml_string(text.replace("</robot>", ball))


def joints_at(times_s: np.ndarray, order: int = 0) -> np.ndarray:
    """Sines about the arm's posture at rest, each joint with a rhythm of its own; derivatives."""
    rhythm = np.array([0.9, 0.7, 1.1, 1.3, 0.8, 1.5])
    size = np.array([0.5, 0.25, 0.35, 0.5, 0.4, 0.6])
    waves = size * rhythm**order * np.sin(np.outer(times_s, rhythm) + order * np.pi / 2)
    return waves + ARM.home_rad * (order == 0)


def efforts_of(mass_kg: float, centre_m: tuple[float, float, float]) -> np.ndarray:
    model = model_with(mass_kg, centre_m)
    data = mujoco.MjData(model)
    at = [model.joint(name).dofadr[0] for name in ARM.joints]
    rows = []
    for index in range(len(TIMES_S)):
        for order, name in enumerate(("qpos", "qvel", "qacc")):
            getattr(data, name)[at] = joints_at(TIMES_S[index : index + 1], order)[0]
        mujoco.mj_inverse(model, data)
        rows.append(data.qfrc_inverse[at].copy())
    return np.array(rows)


EMPTY = efforts_of(1e-6, (0.0, 0.0, 0.0))


def measured(seed: int) -> tuple[dict[str, Any], float, tuple[float, float, float]]:
    """A weight that is drawn, sensors with bias, drift and noise, joints with dry friction."""
    rng = np.random.default_rng(seed)
    mass_kg = float(np.exp(rng.uniform(np.log(0.05), 0.0)))
    centre_m = tuple(rng.uniform(-0.03, 0.03, 3).tolist())
    efforts = np.where(TIMES_S[:, None] > 5.8, efforts_of(mass_kg, centre_m), EMPTY)
    drift = 0.01 * np.outer(TIMES_S / 12, rng.normal(size=6))
    efforts += MOST_NM * (0.02 * rng.uniform(-1, 1, 6) + drift)
    efforts += 0.03 * MOST_NM * np.tanh(joints_at(TIMES_S, 1) / 0.003)
    efforts += 0.002 * MOST_NM * rng.normal(size=efforts.shape)
    encoders = joints_at(TIMES_S) + 5e-5 * rng.normal(size=efforts.shape)
    return weighed(efforts, encoders), mass_kg, centre_m


def weighed(efforts: np.ndarray, encoders: np.ndarray | None = None) -> dict[str, Any]:
    moved = smoothed(TIMES_S, joints_at(TIMES_S) if encoders is None else encoders, efforts)
    free, held = (np.interp(moved[:, 0], TIMES_S, mask) > 0.5 for mask in (FREE, HELD))
    return weight_of(ARM, moved, free, held)


def test_a_weight_and_its_centre_are_found_again_within_their_intervals() -> None:
    inside, centres = 0, 0
    for seed in range(20):
        found, mass_kg, centre_m = measured(seed)
        assert found["half_kg"] < 0.03, (seed, found, mass_kg)
        inside += abs(found["mass_kg"] - mass_kg) <= found["half_kg"]
        off_m = np.abs(np.array(found["centre_m"]) - centre_m)
        centres += int((off_m <= np.array(found["centre_half_m"])).sum())
    assert inside >= 17
    assert centres >= 54


@pytest.mark.parametrize(
    ("spoil", "why"),
    [
        (lambda efforts: np.full_like(efforts, 3.0), "do not change"),
        (lambda efforts: np.where(TIMES_S[:, None] > 3, np.nan, efforts), "no numbers"),
        (lambda efforts: -efforts, "the other sign at joint"),
        (lambda efforts: efforts * [1, -1, 1, 1, 1, 1], "the other sign at joint 2"),
        (lambda efforts: 1e3 * efforts, "another unit than Nm"),
        (lambda efforts: efforts / 13.0, "another unit than Nm"),  # currents of motors
        (lambda efforts: efforts - EMPTY, "without the arm's own weight"),
        (lambda efforts: EMPTY + 0 * efforts, "nothing that weighs"),
    ],
)
def test_what_efforts_cannot_say_is_named(
    spoil: Callable[[np.ndarray], np.ndarray], why: str
) -> None:
    efforts = np.where(TIMES_S[:, None] > 5.8, efforts_of(0.3, (0.0, 0.0, 0.0)), EMPTY)
    assert abs(weighed(efforts)["mass_kg"] - 0.3) < 0.01
    with pytest.raises(NoWeightError, match=why):
        weighed(spoil(efforts))
