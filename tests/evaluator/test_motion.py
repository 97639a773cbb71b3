"""Laws of errors of motions, of images and of trajectories, and data that has no answer."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from bridge.episode import schema
from bridge.episode.cdr.batch import pose_messages
from bridge.episode.metadata import EpisodeInfo
from bridge.episode.reader import Episode
from bridge.episode.streams import JointTrack
from bridge.episode.writer import EpisodeWriter
from bridge.geometry.trajectory import PoseTrajectory
from bridge.media.image_quality import ImageShapeError, psnr_db
from evaluator.compare.motion import (
    MotionSummary,
    compare_tracks,
    motion_results,
    summarise_motions,
)
from evaluator.errors import UndefinedStatisticError
from evaluator.metrics.trajectory import joint_errors, pose_errors
from evaluator.run_reader.tracks import Tracks

START_NS = 10_000_000_000
STEP_NS = 20_000_000
NUM = 151


def path_m(t_s: np.ndarray) -> np.ndarray:
    """A motion that rests at both ends and is not straight."""
    s = np.clip((t_s - 0.4) / 2.2, 0.0, 1.0)
    s = s * s * (3 - 2 * s)
    return np.stack([0.4 + 0.3 * s, 0.1 * np.sin(3 * s), 0.2 + 0.15 * s * s], axis=1)


def tracks(
    *,
    late_s: float = 0.0,
    shift_m: tuple[float, float, float] = (0.0, 0.0, 0.0),
    turn_rad: float = 0.0,
    start_ns: int | None = START_NS,
    first_ns: int = START_NS,
) -> Tracks:
    stamps = first_ns + STEP_NS * np.arange(NUM, dtype=np.int64)
    p = path_m((stamps - first_ns) * 1e-9 - late_s) + np.array(shift_m)
    q = Rotation.from_rotvec([0.0, 0.0, turn_rad]).as_quat(scalar_first=True)
    return Tracks(
        tool=PoseTrajectory(stamps, p, np.tile(q, (NUM, 1))),
        started_ns=start_ns,
        ended_ns=None if start_ns is None else start_ns + STEP_NS * NUM,
    )


def test_a_motion_is_nowhere_from_itself() -> None:
    found = compare_tracks(tracks(), tracks())
    assert found.aligned_by == "stamps"
    assert (found.path_max_m, found.rotation_mean_rad) == (0, 0)
    assert found.lag_s == 0.0


@settings(max_examples=15)
@given(st.floats(-0.15, 0.5), st.floats(0.0, 0.05))
def test_a_known_delay_is_found_and_taken_out(late_s: float, shift_m: float) -> None:
    found = compare_tracks(tracks(late_s=late_s, shift_m=(0.0, 0.0, shift_m)), tracks())
    assert found.lag_s == pytest.approx(late_s, abs=0.0051)
    # What is left is the offset, and half a step of 10 ms at up to 0.3 m/s.
    assert found.path_mean_m == pytest.approx(shift_m, abs=0.0016)


@settings(max_examples=15)
@given(st.floats(0.0, 0.4), st.floats(0.0, 0.01))
def test_a_late_motion_on_another_path_has_both_told_apart(late_s: float, bump_m: float) -> None:
    """The bump is across the motion and lasts as long; its mean is known in closed form."""
    planned = tracks()
    recorded = tracks(late_s=late_s)
    assert recorded.tool is not None
    t_s = (recorded.tool.stamps_ns - START_NS) * 1e-9 - late_s
    across = bump_m * np.sin(np.pi * np.clip((t_s - 0.4) / 2.2, 0, 1))
    p = recorded.tool.p_m + np.outer(across, [0.0, 0.0, 1.0])
    tool = PoseTrajectory(recorded.tool.stamps_ns, p, recorded.tool.q_wxyz)
    found = compare_tracks(replace(recorded, tool=tool), planned)
    assert found.lag_s == pytest.approx(late_s, abs=0.0251)
    expected_m = bump_m * 2.2 * 2 / np.pi / (3.0 - late_s)
    # The bump draws the lag by up to 20 ms, which at a mean speed of 0.13 m/s adds 3 mm.
    assert found.path_mean_m == pytest.approx(expected_m, abs=0.003)
    assert found.path_max_m <= bump_m + 0.006
    assert found.position_mean_m >= found.path_mean_m - 0.003


def test_a_joint_offset_is_found_with_its_joint_and_whole_turns_do_not_count() -> None:
    stamps, names = np.array([0, 10]), ("pan", "lift", "elbow")
    mine = JointTrack(names=names, stamps_ns=stamps, position=np.full((2, 3), 0.5))
    off = mine.position + np.array([0.0, 0.03 - 2 * np.pi, 0.0])
    errors = joint_errors(replace(mine, position=off), mine)
    np.testing.assert_allclose(np.abs(errors.error_rad), [[0, 0.03, 0]] * 2, atol=1e-12)


def test_joints_are_compared_by_name() -> None:
    mine = JointTrack(
        names=("a", "b"), stamps_ns=np.array([0, 10]), position=np.array([[0.0, 1.0], [0.0, 1.0]])
    )
    other = JointTrack(
        names=("b", "c", "a"),
        stamps_ns=np.array([0, 10]),
        position=np.array([[1.0, 9.0, 0.5], [1.0, 9.0, 0.5]]),
    )
    errors = joint_errors(mine, other)
    assert errors.names == ("a", "b")
    np.testing.assert_allclose(errors.error_rad, [[-0.5, 0.0]] * 2)
    with pytest.raises(UndefinedStatisticError, match="no name in common"):
        joint_errors(
            mine, JointTrack(names=("x",), stamps_ns=np.array([0]), position=np.zeros((1, 1)))
        )


def test_clocks_of_their_own_are_laid_over_each_other_at_the_start() -> None:
    found = compare_tracks(tracks(shift_m=(0.0, 0.02, 0.0)), tracks(first_ns=0, start_ns=0))
    assert found.aligned_by == "starts"
    assert found.position_mean_m == pytest.approx(0.02)


def test_motions_without_poses_or_instants_in_common_are_refused() -> None:
    empty = Tracks(tool=None, started_ns=START_NS, ended_ns=None)
    with pytest.raises(UndefinedStatisticError, match="no tool poses"):
        compare_tracks(tracks(), empty)
    later = Tracks(tool=tracks().tool, started_ns=START_NS + 10**12, ended_ns=START_NS + 2 * 10**12)
    with pytest.raises(UndefinedStatisticError, match="no tool poses"):
        compare_tracks(later, tracks())


def write(path: Path, source: Tracks, *, kind: str = "trial", plan_id: str = "p1") -> Episode:
    assert source.tool is not None
    stamps = source.tool.stamps_ns
    with EpisodeWriter(path) as writer:
        writer.describe(
            EpisodeInfo(id=path.stem, kind=kind, task="cube_into_box", condition="with_replanning")
        )
        for kind_of, stamp in (
            ("execution_started", source.started_ns),
            ("execution_ended", source.ended_ns),
        ):
            if stamp is not None:
                record = {
                    "schema_version": 1,
                    "stamp_ns": stamp,
                    "type": kind_of,
                    "plan_id": plan_id,
                }
                writer.write("/cell/event", record, type_name=schema.EVENT, log_time_ns=stamp)
        poses = pose_messages(stamps, "base_link", source.tool.transforms())
        for stamp, pose in zip(stamps.tolist(), poses, strict=True):
            writer.write("/cell/tcp/pose", pose, type_name=schema.POSE_STAMPED, log_time_ns=stamp)
    return Episode.open(path)


def test_files_give_what_their_tracks_give(tmp_path: Path) -> None:
    recorded = tracks(late_s=0.1)
    planned, executed = tracks(), tracks(late_s=0.1)
    episodes = {
        name: write(tmp_path / f"{name}.mcap", source)
        for name, source in (("recorded", recorded), ("planned", planned), ("executed", executed))
    }
    replays = {name: episodes[name] for name in ("planned", "executed")}
    found = summarise_motions(episodes["recorded"], replays, plan_id="p1")
    assert [m.against for m in found] == ["planned", "executed"]
    assert {(m.episode, m.task, m.condition) for m in found} == {
        ("recorded", "cube_into_box", "with_replanning")
    }
    direct = compare_tracks(recorded, planned)
    assert found[0].position_mean_m == pytest.approx(direct.position_mean_m, abs=1e-9)
    assert found[0].lag_s == direct.lag_s == 0.1
    assert found[1].path_max_m == pytest.approx(0.0, abs=1e-9)
    alone = {"planned": episodes["planned"]}
    assert summarise_motions(episodes["recorded"], alone, plan_id="p1") == found[:1]


def test_samples_outside_the_execution_do_not_count(tmp_path: Path) -> None:
    recorded = tracks()
    assert recorded.tool is not None
    waiting = Tracks(
        tool=recorded.tool, started_ns=START_NS + 50 * STEP_NS, ended_ns=START_NS + 100 * STEP_NS
    )
    late = tracks()
    assert late.tool is not None
    p_m = late.tool.p_m.copy()
    p_m[101:] += 1.0  # far off, after the end
    p_m[:50] += 1.0
    off = replace(late, tool=PoseTrajectory(late.tool.stamps_ns, p_m, late.tool.q_wxyz))
    (found,) = summarise_motions(
        write(tmp_path / "a.mcap", waiting),
        {"planned": write(tmp_path / "b.mcap", off)},
        plan_id="p1",
    )
    assert found.position_mean_m == pytest.approx(0.0, abs=1e-9)


def summaries(*mean_m: float) -> list[MotionSummary]:
    found = compare_tracks(tracks(), tracks())
    return [
        MotionSummary(
            **{
                **vars(found),
                "episode": f"e{index}",
                "task": "t",
                "condition": "",
                "against": "planned",
                "position_mean_m": value,
            }
        )
        for index, value in enumerate(mean_m)
    ]


def test_numbers_are_means_over_trials() -> None:
    by_id = {m.id: m for m in motion_results(summaries(0.01, 0.02, 0.06)).measurements}
    mean = by_id["motion.planned.position_mean_m"]
    assert (mean.value, mean.n, mean.counted) == (pytest.approx(0.03), 3, "trial")
    assert "share one calibration" in str(mean.reason_without_interval)
    assert by_id["motion.executed.position_mean_m"].value is None


def test_a_pose_that_is_no_number_leaves_the_mean_undefined() -> None:
    by_id = {m.id: m for m in motion_results(summaries(float("nan"))).measurements}
    assert "not finite" in str(by_id["motion.planned.position_mean_m"].reason_if_undefined)


def picture(seed: int = 0, size: tuple[int, int] = (24, 32)) -> np.ndarray:
    image = np.random.default_rng(seed).random((*size, 3))
    image.flags.writeable = False
    return image


def track(p_m: np.ndarray, start_ns: int = 0, step_ns: int = 1_000_000) -> PoseTrajectory:
    stamps = start_ns + step_ns * np.arange(len(p_m), dtype=np.int64)
    return PoseTrajectory(stamps, p_m, np.tile([1.0, 0.0, 0.0, 0.0], (len(p_m), 1)))


def line(offset_m: float = 0.0, num: int = 21) -> np.ndarray:
    p = np.zeros((num, 3))
    p[:, 0] = np.linspace(0, 1, num)
    p[:, 1] = offset_m
    return p


def test_a_mask_counts_only_its_pixels() -> None:
    image = picture()
    other = image.copy()
    other[:, 16:] += 0.1
    mask = np.zeros((24, 32), dtype=bool)
    mask[:, 16:] = True
    assert psnr_db(image, other, mask=mask) == pytest.approx(20.0)
    assert psnr_db(image, other) == pytest.approx(20.0 + 10 * np.log10(2))
    with pytest.raises(UndefinedStatisticError, match="no pixel"):
        psnr_db(image, other, mask=np.zeros((24, 32), dtype=bool))


def test_images_of_different_size_are_refused() -> None:
    with pytest.raises(ImageShapeError, match=r"\(24, 32, 3\).*\(24, 30, 3\)"):
        psnr_db(picture(), picture(size=(24, 30)))


def test_a_delay_shows_as_speed_times_delay() -> None:
    # 1 m in 20 steps; one step late is 0.05 m behind at every common instant.
    errors = pose_errors(track(line()), track(line(), start_ns=1_000_000))
    np.testing.assert_allclose(errors.position_m, 0.05, rtol=1e-9)
    assert len(errors.position_m) == 20


def test_motions_that_share_no_instant_are_refused() -> None:
    with pytest.raises(UndefinedStatisticError, match="do not overlap"):
        pose_errors(track(line()), track(line(), start_ns=10**12))
