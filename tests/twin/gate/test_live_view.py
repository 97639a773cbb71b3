"""What the gate remembers of a live cell: bounded, at rest, with a reason when it is nothing."""

import numpy as np
import pytest
from joint_samples import at_positions
from live_cell import IMAGE, S, calibrate, event, look, place, shoot

from bridge.episode import schema
from bridge.episode.cdr import codec
from bridge.episode.cdr.images import depth_to_compact
from bridge.episode.cdr.messages import CompressedColor, DepthImage, PoseSample, string_to_cdr
from twin.gate.live import KEPT_IMAGES, SET_BACK_SAMPLES, LiveView


def ready() -> LiveView:
    view = LiveView("standin")
    calibrate(view)
    place(view)
    return view


def test_raw_colour_and_compressed_depth_are_frames_too() -> None:
    depth_mm = np.arange(1000, 1048, dtype=np.uint16).reshape(6, 8)
    raw_depth = DepthImage(stamp_ns=S, frame_id="d", depth_mm=depth_mm).to_cdr()
    compact = depth_to_compact(raw_depth)
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
