"""When something was executed: as events say, else from the joints' first motion to their last."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from joint_samples import at_positions

from bridge.episode import schema
from bridge.episode.executions import NO_PLAN, executed_events, motion_ns
from bridge.episode.metadata import EpisodeInfo
from bridge.episode.reader import Episode
from bridge.episode.streams import JointTrack
from bridge.episode.writer import EpisodeWriter

MS = 1_000_000
PERIOD_NS = 8 * MS
WITHIN_NS = 50 * MS


def track_of(position: np.ndarray) -> JointTrack:
    stamps_ns = np.arange(len(position), dtype=np.int64) * PERIOD_NS + 10**18
    names = tuple(f"joint_{index}" for index in range(position.shape[1]))
    return JointTrack(names=names, stamps_ns=stamps_ns, position=position)


def moved_once(start: int, length: int, by_rad: float, *, joint: int = 0) -> np.ndarray:
    """Two seconds and more at rest, a motion with a smooth start and end, and rest again."""
    position = np.zeros((start + length + 250, 3))
    t = np.linspace(0.0, 1.0, length)
    position[start : start + length, joint] = by_rad * (3 * t**2 - 2 * t**3)
    position[start + length :, joint] = by_rad
    return position


@given(
    start=st.integers(60, 400),
    length=st.integers(60, 600),
    by_rad=st.floats(0.3, 2.0),
    sign=st.sampled_from([-1, 1]),
    joint=st.integers(0, 2),
    seed=st.integers(0, 2**31),
)
def test_first_and_last_motion_are_found_within_50_ms(
    start: int, length: int, by_rad: float, sign: int, joint: int, seed: int
) -> None:
    clean = moved_once(start, length, sign * by_rad, joint=joint)
    found = motion_ns(track_of(clean + np.random.default_rng(seed).normal(0, 5e-5, clean.shape)))
    assert found is not None
    # The oracle looks at the motion without noise: it moves from its start on, the slowest one for
    # 0.13 s below 0.01 rad/s.
    moving = np.flatnonzero(np.abs(np.diff(clean[:, joint])) / (PERIOD_NS * 1e-9) > 0.01)
    stamps_ns = track_of(clean).stamps_ns
    starts_ns, ends_ns = stamps_ns[[start, moving[0]]], stamps_ns[[moving[-1] + 1, start + length]]
    assert starts_ns[0] - WITHIN_NS <= found[0] <= starts_ns[1] + WITHIN_NS
    assert ends_ns[0] - WITHIN_NS <= found[1] <= ends_ns[1] + WITHIN_NS


def test_a_pause_in_the_middle_is_part_of_the_motion_and_going_back_does_not_hide_it() -> None:
    out = moved_once(200, 100, 0.5)
    both = np.concatenate([out, out[::-1]])
    found = motion_ns(track_of(both))
    assert found is not None
    assert found[1] - found[0] > (len(both) - 2 * 210) * PERIOD_NS


def test_noise_and_sag_are_no_motion_and_a_moving_gripper_alone_is() -> None:
    still = np.random.default_rng(3).normal(0, 1e-3, (500, 3))
    assert motion_ns(track_of(still)) is None
    assert motion_ns(track_of(np.linspace(0, 1e-3, 500)[:, None] * np.ones(3))) is None
    assert motion_ns(track_of(np.zeros((1, 3)))) is None
    fingers = track_of(0.085 - 0.02 * moved_once(100, 50, 1.0)[:, :1])
    assert motion_ns(track_of(np.zeros((400, 3))), fingers) is not None


def test_samples_that_are_no_numbers_are_passed_over() -> None:
    position = moved_once(200, 100, 0.5)
    position[[0, 3, 250, -1]] = np.nan
    found = motion_ns(track_of(position))
    assert found is not None
    assert abs(found[0] - track_of(position).stamps_ns[200]) <= 100 * MS


def write(
    path: Path, info: EpisodeInfo, events: tuple[tuple[str, int, str | None], ...] = ()
) -> Episode:
    track = track_of(moved_once(200, 100, 0.5))
    with EpisodeWriter(path) as writer:
        writer.describe(info)
        for stamp_ns, row in zip(track.stamps_ns.tolist(), track.position, strict=True):
            data = at_positions(stamp_ns, track.names, row).to_cdr()
            writer.write(
                "/c/joint_states", data, type_name=schema.JOINT_STATE, log_time_ns=stamp_ns
            )
        for kind, stamp_ns, plan_id in events:
            event = {"schema_version": 1, "stamp_ns": stamp_ns, "type": kind, "plan_id": plan_id}
            writer.write("/c/event", event, type_name=schema.EVENT, log_time_ns=stamp_ns)
    return Episode.open(path)


TRIAL = EpisodeInfo(id="t", kind="trial", task="cube_into_box")


def executions(episode: Episode) -> list[tuple[str, int, str]]:
    return [
        (event["type"], event["stamp_ns"], event["plan_id"])
        for event in executed_events(episode)
        if event["type"].startswith("execution_")
    ]


def test_a_trial_that_says_nothing_was_executed_when_its_joints_moved(tmp_path: Path) -> None:
    episode = write(tmp_path / "t.mcap", TRIAL, (("mark", 10**18, None),))
    (first, start_ns, who), (last, end_ns, _) = executions(episode)
    assert (first, last, who) == ("execution_started", "execution_ended", NO_PLAN)
    assert (end_ns - start_ns) * 1e-9 == pytest.approx(0.8, abs=0.1)
    kinds = [event["type"] for event in executed_events(episode)]
    assert kinds[0] == "mark", "others are kept"


def test_a_trial_that_says_when_but_not_of_which_plan_keeps_its_times(tmp_path: Path) -> None:
    said = (("execution_started", 10**18 + 5, None), ("execution_ended", 10**18 + 9, None))
    found = executions(write(tmp_path / "t.mcap", TRIAL, said))
    assert found == [(kind, stamp_ns, NO_PLAN) for kind, stamp_ns, _ in said]


@pytest.mark.parametrize("kind", ["scan", "probe", "retry", "imported"])
def test_what_is_no_trial_was_not_executed(tmp_path: Path, kind: str) -> None:
    assert not executions(write(tmp_path / "t.mcap", EpisodeInfo(id="t", kind=kind, task="x")))


def test_plans_that_were_never_executed_make_no_execution_of_a_motion(tmp_path: Path) -> None:
    path = tmp_path / "t.mcap"
    with EpisodeWriter(path) as writer:
        writer.describe(TRIAL)
        writer.write("/c/plan", {}, type_name=schema.PLAN, log_time_ns=10**18)
    assert not executions(Episode.open(path))
