"""Arms whose joints come in several messages, each with some of them."""

import numpy as np
import pytest

from bridge.episode.cdr.messages import JointSample
from bridge.episode.streams import joint_track_of

ARM, RAIL = ("a1", "a2", "a3"), ("rail",)


def message(stamp_ns: int, names: tuple[str, ...], position: np.ndarray) -> bytes:
    return JointSample(
        stamp_ns=stamp_ns,
        names=names,
        position=position,
        velocity=np.zeros(0),
        effort=np.zeros(0),
    ).to_cdr()


def arm_at(stamp_ns: int) -> np.ndarray:
    return np.array([1.0, 2.0, 3.0]) * stamp_ns * 1e-9


def rail_at(stamp_ns: int) -> np.ndarray:
    return np.array([0.1 - 0.5 * stamp_ns * 1e-9])


def test_messages_that_are_alike_are_read_at_once_as_one_by_one() -> None:
    rng = np.random.default_rng(3)
    stamps = rng.integers(0, 2**60, 40).tolist()
    payloads = [message(stamp, ARM, rng.normal(size=3)) for stamp in stamps]
    track = joint_track_of(payloads)
    assert track is not None
    samples = sorted(map(JointSample.from_cdr, payloads), key=lambda sample: sample.stamp_ns)
    assert track.stamps_ns.tolist() == [sample.stamp_ns for sample in samples]
    assert np.array_equal(track.position, [sample.position for sample in samples])
    other = joint_track_of([*payloads, message(7, ARM[:2], np.zeros(2))])  # not all are alike
    assert other is not None
    assert np.array_equal(other.position, track.position)


ARM_NS, RAIL_NS = range(0, 2_000_000_000, 8_000_000), range(100_000_000, 1_900_000_000, 33_000_000)


def test_joints_of_two_messages_are_one_track_while_both_are_known() -> None:
    payloads = [message(stamp, ARM, arm_at(stamp)) for stamp in ARM_NS]
    payloads += [message(stamp, RAIL, rail_at(stamp)) for stamp in RAIL_NS]
    track = joint_track_of(payloads)
    assert track is not None
    assert track.names == ARM + RAIL
    assert track.stamps_ns[0] >= RAIL_NS[0]
    assert track.stamps_ns[-1] <= RAIL_NS[-1]
    for stamp, row in zip(track.stamps_ns.tolist(), track.position, strict=True):
        assert row == pytest.approx([*arm_at(stamp), *rail_at(stamp)], abs=1e-12)


@pytest.mark.parametrize(
    "other",
    [
        [message(500_000_000, RAIL, rail_at(0))],
        [message(0, RAIL, rail_at(0)), message(400_000_000, RAIL, rail_at(0))],
        [message(stamp, ("a2",), np.array([9.0])) for stamp in RAIL_NS],
    ],
    ids=["said once", "silent most of the time", "a joint that is known already"],
)
def test_who_says_little_or_nothing_new_leaves_the_arm_as_it_is(other: list[bytes]) -> None:
    track = joint_track_of([message(stamp, ARM, arm_at(stamp)) for stamp in ARM_NS] + other)
    assert track is not None
    assert (track.names, len(track.stamps_ns)) == (ARM, len(ARM_NS))
    assert track.position[:, 1] == pytest.approx(2.0 * track.stamps_ns * 1e-9)
