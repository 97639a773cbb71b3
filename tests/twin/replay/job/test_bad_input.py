"""Where an episode says that a plan began; what cannot be judged: one sentence, and it goes on."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from joint_samples import at_positions

from bridge.episode import schema
from bridge.episode.metadata import EpisodeInfo
from bridge.episode.reader import Episode
from bridge.episode.writer import EpisodeWriter
from bridge.robots.default import ARM_JOINTS, ROBOT
from bridge.task.task_file import load_task
from twin.replay.config import ReplayConfig
from twin.replay.execution import path_of_execution
from twin.replay.failure import NotEvaluatedError
from twin.replay.job import ReplayJob, row_of_failure
from twin.replay.path import UnusablePlanError
from twin.replay.result import ReplayResult
from twin.replay.run_job import recorded_joints, recorded_start
from twin.replay.scene import StartState
from twin.robot.posture import BackwardTimeError, check_clock

T0 = 1_700_000_000_000_000_000


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize(("which", "word"), [(0, "joints"), (1, "gripper widths")])
def test_numbers_that_are_none_in_a_log_are_named_with_their_time(
    script: SimpleNamespace, good: ReplayResult, which: int, word: str, value: float
) -> None:
    tracks = list(script.recorded_tracks(good))
    position = tracks[which].position.copy()
    position[125, 0] = value
    tracks[which] = replace(tracks[which], position=position)
    plan = script.plan(script.scene())
    with pytest.raises(UnusablePlanError, match=rf"{word} that are no numbers at 1\.00 s"):
        path_of_execution(*tracks, plan, ReplayConfig(), ROBOT)


def episode_with(path: Path, stamps_s: list[float]) -> Episode:
    """Joint states in the order in which they arrived, with the source's times."""
    with EpisodeWriter(path) as writer:
        writer.describe(EpisodeInfo(id=path.stem, kind="trial"))
        for index, stamp_s in enumerate(stamps_s):
            stamp_ns = T0 + round(stamp_s * 1e9)
            sample = at_positions(stamp_ns, ("a",), np.zeros(1))
            writer.write(
                "/cell/joint_states",
                sample.to_cdr(),
                type_name=schema.JOINT_STATE,
                log_time_ns=T0 + index * 10**7,
                publish_time_ns=stamp_ns,
            )
    return Episode.open(path)


def checked(episode: Episode, start_s: float, end_s: float) -> None:
    start, end = (T0 + round(value * 1e9) for value in (start_s, end_s))
    check_clock(episode, ("/joint_states",), start, end, "p")


def test_time_that_goes_backwards_during_an_execution_is_refused(tmp_path: Path) -> None:
    episode = episode_with(tmp_path / "a.mcap", [0.0, 0.1, 0.2, 0.3, 0.05, 0.15])
    with pytest.raises(BackwardTimeError, match=r"goes back by 0\.25 s at 0\.20 s of plan 'p'"):
        checked(episode, 0.1, 0.4)


def test_messages_that_overtake_each_other_by_little_are_no_jump(tmp_path: Path) -> None:
    checked(episode_with(tmp_path / "a.mcap", [0.0, 0.1, 0.09, 0.2, 0.19, 0.3]), 0.0, 0.3)


def test_a_jump_before_the_execution_is_none_of_its_business(tmp_path: Path) -> None:
    checked(episode_with(tmp_path / "a.mcap", [5.0, 5.1, 0.0, 0.1, 0.2]), 0.0, 0.2)


def test_an_execution_that_took_no_time_is_refused(tmp_path: Path) -> None:
    episode = episode_with(tmp_path / "a.mcap", [0.0, 0.1])
    with pytest.raises(BackwardTimeError, match=r"ended 0\.10 s before it started"):
        checked(episode, 0.2, 0.1)


def test_what_was_not_evaluated_says_so_once_in_its_row(tmp_path: Path) -> None:
    job = ReplayJob(
        episode_path=tmp_path / "trial.mcap", episode_sha256="", plan_id="p", plan_index=0,
        trajectory="planned", start_ns=0, end_ns=None, task=load_task("cube_into_box"),
        start=StartState(), scene_hash=None, config=ReplayConfig(), folder=tmp_path,
    )  # fmt: skip
    for message in ("it broke", str(NotEvaluatedError("it broke"))):
        row = row_of_failure(job, message)
        assert row["error"] == row["reason"] == "it broke"
        assert row["accepted"] is None


S = 1_000_000_000


def recorded(path: Path, names: Sequence[str], rows: Sequence[Sequence[float]]) -> Episode:
    """One row of joint states each second, from 10 s on."""
    with EpisodeWriter(path / "trial.mcap") as writer:
        writer.describe(EpisodeInfo(id="trial", kind="trial"))
        for index, row in enumerate(rows):
            sample = at_positions((10 + index) * S, tuple(names), np.array(row))
            writer.write(
                "/lab/joint_states",
                sample.to_cdr(),
                type_name=schema.JOINT_STATE,
                log_time_ns=sample.stamp_ns,
            )
    return Episode.open(path / "trial.mcap")


def test_joints_are_read_at_the_plans_time_in_the_arms_order(tmp_path: Path) -> None:
    names = [*reversed(ARM_JOINTS), "finger"]
    episode = recorded(tmp_path, names, [[6, 5, 4, 3, 2, 1, 9.0], [8, 7, 6, 5, 4, 3, 9.0]])
    found = recorded_start(episode, 10 * S + S // 2, ARM_JOINTS)
    assert found is not None
    assert found == pytest.approx([2.0, 3.0, 4.0, 5.0, 6.0, 7.0])


def test_a_start_that_nobody_recorded_is_not_known(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    (tmp_path / "c").mkdir()
    arm = recorded(tmp_path / "a", ARM_JOINTS, [[0.0] * 6, [0.0] * 6])
    assert recorded_start(arm, 12 * S, ARM_JOINTS) is not None
    assert recorded_start(arm, 12 * S + 1, ARM_JOINTS) is None
    assert recorded_start(arm, 9 * S - 1, ARM_JOINTS) is None
    other = recorded(tmp_path / "b", [f"panda_joint{k}" for k in range(6)], [[0.0] * 6])
    assert recorded_start(other, 10 * S, ARM_JOINTS) is None
    broken = recorded(tmp_path / "c", ARM_JOINTS, [[np.nan] * 6])
    assert recorded_start(broken, 10 * S, ARM_JOINTS) is None
    assert np.isnan(recorded_joints(broken, 10 * S, ARM_JOINTS)).all(), "recorded, but no numbers"
    with EpisodeWriter(tmp_path / "none.mcap") as writer:
        writer.describe(EpisodeInfo(id="none", kind="trial"))
    assert recorded_start(Episode.open(tmp_path / "none.mcap"), 10 * S, ARM_JOINTS) is None
