"""A real ``robot-gst gate`` beside a cell with another arm than the stand-in's, then a replay."""

import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from loopback import free_endpoint

import robot_gst
from bridge.episode import schema, streams
from bridge.episode.cdr.messages import (
    FrameTransform,
    JointSample,
    string_to_cdr,
    transforms_to_cdr,
)
from bridge.episode.metadata import EpisodeInfo
from bridge.episode.reader import Episode, RawMessage
from bridge.episode.run_folder import RunFolder
from bridge.episode.streams import JointTrack
from bridge.episode.topics import is_truth
from bridge.episode.writer import EpisodeWriter
from bridge.robots.default import ROBOT
from bridge.robots.robot import Robot, read_robot
from bridge.sources.standin.cell import StoppedError
from bridge.sources.standin.session import run_session
from bridge.sources.standin.settings import SessionConfig
from bridge.task.plan import Plan
from bridge.task.verdict import Verdict
from bridge.terminal import Output
from twin.gate.twin_process import Look, look
from twin.replay.config import ReplayConfig
from twin.replay.scene import ReplayScene
from twin.replay.verdict import replay_plan
from twin.scene.localise.live import LiveView

sys.path.append(str(Path(__file__).parents[4] / "benchmarks"))
from attack_gate import CELL, Stage, gate_of
from cell_run import START_NS, FileSession

pytestmark = pytest.mark.slow
OF_THE_ARM = ("/robot_description", f"/{CELL}/joint_states", f"/{CELL}/gripper/state", "/tf")
"""Not played: what the other arm says itself, and the camera that hangs on the stand-in's."""
ROBOT_FILES = Path(__file__).parents[4] / "datasets" / "robots"
SECOND = 1_000_000_000


class UntilPlanned(FileSession):
    """Keeps what is published between a trial's start and its first plan, and ends there."""

    def __init__(self, folder: Path) -> None:
        """Write nothing but the episode's frame into the folder."""
        super().__init__(folder)
        self.messages: list[RawMessage] = []

    def write(self, topic: str, type_name: str, data: bytes, source_ns: int) -> None:
        if topic == f"/{CELL}/plan":
            raise StoppedError
        if topic not in OF_THE_ARM and not is_truth(topic):
            message = RawMessage(topic, type_name, source_ns, source_ns, 0, data)
            self.messages.append(message)


@pytest.fixture(scope="module")
def seen(tmp_path_factory: pytest.TempPathFactory) -> tuple[RunFolder, list[RawMessage]]:
    """A run, and what the camera beside the table saw before a plan came."""
    run = RunFolder.create(tmp_path_factory.mktemp("cell") / "run")
    session = UntilPlanned(run.episodes_dir)
    config = SessionConfig(
        task="cube_into_box", seed=700, scan=False, trials=1, conditions=("without_replanning",)
    )
    run_session(session, config, Output(quiet=True), start_ns=START_NS)
    return run, session.messages


def heard_of(robot: Robot, joints_rad: np.ndarray, stamp_ns: int) -> list[RawMessage]:
    """What another arm on the same table says, standing still."""
    base = FrameTransform(
        stamp_ns=stamp_ns, parent=ROBOT.base_frame, child=robot.base_frame, T_parent_child=np.eye(4)
    )
    state = JointSample(
        stamp_ns=stamp_ns, names=robot.joints, position=joints_rad,
        velocity=np.zeros(0), effort=np.zeros(0),
    )  # fmt: skip
    said = [("/robot_description", schema.STRING, string_to_cdr(robot.description()))]
    if robot.base_frame != ROBOT.base_frame:
        said.append(("/tf_static", schema.TF_MESSAGE, transforms_to_cdr([base])))
    said.append((f"/{CELL}/joint_states", schema.JOINT_STATE, state.to_cdr()))
    return [
        RawMessage(topic, kind, stamp_ns, stamp_ns, number, data)
        for number, (topic, kind, data) in enumerate(said)
    ]


@pytest.mark.parametrize("name", ["panda", "ur10_parallel_gripper"])
def test_gate_and_replay_judge_plans_for_the_arm_that_the_cell_describes(
    name: str, seen: tuple[RunFolder, list[RawMessage]], script: SimpleNamespace, tmp_path: Path
) -> None:
    run, messages = seen
    robot = read_robot(name)
    stamp_ns = max(m.publish_time_ns for m in messages)
    view = LiveView(CELL)
    for m in [*messages, *heard_of(robot, np.zeros(len(robot.joints)), stamp_ns)]:
        view.take(m.topic, m.data, m.publish_time_ns, m.type_name)
    frames = view.frames(max_age_ns=5 * 10**9, max_per_camera=3).frames
    scene: ReplayScene = script.scene()
    found = look(Look(run_path=run.path, frames=frames, task=scene.task))
    poses = {key: item.T_base_object for key, item in found.items()}
    scene = replace(scene, Ts_base_object=poses, urdf=robot.description())
    plan = script.with_joints(script.plan(scene), scene)
    start_rad = np.array(plan.tau[0].joints_rad)
    said = [*messages, *heard_of(robot, start_rad, stamp_ns)]
    stage = Stage(run=run.path, task="cube_into_box", messages=said, oracle=None, bases=[])
    with gate_of(stage, free_endpoint(), tmp_path / "gate.log") as cell:

        def ask(plan: Any) -> Verdict:
            payload = plan.to_json()
            return Verdict.from_json(cell.query(f"{CELL}/gate/verdict", payload, timeout_s=200.0))

        verdict = ask(plan)
        assert verdict.accepted is True, (verdict.reason, (tmp_path / "gate.log").read_text())
        deep = script.plan(scene, grasp_offset_m=(0.0, 0.0, -0.03), plan_id="deep")
        elsewhere = ask(script.with_joints(deep, scene))
        assert elsewhere.accepted is False, elsewhere.reason
        stranger = ask(replace(plan, robot="ur5_parallel_gripper"))
        assert stranger.accepted is None
        assert robot.name in (stranger.reason or "")
    tracks = tracks_of(plan, scene, robot, stamp_ns, script)
    run = RunFolder.create(tmp_path / "run")
    record_trial(run, said, plan, tracks)
    words = ["replay", str(run.path), "--workers", "1", "--quiet"]
    assert robot_gst.run([*words, "--robot", str(ROBOT_FILES / f"{name}.toml")]) == 0
    for path in sorted(run.derived_dir.glob("*.replay.*.dynamic.*.mcap")):
        replayed = streams.verdicts(Episode.open(path))[-1][1]
        assert replayed.accepted is True, (path.name, replayed.reason)


def tracks_of(
    plan: Plan, scene: ReplayScene, robot: Robot, after_ns: int, script: SimpleNamespace
) -> list[JointTrack]:
    """What encoders say of a motion that follows the plan, a second after the last image."""
    result = replay_plan(plan, scene, ReplayConfig(mode="kinematic"))
    return list(script.recorded_tracks(result, after_ns + SECOND, names=robot.joints))


def record_trial(
    run: RunFolder, said: list[RawMessage], plan: Plan, tracks: list[JointTrack]
) -> None:
    """The trial that the gate allowed: what it heard, the plan, and the arm following it."""
    first, last = (int(tracks[0].stamps_ns[i]) for i in (0, -1))
    info = EpisodeInfo(id="trial_1", kind="trial", task="cube_into_box", cell=CELL)
    with EpisodeWriter(run.episodes_dir / "trial_1.mcap") as writer:
        writer.describe(info)
        for m in said:
            writer.write(m.topic, m.data, type_name=m.type_name, log_time_ns=m.publish_time_ns)
        writer.write(f"/{CELL}/plan", plan.to_json(), type_name=schema.PLAN, log_time_ns=first - 1)
        for kind, stamp in (("execution_started", first), ("execution_ended", last)):
            event = {"schema_version": 1, "stamp_ns": stamp, "type": kind, "plan_id": plan.id}
            writer.write_json(f"/{CELL}/event", event, type_name=schema.EVENT, log_time_ns=stamp)
        for topic, track in zip(("joint_states", "gripper/state"), tracks, strict=True):
            for stamp, row in zip(track.stamps_ns.tolist(), track.position, strict=True):
                sample = JointSample(
                    stamp_ns=stamp, names=track.names, position=row,
                    velocity=np.zeros(0), effort=np.zeros(0),
                )  # fmt: skip
                writer.write(
                    f"/{CELL}/{topic}", sample.to_cdr(),
                    type_name=schema.JOINT_STATE, log_time_ns=stamp,
                )  # fmt: skip
