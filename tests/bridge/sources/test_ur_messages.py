"""What the arm publishes is byte for byte what the records of an episode write."""

import json
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bridge.episode.cdr.batch import MessageTemplate, joint_template, pose_template
from bridge.episode.cdr.messages import FrameTransform, JointSample, PoseSample, transforms_to_cdr
from bridge.episode.cdr.messages import transforms_from_cdr as read_transforms
from bridge.geometry import se3
from bridge.robots.default import ARM_JOINTS
from bridge.sources.ur import messages
from bridge.task.record import check_record

stamps = st.integers(0, 2**31 * 10**9 - 1)
numbers = st.floats(-1e6, 1e6)


@given(stamps, st.lists(numbers, min_size=12, max_size=12))
def test_joint_states_are_those_of_the_record(stamp_ns: int, values: list[float]) -> None:
    expected = JointSample(
        stamp_ns=stamp_ns,
        names=ARM_JOINTS,
        position=np.array(values[:6]),
        velocity=np.array(values[6:]),
        effort=np.zeros(0),
    )
    assert joint_template(ARM_JOINTS, velocities=True).fill(stamp_ns, values) == expected.to_cdr()


@given(stamps, st.lists(st.floats(-3.0, 3.0), min_size=6, max_size=6))
def test_poses_and_frames_are_those_of_the_record(stamp_ns: int, pose: list[float]) -> None:
    turned = messages.tool_pose(pose)
    found = PoseSample.from_cdr(pose_template("base_link").fill(stamp_ns, turned))
    assert (found.stamp_ns, found.frame_id) == (stamp_ns, "base_link")
    q_wxyz, p_m = np.array([turned[6], *turned[3:6]]), np.array(turned[:3])
    np.testing.assert_allclose(found.T_frame_body, se3.transform_from(q_wxyz, p_m), atol=1e-12)
    (item,) = read_transforms(messages.frame_template().fill(stamp_ns, turned))
    assert (item.parent, item.child) == ("base_link", "tool0_controller")
    np.testing.assert_array_equal(item.T_parent_child, found.T_frame_body)
    again = FrameTransform(
        stamp_ns=stamp_ns, parent=item.parent, child=item.child, T_parent_child=np.eye(4)
    )
    identity = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
    filled = messages.frame_template().fill(stamp_ns, identity)
    assert filled == transforms_to_cdr([again])


def test_forces_are_turned_like_positions() -> None:
    wrench = messages.tool_wrench((1.0, 2.0, 3.0, 4.0, 5.0, 6.0))
    assert wrench == (-1.0, -2.0, 3.0, -4.0, -5.0, 6.0)


def test_a_number_that_cannot_be_found_again_is_refused() -> None:
    def build(stamp: dict[str, int], marks: list[float]) -> dict[str, Any]:
        return {"header": {"stamp": stamp}, "name": ["a"], "position": [marks[0], marks[0]]}

    with pytest.raises(ValueError, match="not once"):
        MessageTemplate("sensor_msgs/msg/JointState", build, 1)


@pytest.mark.parametrize("modes", [(7, 3), (None, 1), (99, None)])
def test_modes_are_events_of_the_schema(modes: tuple[int | None, int | None]) -> None:
    message = messages.mode_event("lab", *modes, 5)
    record = json.loads(message.data)
    check_record(record, name="event", package="bridge.episode")
    assert (message.topic, record["stamp_ns"]) == ("/lab/event", 5)
    if modes == (7, 3):
        assert record["text"] == "robot mode RUNNING, safety mode PROTECTIVE_STOP"
