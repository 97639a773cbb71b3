"""RealSense cameras, played by librealsense's software device, from driver to checked episode."""

import io
import json
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from conftest import Joined
from PIL import Image
from PIL.JpegImagePlugin import get_sampling

rs = pytest.importorskip("pyrealsense2", reason="the extra [realsense] is not installed")

from software_camera import SoftwareCamera  # noqa: E402

import robot_gst  # noqa: E402
from bridge.episode import schema, streams  # noqa: E402
from bridge.episode.cdr.messages import CompressedColor, DepthImage  # noqa: E402
from bridge.episode.check import check_episode  # noqa: E402
from bridge.episode.reader import Episode  # noqa: E402
from bridge.media.color import decode_color  # noqa: E402
from bridge.sources.realsense import publish  # noqa: E402
from bridge.sources.realsense.config import (  # noqa: E402
    CameraNotFoundError,
    CameraStreamError,
    RealSenseConfig,
)
from bridge.sources.realsense.device import CameraDevice  # noqa: E402
from bridge.sources.realsense.messages import ColorFrame, DepthFrame  # noqa: E402
from bridge.sources.realsense.publish import RealSenseSource, choose_cameras  # noqa: E402
from bridge.terminal import Output  # noqa: E402
from bridge.wire.clocks import ask_clocks  # noqa: E402
from bridge.wire.qos import Qos  # noqa: E402

QUIET = Output(quiet=True)
ANSWER_S = 20.0
WIDTH, HEIGHT = 640, 480
PLAIN = RealSenseConfig()


def color_image(number: int) -> np.ndarray:
    image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    image[:, :, 0] = number % 256
    image[:, : WIDTH // 2, 1] = 200
    return image


def depth_image(number: int) -> np.ndarray:
    depth = np.full((HEIGHT, WIDTH), 500 + number, np.uint16)
    depth[:, :40] = 0
    return depth


def opened(camera: SoftwareCamera, config: RealSenseConfig = PLAIN) -> CameraDevice:
    return CameraDevice(camera.device, config, camera="side", now_ns=time.time_ns)


def read_all(device: CameraDevice) -> list[Any]:
    found = []
    while (frames := device.read(0.3)) is not None:
        found.extend(frames)
    return found


def test_both_streams_come_through_in_order_and_whole() -> None:
    camera = SoftwareCamera()
    device = opened(camera)
    for number in range(8):
        stamp_ms = 1.7e12 + number * 33.0
        camera.send(number, stamp_ms, color=color_image(number), depth=depth_image(number))
    frames = read_all(device)
    device.close()
    colors = [frame for frame in frames if isinstance(frame, ColorFrame)]
    depths = [frame for frame in frames if isinstance(frame, DepthFrame)]
    assert [frame.number for frame in colors] == [frame.number for frame in depths] == [*range(8)]
    for number, (color, depth) in enumerate(zip(colors, depths, strict=True)):
        np.testing.assert_array_equal(color.image_u8, color_image(number))
        np.testing.assert_array_equal(depth.depth_mm, depth_image(number))
        assert color.stamp_ns == depth.stamp_ns == 1_700_000_000_000_000_000 + number * 33_000_000


def test_calibration_is_the_librarys_own() -> None:
    camera = SoftwareCamera()
    device = opened(camera)
    found = device.calibration
    device.close()
    profile = camera.color.as_video_stream_profile().get_intrinsics()
    point = [0.3, -0.2, 1.5]
    theirs = rs.rs2_transform_point_to_point(camera.between, point)
    ours = (found.T_color_depth @ [*point, 1.0])[:3]
    np.testing.assert_allclose(ours, theirs, atol=1e-6)
    pixel = rs.rs2_project_point_to_pixel(profile, theirs)
    camera_here = found.color_camera  # pixel centres half a pixel further than the library's
    projected = camera_here.project(ours)
    projected = projected[0] if isinstance(projected, tuple) else projected
    np.testing.assert_allclose(np.asarray(projected).reshape(-1)[:2] - 0.5, pixel, atol=1e-3)
    assert (found.depth_camera.width, found.depth_camera.fx) == (WIDTH, pytest.approx(385.0))


@pytest.mark.parametrize("settable", [True, False])
def test_a_d405_sends_tenths_of_millimetres_and_we_hold_whole_ones(*, settable: bool) -> None:
    camera = SoftwareCamera(
        model="Intel RealSense D405", one_sensor=True, unit_m=1e-4, unit_settable=settable
    )
    device = opened(camera)
    assert camera.unit_now_m() == pytest.approx(1e-3 if settable else 1e-4)
    stored = np.zeros((HEIGHT, WIDTH), np.uint16)
    stored[0, :6] = [0, 1, 10, 15, 25, 65535]
    camera.send(1, 1.7e12, color=color_image(0), depth=stored)
    (depth,) = [frame for frame in read_all(device) if isinstance(frame, DepthFrame)]
    device.close()
    expected = [0, 1, 10, 15, 25, 65535] if settable else [0, 0, 1, 2, 2, 6554]
    assert depth.depth_mm[0, :6].tolist() == expected


def test_a_d405s_distorted_colour_is_rectified_at_the_source() -> None:
    camera = SoftwareCamera(one_sensor=True, coeffs=(-0.055, 0.058, 0.0004, 0.0006, -0.019))
    device = opened(camera)
    assert device.rectified
    camera.send(1, 1.7e12, color=np.full((HEIGHT, WIDTH, 3), 77, np.uint8))
    (color,) = read_all(device)
    device.close()
    assert set(np.unique(color.image_u8)) <= {0, 77}
    assert (color.image_u8 == 77).mean() > 0.9


def test_a_size_the_camera_does_not_have_is_refused_with_those_it_has() -> None:
    camera = SoftwareCamera()
    words = r"no color images of 848x480 at 30 Hz\. It offers 640x480 at 30 Hz"
    with pytest.raises(CameraStreamError, match=words):
        opened(camera, RealSenseConfig(size="848x480"))


def test_cameras_are_found_by_serial_number() -> None:
    first, second = SoftwareCamera(serial="111"), SoftwareCamera(serial="222", model="D405")
    both = [first.device, second.device]
    assert choose_cameras(PLAIN, lambda: both[:1]) == {"camera": "111"}
    config = RealSenseConfig(camera=("wrist=222", "side=111"))
    assert choose_cameras(config, lambda: both) == {"wrist": "222", "side": "111"}
    with pytest.raises(CameraNotFoundError, match="attached: D435 111, D405 222"):
        choose_cameras(PLAIN, lambda: both)
    with pytest.raises(CameraNotFoundError, match="wrist with serial number 222; attached: none"):
        choose_cameras(config, list)


def test_the_command_says_that_no_camera_is_there(capsys: pytest.CaptureFixture[str]) -> None:
    if len(rs.context().query_devices()):
        pytest.skip("a RealSense camera is attached to this machine")
    assert robot_gst.run(["publish", "realsense", "--list", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {"cameras": []}
    assert robot_gst.run(["publish", "realsense", "--camera", "side=1"]) == 2
    said = capsys.readouterr().err
    assert "no RealSense camera side with serial number 1; attached: none" in said
    assert said.count("\n") == 1


@pytest.fixture(autouse=True)
def images_wait(monkeypatch: pytest.MonkeyPatch) -> None:
    """Busy links drop images; here each is counted."""
    monkeypatch.setattr(Qos, "CAMERA", Qos.RELIABLE)


class Running:
    """``RealSenseSource`` on a thread of its own."""

    def __init__(
        self,
        joined: Joined,
        config: RealSenseConfig,
        list_devices: Callable[[], list[Any]],
        output: Output = QUIET,
    ) -> None:
        """Start, and wait until the cameras are open."""
        self.stop = threading.Event()
        self.result: dict[str, dict[str, int]] = {}
        self.error: Exception | None = None
        self.heard: dict[str, int] = {}
        self._sub = joined.client.subscribe(f"{config.cell}/**", self._hear)
        self._thread = threading.Thread(
            target=self._run, args=(joined, config, list_devices, output)
        )
        self._thread.start()

    def _hear(self, sample: Any) -> None:
        self.heard[sample.topic] = self.heard.get(sample.topic, 0) + 1

    def _run(
        self,
        joined: Joined,
        config: RealSenseConfig,
        list_devices: Callable[[], list[Any]],
        output: Output,
    ) -> None:
        try:
            source = RealSenseSource(config, list_devices)
            self.result = source.run(joined.client, self.stop, output)
        except Exception as error:  # noqa: BLE001  # told to the test
            self.error = error

    def wait(self, topic: str, count: int) -> None:
        end_s = time.monotonic() + ANSWER_S
        while self.heard.get(topic, 0) < count:
            assert self.error is None, self.error
            assert time.monotonic() < end_s, self.heard
            time.sleep(0.01)

    def end(self) -> dict[str, dict[str, int]]:
        self.stop.set()
        self._thread.join(timeout=ANSWER_S)
        self._sub.close()
        assert self.error is None
        return self.result


@pytest.mark.slow
@pytest.mark.parametrize("color", ["jpeg", "raw"])
def test_two_cameras_are_recorded_and_check_clean(
    joined: Joined, tmp_path: Any, color: Any
) -> None:
    side = SoftwareCamera(serial="111")
    wrist = SoftwareCamera(serial="222", model="Intel RealSense D405", one_sensor=True)
    (tmp_path / "mounts.json").write_text(
        '{"side": {"parent": "base_link", "p_m": [1, 0, 0.5], "q_wxyz": [1, 0, 0, 0]},'
        ' "wrist": {"parent": "tool0_controller", "p_m": [0, 0, 0.1], "q_wxyz": [1, 0, 0, 0]}}'
    )
    config = RealSenseConfig(
        cell="lab",
        camera=("side=111", "wrist=222"),
        color=color,
        mounts=tmp_path / "mounts.json",
    )
    joined.control.start("t1", {"kind": "scan", "cell": "lab"})
    running = Running(joined, config, lambda: [side.device, wrist.device])
    running.wait("/lab/cam/side/depth/info", 1)
    running.wait("/lab/cam/wrist/depth/info", 1)
    alive = {key for key in joined.client.query_alive("**") if "/cam/" in key}
    assert alive == {"lab/cam/side/alive", "lab/cam/wrist/alive"}
    (clock,) = ask_clocks(joined.client, timeout_s=ANSWER_S)
    assert {"/lab/cam/side/color/image", "/lab/cam/wrist/depth/image"} <= clock.topics
    begin_ms = time.time() * 1e3
    for number in range(12):
        for camera in (side, wrist):
            stamp_ms = begin_ms + number * 33.0
            camera.send(number, stamp_ms, color=color_image(number), depth=depth_image(number))
        running.wait("/lab/cam/wrist/color/image", number + 1)
        running.wait("/lab/cam/side/color/image", number + 1)
    result = running.end()
    joined.control.stop()
    expected = {"color_frames": 12, "depth_frames": 12, "color_lost": 0, "depth_lost": 0}
    assert result == {name: {**expected, "connections": 1} for name in ("side", "wrist")}

    path = joined.episode_path("t1")
    report = check_episode(path)
    assert report.faults == []
    assert report.exit_code == 0, report.lines()
    episode = Episode.open(path)
    assert streams.camera_ids(episode) == ["side", "wrist"]
    depths = [
        DepthImage.from_cdr(message.data)
        for message in episode.messages(["/lab/cam/side/depth/image"])
    ]
    for number, depth in enumerate(depths):
        np.testing.assert_array_equal(depth.depth_mm, depth_image(number))
        assert depth.stamp_ns == round((begin_ms + number * 33.0) * 1e3) * 1000
    tree = streams.transform_tree(episode)
    T = tree.T_root_frame("side_depth_optical", depths[0].stamp_ns)
    np.testing.assert_allclose(T[:3, 3], [1.0148, 0.0002, 0.4999], atol=1e-6)
    assert tree.root_of("wrist_color_optical") == "tool0_controller"
    frames = list(streams.rgbd_frames(episode, "side", tree))
    assert len(frames) == 12
    assert abs(int(frames[5].image_u8[10, 600, 0]) - 5) <= 3
    assert frames[5].depth_m[10, 600] == pytest.approx(0.505)


@pytest.mark.slow
def test_frames_the_camera_dropped_are_declared_lost(joined: Joined) -> None:
    camera = SoftwareCamera()
    joined.control.start("t1", {"kind": "scan"})
    running = Running(joined, RealSenseConfig(cell="lab"), lambda: [camera.device])
    running.wait("/lab/cam/camera/depth/info", 1)
    for count, number in enumerate([1, 2, 5, 6, 20]):
        camera.send(number, 1.7e12 + number, color=color_image(number))
        if number != 6:
            camera.send(number, 1.7e12 + number, depth=depth_image(number))
        running.wait("/lab/cam/camera/color/image", count + 1)
    running.wait("/lab/cam/camera/depth/image", 4)
    result = running.end()["camera"]
    joined.control.stop()
    assert (result["color_lost"], result["depth_lost"]) == (2 + 13, 2 + 14)
    report = check_episode(joined.episode_path("t1"))
    assert report.topics["/lab/cam/camera/color/image"].sequence_gaps == 15
    assert report.declared_losses == 31
    assert report.exit_code == 3


@pytest.mark.slow
def test_a_camera_that_was_unplugged_is_taken_up_again(
    joined: Joined, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(publish, "STALL_S", 2.0)
    monkeypatch.setattr(publish, "RETRY_S", 0.2)
    before, after = SoftwareCamera(serial="7"), SoftwareCamera(serial="7")
    attached = [before.device]
    running = Running(
        joined, RealSenseConfig(cell="lab", camera=("eye=7",)), lambda: attached, Output()
    )
    running.wait("/lab/cam/eye/depth/info", 1)
    before.send(900, 1.7e12, color=color_image(1))
    running.wait("/lab/cam/eye/color/image", 1)
    attached.clear()
    said = ""

    def wait_until_said(words: str, times: int) -> None:
        nonlocal said
        end_s = time.monotonic() + ANSWER_S
        while (said := said + capsys.readouterr().err).count(words) < times:
            assert time.monotonic() < end_s, said
            time.sleep(0.02)

    wait_until_said("unplugged?", 1)
    attached.append(after.device)
    running.wait("/lab/cam/eye/depth/info", 2)
    wait_until_said("streaming", 2)
    after.send(1, 1.7e12 + 9000, color=color_image(2))  # its counter starts again: no loss
    running.wait("/lab/cam/eye/color/image", 2)
    result = running.end()["eye"]
    assert (result["connections"], result["color_frames"], result["color_lost"]) == (2, 2, 0)
    said += capsys.readouterr().err
    assert said.count("no frames for 2 s, unplugged? Waiting for it to come back.") == 1
    assert said.count("streaming") == 2


def test_a_failure_at_the_start_ends_the_command(joined: Joined) -> None:
    camera = SoftwareCamera()
    running = Running(joined, RealSenseConfig(size="1280x720"), lambda: [camera.device])
    running._thread.join(timeout=ANSWER_S)
    assert isinstance(running.error, CameraStreamError)
    running._sub.close()


class Flaky:
    """A device that goes away while it is being opened."""

    def __init__(self, device: Any) -> None:
        """Take the place of a device."""
        self._device = device
        self.gone = True

    def __getattr__(self, name: str) -> Any:
        """Answer as the device does, until its sensors are asked for."""
        if name == "query_sensors" and self.gone:
            message = "failed to open USB interface"
            raise RuntimeError(message)
        return getattr(self._device, name)


def test_a_driver_that_fails_is_one_sentence(joined: Joined) -> None:
    camera = SoftwareCamera(serial="9")
    running = Running(joined, PLAIN, lambda: [Flaky(camera.device)])
    running._thread.join(timeout=ANSWER_S)
    running._sub.close()
    assert isinstance(running.error, CameraStreamError)
    assert "camera (9): the driver says: failed to open USB interface. Unplug" in str(running.error)


def test_colour_types_are_declared(joined: Joined) -> None:
    from bridge.sources.realsense.messages import CameraMessages

    raw = CameraMessages(RealSenseConfig(color="raw"), "a")
    assert raw.topic_and_type("color") == ("/cell/cam/a/color/image", schema.IMAGE)
    jpeg = CameraMessages(RealSenseConfig(), "a")
    frame = ColorFrame(number=0, stamp_ns=5, image_u8=color_image(9))
    decoded = CompressedColor.from_cdr(jpeg.color(frame))
    assert (decoded.stamp_ns, decoded.frame_id) == (5, "a_color_optical")
    assert decode_color(decoded.data).shape == (HEIGHT, WIDTH, 3)
    with Image.open(io.BytesIO(decoded.data)) as image:
        assert get_sampling(image) == 2  # 4:2:0: colour at half the size, for half the work
