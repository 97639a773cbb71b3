"""What the gate remembers of a live cell, and that it sees it as its cameras were calibrated."""

from pathlib import Path

import numpy as np
import pytest
from joint_samples import at_positions
from live_cell import CAMERA, IMAGE, S, calibrate, event, look, place, shoot

from bridge.episode import schema
from bridge.episode.cdr import codec
from bridge.episode.cdr.images import depth_to_compact, image_header
from bridge.episode.cdr.messages import (
    CameraInfo,
    CompressedColor,
    DepthImage,
    FrameTransform,
    PoseSample,
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
from twin.gate.live import KEPT_IMAGES, SET_BACK_SAMPLES, LiveView
from twin.robot.model import load_robot
from twin.scene.localise.stationary_frames import calibrated_cameras, stationary_frames
from twin.scene.store.calibration import Calibration, read_calibration, write_calibration


def ready() -> LiveView:
    view = LiveView("standin")
    calibrate(view)
    place(view)
    return view


def test_raw_colour_and_compressed_depth_are_frames_too() -> None:
    depth_mm = np.arange(1000, 1048, dtype=np.uint16).reshape(6, 8)
    raw_depth = DepthImage(stamp_ns=S, frame_id="d", depth_mm=depth_mm).to_cdr()
    compact = depth_to_compact(image_header(raw_depth))
    assert compact is not None
    pixels = np.arange(6 * 8 * 3, dtype=np.uint8).reshape(6, 8, 3)
    message = {
        "header": {"stamp": {"sec": 1, "nanosec": 0}, "frame_id": "c"},
        "height": 6,
        "width": 8,
        "encoding": "bgr8",
        "is_bigendian": 0,
        "step": 24,
        "data": pixels.tobytes(),
    }
    raw_color = codec.encode(schema.IMAGE, message)
    view = ready()
    view.take("/standin/cam/side/color/image", raw_color, 0, schema.IMAGE)
    view.take("/standin/cam/side/depth/image", compact, 0, schema.COMPRESSED_IMAGE)
    (frame,) = look(view).frames
    np.testing.assert_array_equal(frame.image_u8, pixels[..., ::-1])
    np.testing.assert_allclose(frame.depth_m, depth_mm * 1e-3, rtol=1e-6)
    view.take("/standin/cam/side/color/image", IMAGE[:9], 0, schema.COMPRESSED_IMAGE)
    view.take("/standin/cam/side/depth/image", compact[:-9], 0, schema.COMPRESSED_IMAGE)
    assert view.malformed == 2


def test_the_newest_frames_are_given_in_metres() -> None:
    view = ready()
    for tenth in range(5):
        shoot(view, S + tenth * S // 10)
    live = look(view)
    assert [frame.stamp_ns for frame in live.frames] == [S + k * S // 10 for k in (2, 3, 4)]
    assert live.frames[0].depth_m.max() == pytest.approx(0.5)
    assert live.reasons == []
    assert view.newest_ns() == S + 4 * S // 10


def test_memory_is_bounded() -> None:
    view = ready()
    for k in range(50):
        shoot(view, S + k)
    assert len(look(view, most=100).frames) == KEPT_IMAGES
    for k in range(50):
        view.take(f"/standin/cam/camera_{k}/color/image", b"junk", 0)
    assert len(view._cameras) <= 16


def test_each_missing_part_has_its_reason() -> None:
    view = LiveView("standin")
    assert look(view).reasons == ["no images on /standin/cam/**"]
    shoot(view, S)
    assert "no calibration on color/info and depth/info" in look(view).reasons[0]
    calibrate(view)
    assert "no transform to side_color_optical" in look(view).reasons[0]
    place(view)
    assert look(view).frames


def test_frames_from_before_the_end_of_an_execution_do_not_count() -> None:
    view = ready()
    shoot(view, S)
    event(view, "execution_started", 2 * S)
    assert view.executing() == "plan_1"
    event(view, "execution_ended", 3 * S)
    assert view.executing() is None
    assert "at rest since the last motion" in look(view).reasons[0]
    shoot(view, 3 * S + 1)  # may still show it: a camera counts as stationary over a while only
    assert "at rest since the last motion" in look(view).reasons[0]
    shoot(view, 3 * S + S // 5)
    assert [frame.stamp_ns for frame in look(view).frames] == [3 * S + S // 5]


def test_a_moving_camera_gives_nothing() -> None:
    view = LiveView("standin")
    calibrate(view)
    for k in range(11):
        place(view, S + k * S // 50, x_m=0.01 * k, topic="/tf")
    shoot(view, S + S // 10)
    assert "at rest" in look(view).reasons[0]


def test_a_camera_that_fell_silent_while_the_cell_went_on_is_not_trusted() -> None:
    view = ready()
    shoot(view, S)
    place(view, 7 * S, topic="/tf")
    assert "silent for 6.0 s of the cell's time" in look(view).reasons[0]
    shoot(view, 7 * S)
    assert [frame.stamp_ns for frame in look(view).frames] == [7 * S]  # the old one is too old


def test_a_cell_that_stands_still_keeps_its_frames_and_says_when_it_was_heard() -> None:
    view = ready()
    shoot(view, S)
    view.take("/robot_description", string_to_cdr("<robot/>"), 77)
    assert view.heard_ns() == 77
    assert look(view).frames


def test_colour_without_depth_of_the_same_time_is_no_frame() -> None:
    view = ready()
    shoot(view, S, depth_lag_ns=S // 10)
    assert look(view).frames == []


def test_messages_that_cannot_be_read_are_counted() -> None:
    view = ready()
    for topic in (
        "/tf",
        "/tf_static",
        "/robot_description",
        "/standin/event",
        "/standin/cam/side/color/image",
        "/standin/cam/side/depth/image",
        "/standin/cam/side/color/info",
    ):
        view.take(topic, b"\x00\x01\x00\x00\xff\xff\xff\xff", 0)
    assert view.malformed == 7
    shoot(view, S)
    assert look(view).frames


def test_an_unreadable_image_is_a_reason() -> None:
    view = ready()
    shoot(view, S)
    bad = CompressedColor(stamp_ns=S + 1, frame_id="c", format="jpeg", data=b"no image")
    view.take("/standin/cam/side/color/image", bad.to_cdr(), 0)
    assert "unreadable image" in look(view).reasons[0]


def test_stand_in_truth_is_passed_over() -> None:
    view = LiveView("standin/truth")
    lie = PoseSample(stamp_ns=9, frame_id="base_link", T_frame_body=np.eye(4))
    view.take("/standin/truth/object/cube/pose", lie.to_cdr(), 0)
    view.take("/standin/truth/cam/side/color/image", b"", 0)
    assert view._cameras == {}
    assert view.malformed == 0


def feel(view: LiveView, stamp_ns: int, count: int = 1) -> None:
    """Joint states of an arm, 8 ms apart."""
    for k in range(count):
        sample = at_positions(stamp_ns + k * S // 125, ("a", "b"), np.array([0.0, 1.0]))
        view.take("/standin/joint_states", sample.to_cdr(), 0)


def test_a_cell_that_starts_again_with_its_clock_set_back_is_seen_as_it_is_now() -> None:
    """The stand-in runs faster than the wall's clock, and each session starts by that."""
    view = ready()
    place(view, 49 * S, topic="/tf")
    shoot(view, 50 * S)
    event(view, "execution_ended", 49 * S)
    feel(view, 50 * S)
    feel(view, S, SET_BACK_SAMPLES)
    assert view.newest_ns() == S + (SET_BACK_SAMPLES - 1) * S // 125
    assert look(view).frames == []  # what the old clock showed is no longer there to be seen
    shoot(view, 3 * S)
    feel(view, 3 * S)
    assert [frame.stamp_ns for frame in look(view).frames] == [3 * S]
    assert view.newest_ns() == 3 * S


def test_late_joint_states_and_those_of_another_publisher_do_not_set_the_clock_back() -> None:
    view = ready()
    shoot(view, 50 * S)
    feel(view, 50 * S)
    for k in range(4):  # an old recording is played beside the arm, three times as fast
        feel(view, S + k * S, SET_BACK_SAMPLES - 1)
        feel(view, 50 * S + k)
    assert view.newest_ns() == 50 * S + 3
    assert look(view).frames
    feel(view, S, SET_BACK_SAMPLES - 1)
    heard = view.joints()
    assert heard is not None
    assert view.newest_ns() - heard[0].stamp_ns > 40 * S  # the gate refuses joints of that age


def test_an_execution_goes_on_when_the_clock_is_set_back() -> None:
    view = ready()
    feel(view, 50 * S)
    event(view, "execution_started", 50 * S)
    feel(view, S, 2 * SET_BACK_SAMPLES)
    assert view.executing() == "plan_1"


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
