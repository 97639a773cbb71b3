"""Write and read back, also with the official reader; break files on purpose."""

from pathlib import Path

import numpy as np
import pytest
from joint_samples import at_positions

from bridge.episode import metadata, schema, streams
from bridge.episode.cdr import messages
from bridge.episode.reader import Episode
from bridge.episode.writer import EpisodeWriter
from bridge.errors import BridgeError, EpisodeError, SchemaVersionError
from bridge.geometry.camera import Camera
from bridge.media.color import encode_jpeg

CAMERA = Camera.from_ros(width=32, height=24, fx=30.0, fy=30.0, cx=15.5, cy=11.5)
INFO = metadata.EpisodeInfo(id="e1", kind="trial", task="cube_into_box", tags=("a", "b"))


def joint(stamp_ns: int) -> bytes:
    return at_positions(stamp_ns, ("a", "b"), np.array([stamp_ns * 1e-9, 2.0])).to_cdr()


def write_episode(path: Path) -> Path:
    with EpisodeWriter(path) as writer:
        for stream in ("color", "depth"):
            record = messages.CameraInfo(
                stamp_ns=0, frame_id=f"side_{stream}_optical", camera=CAMERA
            )
            topic = f"/c/cam/side/{stream}/info"
            writer.write(topic, record.to_cdr(), type_name=schema.CAMERA_INFO, log_time_ns=1)
        T = np.eye(4)
        T[:3, 3] = [0.1, 0.2, 0.3]
        transforms = [
            messages.FrameTransform(
                stamp_ns=0, parent="base_link", child=f"side_{stream}_optical", T_parent_child=T
            )
            for stream in ("color", "depth")
        ]
        data = messages.transforms_to_cdr(transforms)
        writer.write("/tf_static", data, type_name=schema.TF_MESSAGE, log_time_ns=1)
        for index in range(3):
            stamp_ns = 10 + index * 100_000_000
            image = np.full((24, 32, 3), 40 * index, dtype=np.uint8)
            color = messages.CompressedColor(
                stamp_ns=stamp_ns,
                frame_id="side_color_optical",
                format="jpeg",
                data=encode_jpeg(image),
            )
            depth = messages.DepthImage(
                stamp_ns=stamp_ns,
                frame_id="side_depth_optical",
                depth_mm=np.full((24, 32), 500 + index, dtype=np.uint16),
            )
            for topic, data, name, late_ns in (
                ("/c/cam/side/color/image", color.to_cdr(), schema.COMPRESSED_IMAGE, 5),
                ("/c/cam/side/depth/image", depth.to_cdr(), schema.IMAGE, 5),
                ("/c/joint_states", joint(stamp_ns), schema.JOINT_STATE, 7),
            ):
                times = {"log_time_ns": stamp_ns + late_ns, "publish_time_ns": stamp_ns}
                writer.write(topic, data, type_name=name, **times)
        writer.describe(INFO, outcome=metadata.Outcome(result="success", k=1))
        writer.attach("robot.urdf", b"<robot/>", media_type="application/xml", log_time_ns=9)
    return path


@pytest.fixture
def episode_path(tmp_path: Path) -> Path:
    return write_episode(tmp_path / "e1.mcap")


def test_metadata_survives_the_round_trip(episode_path: Path) -> None:
    episode = Episode.open(episode_path)
    assert episode.info == INFO
    assert episode.outcome == metadata.Outcome(result="success", k=1)
    assert episode.derived is None
    assert episode.attachment("robot.urdf") == b"<robot/>"
    assert streams.robot_description(episode) == "<robot/>"


def test_frames_come_back_with_images_depth_and_poses(episode_path: Path) -> None:
    frames = list(streams.rgbd_frames(Episode.open(episode_path), "side"))
    assert [frame.stamp_ns for frame in frames] == [10, 100_000_010, 200_000_010]
    assert frames[1].depth_m == pytest.approx(0.501)
    assert abs(int(frames[2].image_u8.mean()) - 80) <= 1
    assert frames[0].color_camera == CAMERA
    np.testing.assert_allclose(frames[0].T_base_depth[:3, 3], [0.1, 0.2, 0.3])


def test_while_open_the_file_has_no_final_name(tmp_path: Path) -> None:
    path = tmp_path / "open.mcap"
    writer = EpisodeWriter(path)
    writer.write("/c/joint_states", joint(1), type_name=schema.JOINT_STATE, log_time_ns=1)
    assert not path.exists()
    assert (tmp_path / "open.mcap.part").exists()
    writer.close()
    assert path.exists()
    assert not (tmp_path / "open.mcap.part").exists()


def test_an_exception_while_writing_leaves_only_the_part_file(tmp_path: Path) -> None:
    path = tmp_path / "broken.mcap"
    with pytest.raises(RuntimeError), EpisodeWriter(path):
        raise RuntimeError
    assert not path.exists()
    assert path.with_name("broken.mcap.part").exists()


def test_a_newer_schema_version_is_refused_with_both_numbers(tmp_path: Path) -> None:
    path = tmp_path / "new.mcap"
    with EpisodeWriter(path) as writer:
        writer.describe(metadata.EpisodeInfo(id="new", kind="trial", schema_version=9))
    with pytest.raises(SchemaVersionError, match="version 9, this reader knows 1"):
        Episode.open(path)


def test_an_unknown_camera_is_answered_with_those_that_exist(episode_path: Path) -> None:
    with pytest.raises(EpisodeError, match="Cameras here: side"):
        list(streams.rgbd_frames(Episode.open(episode_path), "front"))


def test_stand_in_truth_is_never_offered_as_a_stream(tmp_path: Path) -> None:
    path = tmp_path / "truth.mcap"
    pose = messages.PoseSample(stamp_ns=1, frame_id="base_link", T_frame_body=np.eye(4)).to_cdr()
    with EpisodeWriter(path) as writer:
        topic = "/standin/truth/object/cube/pose"
        writer.write(topic, pose, type_name=schema.POSE_STAMPED, log_time_ns=1)
        writer.describe(INFO)
    assert streams.object_pose_topics(Episode.open(path)) == {}


def test_a_missing_frame_is_answered_with_those_that_exist(episode_path: Path) -> None:
    tree = streams.transform_tree(Episode.open(episode_path))
    with pytest.raises(BridgeError, match="base_link"):
        tree.T_root_frame("nowhere", 0)
