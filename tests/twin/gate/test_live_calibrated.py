"""The gate sees a cell from where its cameras were calibrated, as recordings are judged."""

from pathlib import Path

import numpy as np
import pytest
from joint_samples import at_positions
from live_cell import CAMERA, IMAGE, S, calibrate, event, look, place, shoot

from bridge.episode.cdr.messages import (
    CameraInfo,
    CompressedColor,
    DepthImage,
    FrameTransform,
    string_to_cdr,
    transforms_to_cdr,
)
from bridge.episode.metadata import EpisodeInfo
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.episode.streams import RgbdFrame
from bridge.episode.topics import type_of_topic
from bridge.episode.writer import EpisodeWriter
from bridge.geometry import se3
from bridge.robots.default import ARM_JOINTS, ROBOT
from twin.gate.live import LiveView
from twin.robot.model import load_robot
from twin.scene.localise.stationary_frames import calibrated_cameras, stationary_frames
from twin.scene.store.calibration import Calibration, read_calibration, write_calibration

URDF = ROBOT.urdf_text()
HOME = np.array([-0.263, -1.709, 1.365, -1.227, -1.571, 1.308])
T_LINK_CAMERA = se3.transform_from(np.array([0.9, 0.1, 0.0, 0.4]), np.array([0.03, -0.02, 0.1]))


def calibration_of(folder: Path, link: str, stream: str = "color") -> Calibration:
    run = RunFolder.create(folder / "run")
    q, p = se3.split(T_LINK_CAMERA)
    pose = {"p_m": p.tolist(), "q_wxyz": q.tolist()}
    mount = {"link": link, "stream": stream, "T_link_camera": pose, "depth_scale": 1.02}
    write_calibration(run, {"side": mount}, {})
    found = read_calibration(run)
    assert found is not None
    return found


def joints(view: LiveView, stamp_ns: int, position: np.ndarray = HOME) -> None:
    sample = at_positions(stamp_ns, tuple(ARM_JOINTS), position)
    view.take("/standin/joint_states", sample.to_cdr(), stamp_ns)


class Recorder(LiveView):
    """A live view that also records what it is shown."""

    def __init__(self, path: Path, calibration: Calibration | None) -> None:
        """Open the file."""
        super().__init__("standin", calibration)
        self.path, self.writer = path, EpisodeWriter(path)
        self.writer.describe(EpisodeInfo(id=path.stem, kind="trial", cell="standin"))

    def take(self, topic: str, data: bytes, received_ns: int, type_name: str = "") -> None:
        super().take(topic, data, received_ns, type_name)
        named = type_name or type_of_topic(topic) or ""
        self.writer.write(topic, data, type_name=named, log_time_ns=received_ns)

    def episode(self) -> Episode:
        self.writer.close()
        return Episode.open(self.path)


def show(view: LiveView, *, world: bool = False) -> None:
    """One image at rest, from a camera whose colour and depth lie apart."""
    view.take("/robot_description", string_to_cdr(URDF), 0)
    calibrate(view)
    place(view, x_m=0.4)
    T_color_depth = se3.transform_from(np.array([1.0, 0.0, 0.1, 0.0]), np.array([0.02, 0.0, 0.01]))
    items = [
        FrameTransform(
            stamp_ns=0,
            parent="base_link",
            child="side_depth_optical",
            T_parent_child=se3.transform_from(np.array([1.0, 0, 0, 0]), np.array([0.4, 0, 0]))
            @ T_color_depth,
        )
    ]
    if world:
        T = se3.transform_from(np.array([0.8, 0, 0, 0.6]), np.array([1.0, 2.0, 0.7]))
        items.append(
            FrameTransform(stamp_ns=0, parent="world", child="base_link", T_parent_child=T)
        )
    view.take("/tf_static", transforms_to_cdr(items), 0)
    for tenth in range(5, 16):
        joints(view, tenth * S // 10)
    shoot(view, S)


def as_recorded(view: Recorder, calibration: Calibration | None) -> list[RgbdFrame]:
    episode = view.episode()
    return stationary_frames(episode, 3, poses=calibrated_cameras(episode, calibration))


@pytest.mark.parametrize("stream", ["color", "depth"])
@pytest.mark.parametrize("link", ["base_link", "tool0", None])
@pytest.mark.parametrize("world", [False, True])
def test_the_gate_sees_what_the_recording_is_judged_by(
    tmp_path: Path, link: str | None, stream: str, *, world: bool
) -> None:
    calibration = None if link is None else calibration_of(tmp_path, link, stream)
    view = Recorder(tmp_path / "trial.mcap", calibration)
    show(view, world=world)
    (live,) = look(view).frames
    (recorded,) = as_recorded(view, calibration)
    off = 1e-12 if world and link else 0.0  # the world's pose cancels out
    np.testing.assert_allclose(live.T_base_color, recorded.T_base_color, rtol=0, atol=off)
    np.testing.assert_allclose(live.T_base_depth, recorded.T_base_depth, rtol=0, atol=off)
    np.testing.assert_array_equal(live.depth_m, recorded.depth_m)
    if link is not None:
        T_base_link = load_robot(URDF).T_base_link(link, HOME)
        posed = live.T_base_color if stream == "color" else live.T_base_depth
        np.testing.assert_allclose(posed, T_base_link @ T_LINK_CAMERA, atol=1e-9)
        assert live.depth_m.max() == pytest.approx(0.5 * 1.02)


def test_a_camera_in_the_hand_is_nowhere_without_joints(tmp_path: Path) -> None:
    """/tf would have a place for it: that it is wrong may be why it was calibrated."""
    view = LiveView("standin", calibration_of(tmp_path, "tool0"))
    calibrate(view)
    place(view)
    shoot(view, S)
    assert "side: no robot description" in look(view).reasons[0]
    view.take("/robot_description", string_to_cdr(URDF), 0)
    assert "side: no joint states have arrived" in look(view).reasons[0]
    joints(view, 5 * S)
    assert "no joint states around its images" in look(view).reasons[0]
    joints(view, S, np.full(6, np.nan))
    assert "no joint states around its images" in look(view).reasons[0]
    assert look(view).frames == []


def test_a_calibrated_camera_in_a_hand_that_moves_gives_nothing(tmp_path: Path) -> None:
    view = LiveView("standin", calibration_of(tmp_path, "tool0"))
    view.take("/robot_description", string_to_cdr(URDF), 0)
    calibrate(view)
    for k in range(11):
        joints(view, S + k * S // 50, HOME + 0.02 * k)
    shoot(view, S + S // 10)
    assert "at rest" in look(view).reasons[0]
    event(view, "execution_ended", 2 * S)
    for k in range(11):
        joints(view, 2 * S + k * S // 50)
    shoot(view, 2 * S + S // 10)
    assert [frame.stamp_ns for frame in look(view).frames] == [2 * S + S // 10]


def test_joints_count_as_life_and_say_where_the_arm_is() -> None:
    view = LiveView("standin")
    assert view.joints() is None
    joints(view, 7 * S)
    assert (view.newest_ns(), view.heard_ns()) == (7 * S, 7 * S)
    heard = view.joints()
    assert heard is not None
    assert (tuple(heard[0].names), heard[0].stamp_ns, heard[1]) == (ARM_JOINTS, 7 * S, 7 * S)
    assert heard[0].position == pytest.approx(HOME)


def test_a_gripper_that_publishes_beside_the_arm_does_not_take_its_place() -> None:
    view = LiveView("standin")
    other = at_positions(8 * S, ("finger",), np.zeros(1))
    view.take("/standin/joint_states", other.to_cdr(), 8 * S)
    first = view.joints()
    assert first is not None
    assert list(first[0].names) == ["finger"]
    joints(view, 9 * S)
    view.take("/standin/joint_states", other.to_cdr(), 10 * S)
    heard = view.joints()
    assert heard is not None
    assert (tuple(heard[0].names), heard[0].stamp_ns) == (ARM_JOINTS, 9 * S)


def test_it_says_by_what_cameras_are_posed(tmp_path: Path) -> None:
    calibration = calibration_of(tmp_path, "base_link")
    said = LiveView("standin", calibration).cameras_from()
    assert said.startswith("camera side by robot-gst calibrate")
    assert calibration.calibration_id in said
    assert LiveView("standin").cameras_from() == "cameras by /tf"


def test_cameras_of_two_trees_are_not_mixed(tmp_path: Path) -> None:
    """A camera that /tf hangs elsewhere says nothing of the base that another one is posed in."""
    view = LiveView("standin", calibration_of(tmp_path, "base_link"))
    calibrate(view)
    shoot(view, S)
    for kind in ("color", "depth"):
        for part, data in list(_spare(kind)):
            view.take(f"/standin/cam/alone/{kind}/{part}", data, 0)
    items = [
        FrameTransform(
            stamp_ns=0, parent="camera_link", child=f"alone_{kind}", T_parent_child=np.eye(4)
        )
        for kind in ("color", "depth")
    ]
    view.take("/tf_static", transforms_to_cdr(items), 0)
    live = look(view)
    assert [frame.camera_id for frame in live.frames] == ["side"]
    assert "alone: its poses are in frame 'camera_link', not in 'base_link'" in live.reasons


def _spare(kind: str) -> list[tuple[str, bytes]]:
    info = CameraInfo(stamp_ns=0, frame_id=f"alone_{kind}", camera=CAMERA)
    color = CompressedColor(stamp_ns=S, frame_id="alone_color", format="jpeg", data=IMAGE)
    depth = DepthImage(
        stamp_ns=S, frame_id="alone_depth", depth_mm=np.full((6, 8), 500, dtype=np.uint16)
    )
    return [("info", info.to_cdr()), ("image", (color if kind == "color" else depth).to_cdr())]
