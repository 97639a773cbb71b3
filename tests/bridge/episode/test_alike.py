"""Tracks of many messages; messages written at once are what each one by itself is."""

import struct

import numpy as np
import pytest
from joint_samples import at_positions

from bridge.episode.cdr.batch import joint_writer, pose_messages
from bridge.episode.cdr.codec import MalformedMessageError
from bridge.episode.cdr.messages import PoseSample
from bridge.episode.streams import joint_track_of, pose_track_of
from bridge.geometry import se3

STAMPS = np.array([0, 1, 999_999_999, 1_000_000_000, 1_700_000_000_123_456_789])


def transforms(count: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    q = rng.normal(size=(count, 4))
    return se3.transform_from(
        q / np.linalg.norm(q, axis=1, keepdims=True), rng.normal(size=(count, 3))
    )


def pose(stamp_ns: int, x_m: float, frame: str = "base_link") -> bytes:
    T = np.eye(4)
    T[0, 3] = x_m
    return PoseSample(stamp_ns=stamp_ns, frame_id=frame, T_frame_body=T).to_cdr()


def joints(stamp_ns: int, position: list[float], names: tuple[str, ...] = ("a", "bc")) -> bytes:
    return at_positions(stamp_ns, names, np.array(position)).to_cdr()


def test_poses_are_ordered_and_of_equal_stamps_the_last_counts() -> None:
    track = pose_track_of([pose(30, 0.3), pose(10, 0.1), pose(30, 0.4), pose(20, 0.2)])
    assert track is not None
    assert track.stamps_ns.tolist() == [10, 20, 30]
    assert track.p_m[:, 0].tolist() == [0.1, 0.2, 0.4]


def test_joints_of_several_publishers_take_those_who_know_the_most() -> None:
    track = joint_track_of([joints(2, [0.5], ("a",)), joints(3, [2.0, 3.0]), joints(1, [0.0, 1.0])])
    assert track is not None
    assert track.names == ("a", "bc")
    assert track.stamps_ns.tolist() == [1, 3]


@pytest.mark.parametrize("spoil", ["short", "no_rotation", "header", "length"])
def test_broken_poses_are_refused(spoil: str) -> None:
    payloads = [pose(stamp, 0.1) for stamp in range(4)]
    broken = bytearray(payloads[2])
    if spoil == "short":
        broken = broken[:-8]
    elif spoil == "no_rotation":
        broken[-32:] = struct.pack("<4d", 0, 0, 0, 0)
    elif spoil == "header":
        broken[1] = 7
    else:
        broken[12:16] = struct.pack("<I", 1 << 30)
    payloads[2] = bytes(broken)
    with pytest.raises(MalformedMessageError):
        pose_track_of(payloads)


def test_big_endian_messages_are_read() -> None:
    little = pose(5, 0.25)
    big = bytearray(little)
    big[1] = 0
    size = struct.unpack_from("<I", little, 12)[0]
    first = 16 + size + (4 - 16 - size) % 8
    big[4:12] = struct.pack(">iI", *struct.unpack_from("<iI", little, 4))
    big[12:16] = struct.pack(">I", size)
    big[first : first + 56] = struct.pack(">7d", *struct.unpack_from("<7d", little, first))
    track = pose_track_of([bytes(big)])
    assert track is not None
    assert track.p_m[0, 0] == 0.25


@pytest.mark.parametrize(
    "names", [("a",), ("shoulder", "elbow_joint", "wrist"), ("gripper_width",)]
)
def test_joint_states_are_the_same_bytes(names: tuple[str, ...]) -> None:
    position = np.random.default_rng(0).normal(size=(len(STAMPS), len(names)))
    position[0] = 0.0
    position[1] = np.inf
    for stamp, row, data in zip(
        STAMPS, position, map(joint_writer(names), STAMPS.tolist(), position.tolist()), strict=True
    ):
        sample = at_positions(int(stamp), names, row)
        assert data == sample.to_cdr()


@pytest.mark.parametrize("frame", ["base_link", "b", "world_frame"])
def test_poses_are_the_same_bytes(frame: str) -> None:
    Ts = transforms(len(STAMPS), seed=1)
    for stamp, T, data in zip(STAMPS, Ts, pose_messages(STAMPS, frame, Ts), strict=True):
        sample = PoseSample(stamp_ns=int(stamp), frame_id=frame, T_frame_body=T)
        assert data == sample.to_cdr()


def test_no_messages_are_none() -> None:
    none = np.zeros(0, dtype=np.int64)
    assert list(pose_messages(none, "base", np.zeros((0, 4, 4)))) == []
