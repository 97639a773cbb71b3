"""Laws across rooms: what bridge writes, evaluator measures."""

import tempfile
from pathlib import Path

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from bridge.episode import schema, streams
from bridge.episode.cdr.messages import PoseSample
from bridge.episode.metadata import EpisodeInfo
from bridge.episode.reader import Episode
from bridge.episode.writer import EpisodeWriter
from bridge.geometry import se3
from bridge.geometry.trajectory import PoseTrajectory
from evaluator.metrics.trajectory import pose_errors

START_NS = 1_700_000_000_000_000_000
TOPIC = "/lab/tcp/pose"


def motion(seed: int) -> PoseTrajectory:
    rng = np.random.default_rng(seed)
    steps = rng.normal(scale=0.01, size=(30, 3))
    turns = rng.normal(scale=0.05, size=(30, 3))
    q = Rotation.from_rotvec(np.cumsum(turns, axis=0)).as_quat(scalar_first=True)
    stamps = START_NS + np.arange(30, dtype=np.int64) * 8_000_000
    return PoseTrajectory(stamps, np.cumsum(steps, axis=0), q)


def through_a_file(run: PoseTrajectory) -> PoseTrajectory:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "e.mcap"
        with EpisodeWriter(path) as writer:
            for stamp_ns, T in zip(run.stamps_ns, run.transforms(), strict=True):
                pose = PoseSample(stamp_ns=int(stamp_ns), frame_id="base_link", T_frame_body=T)
                writer.write(
                    TOPIC,
                    pose.to_cdr(),
                    type_name=schema.POSE_STAMPED,
                    log_time_ns=int(stamp_ns) + 3,
                    publish_time_ns=int(stamp_ns),
                )
            writer.describe(EpisodeInfo(id="e", kind="trial"))
        return streams.pose_track(Episode.open(path), TOPIC)


@settings(max_examples=5)
@given(st.integers(0, 1000), st.integers(0, 1000))
def test_moving_both_runs_together_changes_no_error(seed: int, pose_seed: int) -> None:
    rng = np.random.default_rng(pose_seed)
    T_new_old = se3.transform_from(rng.normal(size=4), rng.normal(size=3))
    first, second = motion(seed), motion(seed + 1)

    def moved(run: PoseTrajectory) -> PoseTrajectory:
        q, p = se3.split(T_new_old @ run.transforms())
        return PoseTrajectory(run.stamps_ns, p, q)

    before = pose_errors(first, second)
    after = pose_errors(through_a_file(moved(first)), through_a_file(moved(second)))
    np.testing.assert_allclose(after.position_m, before.position_m, atol=1e-9)
    np.testing.assert_allclose(after.rotation_rad, before.rotation_rad, atol=1e-6)
