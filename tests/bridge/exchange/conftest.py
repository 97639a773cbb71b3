"""A small trial of a made-up cell: cameras, joints, gripper, plan, events, verdict, drops."""

import json
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from joint_samples import at_positions
from small_plans import plan_of
from verdicts import verdict_of

from bridge.episode import schema
from bridge.episode.cdr.messages import (
    CameraInfo,
    CompressedColor,
    DepthImage,
    FrameTransform,
    JointSample,
    PoseSample,
    transforms_to_cdr,
)
from bridge.episode.metadata import EpisodeInfo, Outcome
from bridge.episode.topics import type_of_topic
from bridge.episode.writer import EpisodeWriter
from bridge.geometry import se3
from bridge.geometry.camera import Camera
from bridge.media.color import encode_jpeg
from bridge.task.plan import Plan, Stage, Waypoint
from bridge.task.verdict import Factor

sys.path.insert(0, str(Path(__file__).parent))

START_NS = 1_700_000_000_123_456_789
WIDTH, HEIGHT = 32, 24
JOINTS = ("a", "b", "c")


@dataclass(kw_only=True)
class MadeTrial:
    """What goes into an episode; change fields before writing it."""

    id: str = "trial_0001"
    kind: str = "trial"
    task: str = "cube_into_box"
    instruction: str = "put the cube into the box"
    cameras: tuple[str, ...] = ("wrist",)
    num_frames: int = 12
    frame_ns: int = 33_333_333
    depth_lag_ns: int = 0
    has_joints: bool = True
    has_plan: bool = True
    result: str | None = "success"
    far_mm: int = 4000
    joints: tuple[str, ...] = JOINTS
    T_color_depth: np.ndarray = field(default_factory=lambda: np.eye(4))
    seed: int = 0

    @property
    def end_ns(self) -> int:
        return START_NS + self.num_frames * self.frame_ns

    def joint_at(self, stamp_ns: int) -> np.ndarray:
        """Smooth, and linear in time, so that interpolation is exact."""
        t = (stamp_ns - START_NS) * 1e-9
        return np.array([t * (number + 1) for number in range(len(self.joints))])

    def T_base_color(self, stamp_ns: int) -> np.ndarray:
        t = (stamp_ns - START_NS) * 1e-9
        q = np.array([np.cos(t / 2), 0.0, 0.0, np.sin(t / 2)])
        return se3.transform_from(q, np.array([t, 0.2, 0.5]))

    def image(self, number: int, camera: str) -> np.ndarray:
        """A different flat colour in every frame, with a brighter corner."""
        base = 20 + (number * 15) % 200
        shade = np.full((HEIGHT, WIDTH, 3), base, dtype=np.uint8)
        shade[..., sum(camera.encode()) % 3] = 220 - base // 2
        shade[:4, :4] = 250
        return shade

    def depth(self, number: int) -> np.ndarray:
        rng = np.random.default_rng([self.seed, number])
        depth = rng.integers(1, self.far_mm, (HEIGHT, WIDTH)).astype(np.uint16)
        depth[0, :5] = 0
        return depth

    def plan(self) -> Plan:
        waypoints = []
        for t_ns in range(0, self.end_ns - START_NS, 100_000_000):
            joints = self.joint_at(START_NS + t_ns) + 0.01
            waypoints.append(
                Waypoint(
                    t_ns=t_ns,
                    p_m=(0.0, 0.0, 0.0),
                    q_wxyz=(1.0, 0.0, 0.0, 0.0),
                    g=0,
                    width_m=0.08,
                    joints_rad=tuple(map(float, joints)),
                )
            )
        stage = Stage(id="s", text="move", t_start_ns=0, t_end_ns=waypoints[-1].t_ns)
        return plan_of(
            "p1",
            robot="arm",
            frame="base",
            instruction=self.instruction,
            stages=(stage,),
            tau=tuple(waypoints),
            joint_names=self.joints,
        )

    def write(self, path: Path) -> Path:
        messages = []

        def put(topic: str, data: bytes, stamp_ns: int, type_name: str | None = None) -> None:
            name = type_name or type_of_topic(topic)
            assert name is not None
            messages.append((stamp_ns, topic, data, name))

        for camera in self.cameras:
            self._write_camera(camera, put)
        if self.has_joints:
            for stamp in range(START_NS, self.end_ns, 8_000_000):
                put("/lab/joint_states", self._joints(stamp), stamp)
            for stamp in range(START_NS, self.end_ns, 20_000_000):
                put("/lab/gripper/state", self._gripper(stamp), stamp)
        pose = PoseSample(
            stamp_ns=START_NS, frame_id="base", T_frame_body=self.T_base_color(START_NS)
        )
        put("/lab/tcp/pose", pose.to_cdr(), START_NS, schema.POSE_STAMPED)
        if self.has_plan:
            put("/lab/plan", self.plan().to_json(), START_NS)
            for kind, stamp in (("execution_started", START_NS), ("execution_ended", self.end_ns)):
                put("/lab/event", _event(stamp, type=kind, plan_id="p1"), stamp)
        put(
            "/lab/event", _event(START_NS, type="mark", text='a "quoted", word\nand more'), START_NS
        )
        put("/lab/verdict", _verdict(), START_NS)
        put("/recorder/drops", _drops(), START_NS)
        messages.sort(key=lambda item: item[0])
        with EpisodeWriter(path) as writer:
            outcome = None
            if self.result is not None:
                outcome = Outcome(result=self.result, k=int(self.result == "success"))
            info = EpisodeInfo(
                id=self.id,
                kind=self.kind,
                task=self.task,
                instruction=self.instruction,
                cell="lab",
                robot="arm",
            )
            writer.describe(info, outcome=outcome)
            for stamp, topic, data, name in messages:
                writer.write(
                    topic,
                    data,
                    type_name=name,
                    log_time_ns=stamp + 1_000_000,
                    publish_time_ns=stamp,
                )
        return path

    def _write_camera(self, camera: str, put: Callable[..., None]) -> None:
        model = Camera(width=WIDTH, height=HEIGHT, fx=30.0, fy=31.0, cx=16.25, cy=12.5)
        prefix = f"/lab/cam/{camera}"
        color_frame, depth_frame = f"{camera}_color_optical", f"{camera}_depth_optical"
        for stream, frame in (("color", color_frame), ("depth", depth_frame)):
            info = CameraInfo(stamp_ns=START_NS, frame_id=frame, camera=model)
            put(f"{prefix}/{stream}/info", info.to_cdr(), START_NS)
        between = FrameTransform(
            stamp_ns=START_NS,
            parent=color_frame,
            child=depth_frame,
            T_parent_child=self.T_color_depth,
        )
        put("/tf_static", transforms_to_cdr([between]), START_NS)
        for number in range(self.num_frames):
            stamp = START_NS + number * self.frame_ns
            pose = FrameTransform(
                stamp_ns=stamp,
                parent="base",
                child=color_frame,
                T_parent_child=self.T_base_color(stamp),
            )
            put("/tf", transforms_to_cdr([pose]), stamp)
            color = CompressedColor(
                stamp_ns=stamp,
                frame_id=color_frame,
                format="jpeg",
                data=encode_jpeg(self.image(number, camera)),
            )
            put(f"{prefix}/color/image", color.to_cdr(), stamp)
            late = stamp + self.depth_lag_ns
            depth = DepthImage(stamp_ns=late, frame_id=depth_frame, depth_mm=self.depth(number))
            put(f"{prefix}/depth/image", depth.to_cdr(), late)

    def _joints(self, stamp_ns: int) -> bytes:
        return JointSample(
            stamp_ns=stamp_ns,
            names=self.joints,
            position=self.joint_at(stamp_ns),
            velocity=np.full(len(self.joints), 1 / 3),
            effort=np.zeros(0),
        ).to_cdr()

    def _gripper(self, stamp_ns: int) -> bytes:
        return at_positions(
            stamp_ns, ("gripper_width",), np.array([0.08 - (stamp_ns - START_NS) * 1e-11])
        ).to_cdr()


def _event(stamp_ns: int, **fields: object) -> bytes:
    return json.dumps({"schema_version": 1, "stamp_ns": stamp_ns, **fields}).encode()


def _verdict() -> bytes:
    return verdict_of(
        "p1",
        clearance=Factor(value=False, first_t_ns=7, cause="touched"),
        terminal=None,
        engine="bullet",
        seed=3,
        p_success={"value": 0.1, "low": 0.0, "high": 0.3},
    ).to_json()


def _drops() -> bytes:
    record = {
        "schema_version": 1,
        "topic": "/lab/joint_states",
        "second": 0,
        "received": 100,
        "gaps": 2,
        "queue_drops": 1,
        "bytes": 1234,
    }
    return json.dumps(record).encode()


@pytest.fixture
def make_trial(tmp_path: Path) -> Callable[..., Path]:

    def make(**fields: object) -> Path:
        trial = MadeTrial(**fields)  # type: ignore[arg-type]
        return trial.write(tmp_path / "run" / "episodes" / f"{trial.id}.mcap")

    return make


@pytest.fixture(scope="session")
def made_trial() -> type[MadeTrial]:
    """The record behind ``make_trial``, for expected values."""
    return MadeTrial


@pytest.fixture
def dataset(tmp_path: Path) -> Any:
    """Return a LeRobot dataset of three episodes, not yet written."""
    from lerobot_dataset import Dataset  # needs packages that not every test here needs

    return Dataset(tmp_path / "ds")
