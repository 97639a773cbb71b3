"""What an imported arm was told: the velocity law against a plain loop, and the record."""

import json
from typing import Any

import numpy as np
import pytest

from bridge.errors import InvalidRecordError
from bridge.task.scripted_motion import JointTarget, PushedBox, ScriptedMotion

MOTION = ScriptedMotion(
    robot="robot/arm.urdf",
    hand_link="hand",
    joints=("a", "b"),
    base_m=(0.0, 0.1, 0.055),
    targets=(
        JointTarget(t_s=0.0, joints_rad={"a": 1.0}),
        JointTarget(t_s=2.0, joints_rad={"a": -0.5, "b": 0.2}),
    ),
    gain_hz=10.0,
    limit_rad_s=0.5,
    period_s=0.05,
    duration_s=6.0,
    boxes={"cube": PushedBox(size_m=(0.1, 0.2, 0.3), mass_kg=0.5)},
)


def parsed(record: dict[str, str]) -> dict[str, Any]:
    return {name: json.loads(value) for name, value in record.items()}


def test_joints_follow_the_velocity_commands() -> None:
    times_s, q = MOTION.joint_path_rad()
    a = b = 0.0
    for step in range(120):
        assert q[step] == pytest.approx([a, b], abs=1e-12)
        to_a, to_b = (1.0, 0.0) if step < 40 else (-0.5, 0.2)
        a += 0.05 * min(max(10 * (to_a - a), -0.5), 0.5)
        b += 0.05 * min(max(10 * (to_b - b), -0.5), 0.5)
    assert times_s[-1] == pytest.approx(6.0)
    assert q[-1] == pytest.approx([-0.5, 0.2], abs=1e-6)
    # At the limit for 2 s it goes 1 rad, less the last, slower part.
    assert q[40, 0] == pytest.approx(1.0, abs=0.06)
    assert np.abs(np.diff(q, axis=0)).max() <= 0.025 + 1e-12


def test_a_record_reads_back_as_it_was_written() -> None:
    assert ScriptedMotion.from_record(parsed(MOTION.to_record())) == MOTION


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"schema_version": 2}, "schema version 2"),
        ({"joints": None}, "joints"),
        ({"gain_hz": 0}, r"> 0\.0 - at `\$\.gain_hz`"),
        ({"limit_rad_s": float("nan")}, "limit_rad_s"),
        ({"period_s": float("inf")}, "period_s"),
        ({"base_m": [0, 0]}, "base_m"),
        ({"targets": [{"t_s": 0, "joints_rad": {"wrist": 1}}]}, "wrist is none of a, b"),
        ({"boxes": {"cube": {"size_m": [1, 1, 0], "mass_kg": 1}}}, r"> 0\.0 - at `\$\.boxes"),
    ],
)
def test_a_damaged_record_is_refused(change: dict[str, Any], match: str) -> None:
    with pytest.raises(InvalidRecordError, match=match):
        ScriptedMotion.from_record(parsed(MOTION.to_record()) | change)
