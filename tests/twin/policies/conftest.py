"""A run with one trial whose objects are known, a scene of a few Gaussians, and two cameras."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from joint_samples import at_positions

sys.path.insert(0, str(Path(__file__).parent.parent / "replay"))
sys.path.insert(0, str(Path(__file__).parent))

from scripted_plans import scene_of_test
from scripted_policies import Scripted

from bridge.episode import schema
from bridge.episode.cdr.messages import (
    CameraInfo,
    CompressedColor,
    FrameTransform,
    string_to_cdr,
    transforms_to_cdr,
)
from bridge.episode.metadata import EpisodeInfo
from bridge.episode.run_folder import RunFolder
from bridge.episode.writer import EpisodeWriter
from bridge.geometry import se3
from bridge.geometry.camera import Camera
from bridge.media.color import encode_png
from bridge.robots.default import ARM_JOINTS
from twin.policies import starts
from twin.policies.starts import Start
from twin.replay.config import ReplayConfig
from twin.replay.scene import StartState, StartStates
from twin.robot.model import load_robot
from twin.scene.gaussians import GaussianCloud, as_float32, write_ply
from twin.scene.localise.episode import Phase
from twin.scene.robot.splats import write_links
from twin.scene.store.folder import background_hash, write_record

HOME = np.array([-0.263, -1.709, 1.365, -1.227, -1.571, 1.308])
CAMERA = Camera(width=64, height=48, fx=52.0, fy=52.0, cx=32.0, cy=24.0)
T_BASE_SIDE = se3.look_at(np.array([1.2, -0.8, 0.9]), np.array([0.45, 0.0, 0.1]), np.eye(3)[2])
T_TCP_WRIST = se3.transform_from(np.array([1.0, 0.0, 0.0, 0.0]), np.array([0.0, -0.08, -0.1]))
T0 = 1_700_000_000_000_000_000


@pytest.fixture
def start() -> Start:
    """The arm over a table with a cube and a box."""
    return Start(
        id="one",
        episode_path=Path("none.mcap"),
        scene=scene_of_test(),
        joints_rad=HOME,
        width_m=0.085,
        stamp_ns=0,
        config=ReplayConfig(),
    )


def cloud(half_m: float, color: tuple[float, ...]) -> GaussianCloud:
    steps = np.linspace(-half_m, half_m, 5)
    points = np.stack(np.meshgrid(steps, steps, steps), axis=-1).reshape(-1, 3)
    return GaussianCloud(
        means_m=as_float32(points),
        quats_wxyz=as_float32(np.tile([1.0, 0.0, 0.0, 0.0], (len(points), 1))),
        scales_log=as_float32(np.full((len(points), 3), np.log(0.005))),
        opacities_logit=as_float32(np.full(len(points), 5.0)),
        colors=as_float32(np.tile(color, (len(points), 1))),
    )


def write_scene(run: RunFolder) -> None:
    """Grey in the middle of the table, a red cube, a green box, a blue hand."""
    run.scene_dir.mkdir()
    write_ply(run.scene_dir / "background.ply", cloud(0.3, (0.4, 0.4, 0.4)))
    pose = {"p_m": [0.1, 0.5, 0.3], "q_wxyz": [1.0, 0.0, 0.0, 0.0]}
    for name, color in (("cube", (0.9, 0.0, 0.0)), ("box", (0.0, 0.9, 0.0))):
        place = run.scene_dir / "objects" / name
        place.mkdir(parents=True)
        write_ply(place / "gaussians.ply", cloud(0.02, color))
        (place / "object.json").write_text(json.dumps({"T_base_object": pose}))
    links = write_links(run, {"tool0": cloud(0.02, (0.0, 0.0, 0.9))})
    record = {"schema_version": 1, "key": "k", "scene_hash": background_hash(run), "background": {},
              "sources": [], "views": [], "robot": {"links": links},
              "objects": {"cube": {}, "box": {}}}  # fmt: skip
    write_record(run, record)


def write_trial(run: RunFolder, name: str, start_id: str, joints: np.ndarray) -> None:
    """Cameras, a hand that goes about so that its camera is known to be in it, no execution."""
    scene = scene_of_test()
    robot = load_robot(scene.urdf)
    with EpisodeWriter(run.episodes_dir / f"{name}.mcap") as writer:
        info = EpisodeInfo(
            id=name, kind="trial", task="cube_into_box", start_id=start_id, policy="Scripted"
        )
        writer.describe(info)

        def say(topic: str, data: bytes, kind: str, stamp: int) -> None:
            writer.write(topic, data, type_name=kind, log_time_ns=stamp, publish_time_ns=stamp)

        say("/robot_description", string_to_cdr(scene.urdf), schema.STRING, T0)
        for camera in ("side", "wrist"):
            about = CameraInfo(stamp_ns=T0, frame_id=camera, camera=CAMERA)
            say(f"/cell/cam/{camera}/color/info", about.to_cdr(), schema.CAMERA_INFO, T0)
        for index in range(11):
            stamp, now = T0 + index * 100_000_000, joints + index * np.array([0.05, 0, 0, 0, 0, 0])
            poses = {"side": T_BASE_SIDE, "wrist": robot.T_base_tcp(now) @ T_TCP_WRIST}
            transforms = [
                FrameTransform(stamp_ns=stamp, parent="base_link", child=child, T_parent_child=T)
                for child, T in poses.items()
            ]
            say("/tf", transforms_to_cdr(transforms), schema.TF_MESSAGE, stamp)
            for camera in poses:  # grey that gets lighter
                shade = np.full((CAMERA.height, CAMERA.width, 3), 20 * index, dtype=np.uint8)
                image = CompressedColor(
                    stamp_ns=stamp, frame_id=camera, format="png", data=encode_png(shade)
                )
                topic = f"/cell/cam/{camera}/color/image"
                say(topic, image.to_cdr(), schema.COMPRESSED_IMAGE, stamp)
            for topic, names, values in (
                ("joint_states", ARM_JOINTS, now),
                ("gripper/state", ("gripper_width",), np.array([0.085])),
            ):
                sample = at_positions(stamp, names, values)
                say(f"/cell/{topic}", sample.to_cdr(), schema.JOINT_STATE, stamp)


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> RunFolder:
    """Two trials of cube_into_box; where their objects were, a person has measured."""
    folder = RunFolder.create(tmp_path / "run")
    write_scene(folder)
    for number in (1, 2):
        begun = Scripted().path.joints_rad[0]
        write_trial(folder, f"trial_{number}", f"start {number}", begun)
    scene = scene_of_test()
    state = StartState(Ts_base_object=scene.Ts_base_object)
    phase = Phase(name="start", plan_id=None, after_ns=None, before_ns=None)

    def measured(*_: object, **__: object) -> StartStates:
        return StartStates(scene.task, [phase], [state])

    monkeypatch.setattr(starts, "localised_starts", measured)
    return folder
