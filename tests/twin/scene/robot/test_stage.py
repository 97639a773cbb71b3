"""The robot's part of a rebuild: in the robot's own frame, in a foreign one, and without joints."""

import sys
from pathlib import Path

import numpy as np
from joint_samples import at_positions
from written_messages import depth_image, put

from bridge.episode import schema
from bridge.episode.cdr import messages
from bridge.episode.metadata import EpisodeInfo
from bridge.episode.run_folder import RunFolder
from bridge.episode.writer import EpisodeWriter
from bridge.media.color import encode_png
from bridge.robots.default import ARM_JOINTS, ROBOT
from bridge.terminal import Output
from twin.scene.dataset.training_set import read_training_set
from twin.scene.frames.selection import choose_frames, find_sources
from twin.scene.robot.extraction import LitLinks, find_robot, write_robot
from twin.scene.settings import FrameConfig, RebuildConfig

sys.path.insert(0, str(Path(__file__).parents[1] / "align"))
import cell_views

QUIET = Output(quiet=True)
SECOND = 1_000_000_000


def write_scan(path: Path, root: str, T_root_base: np.ndarray, *, with_joints: bool = True) -> None:
    """A side camera with exact depth sees the robot stop at four postures."""
    camera = cell_views.load_cell("standin").cameras["side"].camera
    pose = messages.FrameTransform(
        stamp_ns=1,
        parent=root,
        child="side_optical",
        T_parent_child=T_root_base @ cell_views.side_camera_pose(),
    )
    info = messages.CameraInfo(stamp_ns=1, frame_id="side_optical", camera=camera)
    grey = encode_png(np.full((camera.height, camera.width, 3), 128, dtype=np.uint8))
    with EpisodeWriter(path) as writer:
        writer.describe(EpisodeInfo(id=path.stem, kind="scan", cell="c", stand_in=True))
        tf, text = messages.transforms_to_cdr([pose]), messages.string_to_cdr(ROBOT.urdf_text())
        writer.write("/tf_static", tf, type_name=schema.TF_MESSAGE, log_time_ns=1)
        writer.write("/robot_description", text, type_name=schema.STRING, log_time_ns=1)
        for stream in ("color", "depth"):
            put(writer, f"/c/cam/side/{stream}/info", info, 1)
        for index, joints in enumerate(cell_views.POSTURES):
            stamp = 2 * (index + 1) * SECOND
            for part in (-0.4, 0.0, 0.4) if with_joints else ():
                sample = at_positions(
                    stamp + round(part * SECOND), tuple(ARM_JOINTS), np.array(joints)
                )
                put(writer, "/c/joint_states", sample, sample.stamp_ns)
            depth_m = cell_views.take(joints, cell_views.CellErrors(), seed=index, width_m=0.0)
            color = messages.CompressedColor(
                stamp_ns=stamp, frame_id="side_optical", format="png", data=grey
            )
            put(writer, "/c/cam/side/color/image", color, stamp)
            depth = depth_image(stamp, "side_optical", depth_m)
            put(writer, "/c/cam/side/depth/image", depth, stamp)


def test_in_the_robots_own_frame_its_links_are_collected(run: RunFolder) -> None:
    write_scan(run.episodes_dir / "scan.mcap", "base_link", np.eye(4))
    choices = choose_frames(find_sources(run), FrameConfig(), QUIET).choices
    training = read_training_set(choices, RebuildConfig(), QUIET)
    assert training.robot.remark == ""
    links = training.robot.links(60_000)
    assert {"base_link", "upper_arm_link"} <= set(links.clouds)
    record = write_robot(run, training.robot, links)["robot"]
    assert set(record["links"]) == set(links.clouds)
    assert len(record["lighting"]["brightness_sh2"]) == 9
    assert all((run.scene_dir / item["file"]).is_file() for item in record["links"].values())


def test_in_a_foreign_frame_the_robot_is_not_told_and_the_record_says_why(run: RunFolder) -> None:
    write_scan(run.episodes_dir / "scan.mcap", "room", cell_views.anywhere(3))
    choices = choose_frames(find_sources(run), FrameConfig(), QUIET).choices
    found = find_robot(choices)
    assert not found.knows(choices[0].episode)
    record = write_robot(run, found, LitLinks())["robot"]
    assert record["links"] == {}
    assert "'room'" in record["remark"]
    assert "calibrate RUN --cameras" in record["remark"]


def test_without_joints_everything_stays_and_the_record_says_why(run: RunFolder) -> None:
    write_scan(run.episodes_dir / "scan.mcap", "base_link", np.eye(4), with_joints=False)
    choices = choose_frames(find_sources(run), FrameConfig(), QUIET).choices
    found = find_robot(choices)
    assert "joint states" in found.remark
    assert found.links(60_000).clouds == {}
