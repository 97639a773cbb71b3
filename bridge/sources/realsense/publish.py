"""Publishes RealSense cameras: one thread each, back again after the cable was pulled."""

import threading
from collections.abc import Callable
from typing import Any

import pyrealsense2 as rs

from bridge.episode.topics import camera_topic
from bridge.errors import GstError
from bridge.sources.device_samples import Announcer, NumberedPublisher
from bridge.sources.realsense.config import (
    DEFAULT_CAMERA,
    CameraNotFoundError,
    CameraStreamError,
    RealSenseConfig,
)
from bridge.sources.realsense.device import CameraDevice, describe_device, serial_of
from bridge.sources.realsense.messages import CameraMessages, ColorFrame, Frame, Mount, read_mounts
from bridge.terminal import Output
from bridge.wire.clocks import announce
from bridge.wire.qos import Qos
from bridge.wire.session import WireSession

STALL_S = 3.0
"""A camera that is silent for so long is taken for unplugged."""
RETRY_S = 1.0
POLL_S = 0.2

ListDevices = Callable[[], list[Any]]


def attached_devices() -> ListDevices:
    """A function that lists the RealSense cameras attached to this machine."""
    context = rs.context()
    return lambda: list(context.query_devices())


class CameraWorker:
    """Reads one camera and publishes what it sends, for as long as it takes."""

    def __init__(
        self,
        camera: str,
        serial: str,
        *,
        config: RealSenseConfig,
        session: WireSession,
        announcer: Announcer,
        mount: Mount | None,
        list_devices: ListDevices,
        output: Output,
    ) -> None:
        """Announce its topics."""
        self.camera = camera
        self._serial = serial
        self._config = config
        self._session = session
        self._announcer = announcer
        self._mount = mount
        self._list_devices = list_devices
        self._output = output
        self._messages = CameraMessages(config, camera)
        self._streams = {
            stream: NumberedPublisher(session.publisher(topic, type_name, qos=Qos.of(topic)))
            for stream in ("color", "depth")
            for topic, type_name in (self._messages.topic_and_type(stream),)
        }
        self.failure: GstError | None = None
        self.connections = 0

    def run(self, stop: threading.Event) -> None:
        """Work until stopped; a first opening that fails ends everything."""
        try:
            while not stop.is_set():
                device = self._open()
                if device is None:
                    stop.wait(RETRY_S)
                    continue
                try:
                    self._stream(device, stop)
                finally:
                    device.close()
        except GstError as error:
            self.failure = error
            stop.set()

    def _open(self) -> CameraDevice | None:
        try:
            here = [item for item in self._list_devices() if serial_of(item) == self._serial]
        except RuntimeError:  # it went away while being asked
            return None
        if not here:
            return None
        device = here[0]
        try:
            opened = CameraDevice(
                device, self._config, camera=self.camera, now_ns=self._session.now_ns
            )
        except (CameraStreamError, RuntimeError) as error:  # the library raises the latter
            problem = self._problem(error)
            if not self.connections:
                raise problem from error
            self._output.detail(f"{problem} Trying again.")
            return None
        self.connections += 1
        facts = self._messages.facts(opened.calibration, self._mount, self._session.now_ns())
        for number, message in enumerate(facts):
            self._announcer.fact((self.camera, number), message)
        note = ", lens distortion taken out" if opened.rectified else ""
        self._output.say(f"camera {self.camera} ({describe_device(device)}): streaming{note}")
        return opened

    def _problem(self, error: Exception) -> CameraStreamError:
        if isinstance(error, CameraStreamError):
            return error
        return CameraStreamError(
            camera=f"{self.camera} ({self._serial})",
            found=f"the driver says: {error}",
            hint="Unplug it and plug it in again.",
        )

    def _stream(self, device: CameraDevice, stop: threading.Event) -> None:
        silent_s = 0.0
        while not stop.is_set():
            try:
                frames = device.read(POLL_S)
            except RuntimeError as error:
                self._output.say(f"{self._problem(error)} Waiting for it to come back.")
                return
            silent_s = silent_s + POLL_S if frames is None else 0.0
            if silent_s >= STALL_S:
                self._output.say(
                    f"camera {self.camera} ({self._serial}): no frames for {STALL_S:g} s, "
                    "unplugged? Waiting for it to come back."
                )
                return
            for frame in frames or ():
                self._put(frame)

    def _put(self, frame: Frame) -> None:
        if isinstance(frame, ColorFrame):
            stream, data = "color", self._messages.color(frame)
        else:
            stream, data = "depth", self._messages.depth(frame)
        missing = self._streams[stream].put(frame.number, data, source_ns=frame.stamp_ns)
        if missing:
            self._output.detail(f"camera {self.camera}: {missing} {stream} frames missing")

    def counts(self) -> dict[str, int]:
        """What was sent, and what the camera or the bus dropped."""
        return {
            **{f"{name}_frames": stream.sent for name, stream in self._streams.items()},
            **{f"{name}_lost": stream.lost for name, stream in self._streams.items()},
            "connections": self.connections,
        }


class RealSenseSource:
    """Cameras as a ``bridge.sources.source.Source``."""

    def __init__(self, config: RealSenseConfig, list_devices: ListDevices) -> None:
        """Look for every camera asked for."""
        self._config, self._list_devices = config, list_devices
        self._wanted = choose_cameras(config, list_devices)

    def run(
        self, session: WireSession, stop: threading.Event, output: Output
    ) -> dict[str, dict[str, int]]:
        """Publish every camera until stopped, by the caller or because one failed.

        Returns:
            Frames sent and lost by camera.
        """
        config = self._config
        mounts = {} if config.mounts is None else read_mounts(config.mounts, list(self._wanted))
        announcer = Announcer(session)
        announce(session, *(camera_topic(config.cell, name)[1:] for name in self._wanted))
        workers = [
            CameraWorker(
                camera,
                serial,
                config=config,
                session=session,
                announcer=announcer,
                mount=mounts.get(camera),
                list_devices=self._list_devices,
                output=output,
            )
            for camera, serial in self._wanted.items()
        ]
        threads = [
            threading.Thread(target=worker.run, args=(stop,), name=f"camera {worker.camera}")
            for worker in workers
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        announcer.close()
        failures = [worker.failure for worker in workers] + [announcer.failure]
        for failure in failures:
            if failure is not None:
                raise failure
        return {worker.camera: worker.counts() for worker in workers}


def choose_cameras(config: RealSenseConfig, list_devices: ListDevices) -> dict[str, str]:
    """Map names to serial numbers of cameras that are attached.

    Args:
        config: Names and serial numbers wanted; without any, the only camera is taken.
    """
    found = list_devices()
    listed = [describe_device(device) for device in found]
    wanted = config.serials()
    if not wanted:
        if len(found) != 1:
            raise CameraNotFoundError(wanted="named with --camera NAME=SERIAL", found=listed)
        return {DEFAULT_CAMERA: serial_of(found[0])}
    serials = {serial_of(device) for device in found}
    for name, serial in wanted.items():
        if serial not in serials:
            raise CameraNotFoundError(wanted=f"{name} with serial number {serial}", found=listed)
    return wanted
