"""Many messages at once are the bytes of each one by itself."""

import numpy as np
import pytest
from joint_samples import at_positions

from bridge.episode.cdr.batch import joint_messages, pose_messages
from bridge.episode.cdr.messages import PoseSample
from bridge.geometry import se3

STAMPS = np.array([0, 1, 999_999_999, 1_000_000_000, 1_700_000_000_123_456_789])


@pytest.mark.parametrize(
    "names", [("a",), ("shoulder", "elbow_joint", "wrist"), ("gripper_width",)]
)
def test_joint_states_are_the_same_bytes(names: tuple[str, ...]) -> None:
    position = np.random.default_rng(0).normal(size=(len(STAMPS), len(names)))
    position[0] = 0.0
    position[1] = np.inf
    for stamp, row, data in zip(
        STAMPS, position, joint_messages(STAMPS, names, position), strict=True
    ):
        sample = at_positions(int(stamp), names, row)
        assert data == sample.to_cdr()


@pytest.mark.parametrize("frame", ["base_link", "b", "world_frame"])
def test_poses_are_the_same_bytes(frame: str) -> None:
    rng = np.random.default_rng(1)
    q = rng.normal(size=(len(STAMPS), 4))
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    Ts = se3.transform_from(q, rng.normal(size=(len(STAMPS), 3)))
    for stamp, T, data in zip(STAMPS, Ts, pose_messages(STAMPS, frame, Ts), strict=True):
        sample = PoseSample(stamp_ns=int(stamp), frame_id=frame, T_frame_body=T)
        assert data == sample.to_cdr()


def test_no_messages_are_none() -> None:
    none = np.zeros(0, dtype=np.int64)
    assert list(joint_messages(none, ("a",), np.zeros((0, 1)))) == []
    assert list(pose_messages(none, "base", np.zeros((0, 4, 4)))) == []
