"""A recorder on the wire: session, recorder, control keys, status, previews."""

import contextlib
import json
import os
import threading
import time
from collections.abc import Callable
from typing import Any

from bridge.episode import schema
from bridge.episode.cdr.codec import MalformedMessageError
from bridge.episode.cdr.images import COLOR_LAYOUTS, image_header, pixel_rows
from bridge.episode.cdr.messages import CompressedColor
from bridge.episode.contract import find_contract
from bridge.episode.recover import recover_parts
from bridge.episode.recovery_report import RecoveryReport
from bridge.episode.run_folder import RunFolder, lock_folder
from bridge.episode.topics import COLOR_TOPIC
from bridge.media.color import UnreadableImageError, decode_color, encode_jpeg
from bridge.record.clocks import ClockAsker
from bridge.record.config import RecorderConfig
from bridge.record.control import serve_control
from bridge.record.errors import FolderTakenError
from bridge.record.presence import Heartbeat
from bridge.record.recorder import Recorder
from bridge.record.ros2 import Ros2Graph
from bridge.task.task_file import TaskFile
from bridge.wire.clocks import ALIVE
from bridge.wire.errors import WireError
from bridge.wire.publisher import WirePublisher
from bridge.wire.qos import Qos
from bridge.wire.rmw import read_definitions
from bridge.wire.session import WireSample, WireSession

WIDTH = 320
QUALITY = 70
MAX_PREVIEWS = 64


class Previews:
    """Makes previews on the encoders' threads; every image of every stream passes here."""

    def __init__(self, session: WireSession, recorder: str, rate_hz: float) -> None:
        """Publish nothing yet."""
        self._session = session
        self._recorder = recorder
        self._period_s = 1 / rate_hz if rate_hz else None
        self._publishers: dict[str, WirePublisher] = {}
        self._names: set[str] = set()
        self._watched: frozenset[str] = frozenset()
        self._next_s: dict[str, float] = {}

    def look(self, topics: list[str]) -> frozenset[str]:
        """Return which image topics somebody watches; called about once a second."""
        if self._period_s is None:
            return self._watched
        for topic in topics[:MAX_PREVIEWS]:
            if topic not in self._publishers and "/depth/" not in topic:
                name = f"/rec/{self._recorder}/preview/{self._name(topic)}"
                try:
                    publisher = self._session.publisher(
                        name, schema.COMPRESSED_IMAGE, qos=Qos.PREVIEW
                    )
                except WireError:  # a name that is no key cannot be watched either
                    continue
                self._publishers[topic] = publisher
        self._watched = frozenset(
            topic for topic, publisher in self._publishers.items() if publisher.has_subscribers()
        )
        return self._watched

    def _name(self, topic: str) -> str:
        found = COLOR_TOPIC.search(topic)
        name = found[1] if found else ""
        if not name or name in self._names:  # two cells may call their cameras the same
            name = topic.strip("/").replace("/", "_")
        self._names.add(name)
        return name

    def show(self, sample: WireSample) -> None:
        """Send a small copy of an image, if somebody looks and it is time for one."""
        topic = sample.topic
        if topic not in self._watched:
            return
        now_s = time.monotonic()
        if now_s < self._next_s.get(topic, 0.0):
            return
        self._next_s[topic] = now_s + (self._period_s or 0.0)
        try:
            picture = small_picture(sample)
        except (MalformedMessageError, UnreadableImageError, ValueError):
            return
        if picture is not None:
            self._publishers[topic].put(picture.to_cdr(), source_ns=picture.stamp_ns)


def small_picture(sample: WireSample) -> CompressedColor | None:
    """Make a JPEG about ``WIDTH`` pixels wide of a colour image, or None of anything else."""
    if sample.type_name in ("", schema.COMPRESSED_IMAGE):
        original = CompressedColor.from_cdr(sample.data)
        pixels, layout = decode_color(original.data), "RGB"
        stamp_ns, frame_id = original.stamp_ns, original.frame_id
    else:
        header = image_header(sample.data)
        if header.encoding not in COLOR_LAYOUTS:
            return None
        layout, channels = COLOR_LAYOUTS[header.encoding]
        pixels = pixel_rows(header).reshape(header.height, header.width, channels)
        stamp_ns, frame_id = header.stamp_ns, header.frame_id
    step = -(-pixels.shape[1] // WIDTH)
    data = encode_jpeg(pixels[::step, ::step], QUALITY, layout=layout)
    return CompressedColor(stamp_ns=stamp_ns, frame_id=frame_id, format="jpeg", data=data)


# Publishers that left are noticed, so that nothing they said is repeated in later episodes. A
# source of ours declares ``<prefix>/alive``; with it go the latched messages under ``/<prefix>/``,
# but not those of a longer prefix that is still there: the cameras of an arm that left.
# Of ROS 2 publishers see Ros2Graph. What a source without a token has said is remembered until the
# recorder ends.


class PublisherLiveliness:
    """Watches liveliness tokens and tells the recorder what to forget."""

    def __init__(self, session: WireSession, recorder: Recorder) -> None:
        """Begin to watch."""
        self._recorder = recorder
        self._lock = threading.Lock()
        self._prefixes: set[str] = set()
        self.close = session.watch_alive(f"**{ALIVE}", self._on_source).close

    def _on_source(self, key: str, alive: bool) -> None:
        if key.startswith("rec/"):
            return
        prefix = f"/{key.removesuffix(ALIVE)}/"
        with self._lock:
            (self._prefixes.add if alive else self._prefixes.discard)(prefix)
            others = tuple(each for each in self._prefixes if each.startswith(prefix))
        self._recorder.presence.publisher(prefix, is_there=alive, others=others)
        if not alive:
            self._recorder.forget(prefix, others)


STATUS_PERIOD_S = 1.0
CONTROL_PREFIX = "/rec/"
"""The recorder is where everybody else connects."""


class LiveRecorder:
    """A recorder that others can see and control; ``core`` does the recording."""

    def __init__(
        self,
        session: WireSession,
        run: RunFolder,
        config: RecorderConfig,
        say: Callable[[str], None],
        task: TaskFile | None = None,
    ) -> None:
        """Recover what a crash left, then listen.

        Raises:
            UsageError: When ``msg_folder`` holds no definitions, or one that is none, when the
                contract cannot be used, or when another recorder writes into the folder.
        """
        if config.msg_folder is not None:  # complain now, not at the first message
            read_definitions(config.msg_folder)
        find_contract(run.path, config.contract)  # the same
        schema.ros_types()  # a fifth of a second that no message waits for
        self.run = run
        self._folder_lock = lock_folder(
            run.episodes_dir, FolderTakenError(run=run.path), shared=config.shares_folder
        )
        self.session = session
        reports = recover_parts(run)
        for report in reports:
            say(_describe_recovery(report))
        previews = Previews(session, config.recorder, config.preview_hz)
        core = self.core = Recorder(
            run, now_ns=session.now_ns, config=config, preview=previews.show, task=task
        )
        core.also_tell("recovered", lambda: [_recovery_record(report) for report in reports])
        self._previews = previews
        self._ended = threading.Event()
        self._subscribers = [
            session.subscribe(key, self._take, max_bytes=config.queues.max_message_bytes)
            for key in config.topics
        ]
        self._departures = PublisherLiveliness(session, core)
        self._graph = Ros2Graph(session, core)
        core.also_tell("clocks", core.clocks.status)
        core.also_tell("receive_errors", lambda: session.receive_errors)
        core.also_tell("last_receive_error", lambda: session.last_receive_error)
        self._heartbeat = Heartbeat(session, config.recorder, core.presence, say)
        queue = core.input_queue
        self._clocks = ClockAsker(
            session, core.clocks, lambda sent: queue.told(sent, session.now_ns()), queue.seen
        )
        core.settle = self._clocks.settle
        self._services = serve_control(session, core)
        name = f"/rec/{config.recorder}/status"
        self._status = session.publisher(name, schema.STATUS, qos=Qos.PREVIEW)
        session.declare_alive(f"rec/{config.recorder}/alive")
        self._thread = threading.Thread(target=self._tell, name="status", daemon=True)
        self._thread.start()

    def _take(self, sample: WireSample) -> None:
        if not sample.topic.startswith(CONTROL_PREFIX):
            self.core.receive(sample)

    def _tell(self) -> None:
        while True:
            self.core.news_arrived.wait(STATUS_PERIOD_S)
            self.core.news_arrived.clear()
            if self._ended.is_set():
                return
            queue = self.core.input_queue
            with contextlib.suppress(WireError):  # the session is closing
                queue.watched = self._previews.look(queue.image_topics())
                self._say_status()

    def _say_status(self) -> None:
        if self._status.has_subscribers():
            data = json.dumps(self.core.status()).encode()
            self._status.put(data, source_ns=self.session.now_ns())

    def close(self) -> dict[str, Any] | None:
        """Finish the open episode, then leave the network; returns the answer to that stop."""
        if self.core.recording:  # while it still listens
            self.core.settle()
        self.core.settle = lambda: None
        self._ended.set()
        self.core.news_arrived.set()
        self._heartbeat.close()
        self._clocks.close()
        if self.core.error is not None:  # whoever listens hears why, before the next second
            with contextlib.suppress(WireError):
                self._say_status()
        for service in self._services:
            service.close()
        for subscriber in self._subscribers:
            subscriber.close()
        self._departures.close()
        self._graph.close()
        self._thread.join(timeout=STATUS_PERIOD_S)
        try:
            return self.core.close()
        finally:
            if self._folder_lock is not None:
                os.close(self._folder_lock)


def _describe_recovery(report: RecoveryReport) -> str:
    if report.output is None:
        return f"cut off: {report.path.name} cannot be recovered: {report.reason}"
    return (
        f"recovered {report.output.name}: {report.messages} messages, "
        f"{report.bytes_lost} bytes lost ({report.reason or 'complete'})"
    )


def _recovery_record(report: RecoveryReport) -> dict[str, Any]:
    return {
        "file": report.path.name,
        "output": report.output.name if report.output else None,
        "messages": report.messages,
        "bytes_lost": report.bytes_lost,
        "reason": report.reason,
    }
