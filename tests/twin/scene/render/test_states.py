"""Any camera at any state of robot and objects; splats edited elsewhere come back in."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import textured_room

from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.geometry import se3
from bridge.robots.default import ROBOT
from twin.robot.posture import Posture
from twin.scene import gaussians
from twin.scene.render import render
from twin.scene.robot.splats import write_links
from twin.scene.settings import RenderConfig
from twin.scene.store import folder
from twin.scene.trial import open_trial

pytestmark = pytest.mark.usefixtures("few_voxels")


T_BLOB = se3.transform_from(np.array([0.9, 0.1, 0.2, 0.3]), np.array([0.05, 0.1, 0.1]))
HOME = (-0.263, -1.709, 1.365, -1.227, -1.571, 1.308)


def blob(seed: int = 0, count: int = 60) -> gaussians.GaussianCloud:
    rng = np.random.default_rng(seed)
    return gaussians.GaussianCloud(
        means_m=gaussians.as_float32(rng.uniform(-0.05, 0.05, (count, 3))),
        quats_wxyz=gaussians.as_float32(rng.normal(size=(count, 4))),
        scales_log=gaussians.as_float32(np.full((count, 3), np.log(0.01))),
        opacities_logit=gaussians.as_float32(np.full(count, 3.0)),
        colors=gaussians.as_float32(np.tile([0.9, 0.1, 0.1], (count, 1))),
        harmonics=gaussians.as_float32(rng.normal(0, 0.1, (count, 3, 3))),
    )


@pytest.fixture(scope="module")
def rebuilt_once(rebuilt_once: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The small scene with one object, which stands at T_BLOB."""
    run = RunFolder(shutil.copytree(rebuilt_once, tmp_path_factory.mktemp("blob") / "monday"))
    record = folder.read_record(run)
    assert record is not None
    place = run.scene_dir / "objects" / "blob"
    place.mkdir(parents=True)
    gaussians.write_ply(place / "gaussians.ply", blob())
    q, p = se3.split(T_BLOB)
    pose = {"p_m": p.tolist(), "q_wxyz": q.tolist()}
    (place / "object.json").write_text(json.dumps({"T_base_object": pose}))
    record["objects"] = {"blob": {"folder": "objects/blob", "files": {"gaussians.ply": ""}}}
    folder.write_record(run, record)
    return run.path


def test_seconds_count_from_the_first_stamp_whenever_messages_arrived(
    room: RunFolder, tmp_path: Path
) -> None:
    textured_room.write_episode(
        room.episodes_dir / "late.mcap", num_frames=9, sent_late_ns=3_600_000_000_000
    )
    for name in ("scan", "late"):
        out = tmp_path / f"{name}.png"
        render(room, RenderConfig(episode=name, at_s=0.4, out=out))
    assert (tmp_path / "late.png").read_bytes() == (tmp_path / "scan.png").read_bytes()
    render(room, RenderConfig(episode="late", at_s=0.8, out=tmp_path / "end.png"))
    assert (tmp_path / "end.png").read_bytes() != (tmp_path / "late.png").read_bytes()


@pytest.fixture
def with_robot(room: RunFolder) -> RunFolder:
    scene = folder.read_scene(room)
    links = {"base_link": blob(1), "tool0": blob(2)}
    folder.write_record(room, {**scene.record, "robot": {"links": write_links(room, links)}})
    return room


def test_other_joints_move_the_hand_and_not_the_base(with_robot: RunFolder) -> None:
    episode = Episode.open(with_robot.episodes_dir / "scan.mcap")
    parts = open_trial(with_robot, folder.read_scene(with_robot), episode).parts

    def robot(*joints: float) -> np.ndarray:
        posture = Posture(joints_rad=np.array(joints), width_m=0.0)
        return parts.at({}, posture, ROBOT.urdf_text()).means_m[-120:]

    before, after = robot(*HOME), robot(HOME[0] + 0.5, *HOME[1:])
    np.testing.assert_allclose(after[:60], before[:60], atol=1e-6)
    c, s = np.cos(0.5), np.sin(0.5)
    turned = before[60:] @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    np.testing.assert_allclose(after[60:], turned, atol=1e-5)


def test_a_robot_without_recorded_joints_is_left_out_with_a_reason(
    with_robot: RunFolder, tmp_path: Path
) -> None:
    drawn = render(with_robot, RenderConfig(out=tmp_path / "a.png"))
    assert drawn["robot"].startswith("not drawn: ")
