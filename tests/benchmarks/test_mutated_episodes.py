"""Damaged episodes through the commands, as ``benchmarks/mutate_episodes.py`` does at full size."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))

from mutate_episodes import Trial, mutants

from bridge.episode import schema
from bridge.episode.cdr.messages import (
    DepthImage,
    FrameTransform,
    JointSample,
    PoseSample,
    transforms_to_cdr,
)
from bridge.episode.clocks import Reading, SourceClock, to_record
from bridge.episode.metadata import EpisodeInfo, Outcome
from bridge.episode.run_folder import RunFolder
from bridge.episode.topics import CLOCKS
from bridge.episode.writer import EpisodeWriter

START_NS = 1_700_000_000_000_000_000


@pytest.fixture
def source(tmp_path: Path) -> Path:
    """A run with one short trial of most kinds of messages."""
    run = RunFolder.create(tmp_path / "source")
    none = np.zeros(0)
    with EpisodeWriter(run.episodes_dir / "t.mcap") as writer:
        info = EpisodeInfo(id="t", kind="trial", cell="lab", task="cube_into_box")
        writer.describe(info, outcome=Outcome(result="success", k=1))
        clock = SourceClock(source="lab", host="pc", topics=frozenset(("/lab/joint_states",)))
        for number in range(40):
            now_ns = START_NS + number * 50_000_000
            joints = JointSample(
                stamp_ns=now_ns, names=("a",), position=np.ones(1), velocity=none, effort=none
            )
            pose = PoseSample(stamp_ns=now_ns, frame_id="base", T_frame_body=np.eye(4))
            frame = FrameTransform(
                stamp_ns=now_ns, parent="base", child="eye", T_parent_child=np.eye(4)
            )
            depth = DepthImage(
                stamp_ns=now_ns, frame_id="eye", depth_mm=np.full((4, 6), number, np.uint16)
            )
            event = {"schema_version": 1, "stamp_ns": now_ns, "type": "note", "text": "x"}
            reading = to_record(clock, "1", [Reading(now_ns, 5, 100)])
            for topic, data, type_name in (
                ("/lab/joint_states", joints.to_cdr(), schema.JOINT_STATE),
                ("/lab/tcp/pose", pose.to_cdr(), schema.POSE_STAMPED),
                ("/tf", transforms_to_cdr([frame]), schema.TF_MESSAGE),
                ("/lab/cam/eye/depth/image", depth.to_cdr(), schema.IMAGE),
                ("/lab/event", json.dumps(event).encode(), schema.EVENT),
                (CLOCKS, json.dumps(reading).encode(), schema.CLOCKS),
            ):
                writer.write(topic, data, type_name=type_name, log_time_ns=now_ns)
    return run.path


@pytest.mark.slow
def test_no_damage_ends_in_a_traceback_or_without_a_word(source: Path, tmp_path: Path) -> None:
    (tmp_path / "work").mkdir()
    trial = Trial(source, "t", tmp_path / "work")
    commands = ["info", "check", "recover", "export", "ls"]
    for number, data in enumerate(mutants(trial.original, tmp_path / "work", 36, 7)):
        trial.give(f"mutant {number}", data, commands)
        if number % 18 == 0:
            trial.give(f"mutant {number}", data, ["evaluate", "replay"])
    assert not trial.failures, "\n".join(trial.failures[:5])
    # Law: what is broken is never called whole. Two thirds are broken files.
    assert trial.codes["check", 0] <= 36 // 3
    assert trial.codes["info", 1] > 5
