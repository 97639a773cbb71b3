"""Where the arm was recorded to be when a plan began, which offline replays compare with."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from joint_samples import at_positions

from bridge.episode import schema
from bridge.episode.metadata import EpisodeInfo
from bridge.episode.reader import Episode
from bridge.episode.writer import EpisodeWriter
from bridge.robots.default import ARM_JOINTS
from twin.replay.run_job import recorded_joints, recorded_start

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
