"""Publishes an RGB-D folder as if it were a live camera."""

import threading
import time
from dataclasses import dataclass
from typing import Any

from bridge.clock import s_from_ns
from bridge.episode.topics import (
    COLOR_IMAGE,
    COLOR_INFO,
    DEPTH_IMAGE,
    DEPTH_INFO,
    TF,
    TF_STATIC,
    camera_topic,
)
from bridge.sources.folder.config import FolderConfig
from bridge.sources.folder.frames import FolderIndex
from bridge.sources.folder.messages import folder_messages, frame_times_ns, num_frames
from bridge.terminal import Output
from bridge.wire.clocks import announce
from bridge.wire.session import WirePublisher, WireSession


@dataclass(frozen=True)
class FolderSource:
    """A checked folder as a ``bridge.sources.source.Source``."""

    index: FolderIndex
    config: FolderConfig
    fast: bool = False
    """Do not wait between frames; stamps keep their distance."""

    @property
    def name(self) -> str:
        """The folder's own."""
        return self.index.name

    @property
    def topics(self) -> tuple[str, ...]:
        """Images and intrinsics of one camera, and where it is."""
        endings = (COLOR_IMAGE, COLOR_INFO, DEPTH_IMAGE, DEPTH_INFO)
        camera = self.config.camera
        return (*(camera_topic(self.config.cell, camera, each) for each in endings), TF, TF_STATIC)

    def run(self, session: WireSession, stop: threading.Event, output: Output) -> dict[str, Any]:
        """Send every frame at its time, or as fast as the network takes them.

        Returns:
            Frames and messages sent, and messages by topic.
        """
        index, config = self.index, self.config
        announce(session, camera_topic(config.cell, config.camera)[1:])
        publishers: dict[str, WirePublisher] = {}
        sent: dict[str, int] = {}
        frames, total = 0, num_frames(index, config)
        start_ns, start_s = session.now_ns(), time.monotonic()
        times = frame_times_ns(index, config, start_ns)
        with output.progress("publish", total) as advance:
            for messages in folder_messages(index, config, start_ns):
                if not self.fast:
                    due_s = start_s + s_from_ns(min(times[frames]) - start_ns)
                    time.sleep(max(0.0, due_s - time.monotonic()))
                if stop.is_set():
                    break
                for message in messages:
                    topic = message.topic
                    if topic not in publishers:
                        publishers[topic] = session.publisher(topic, message.type_name)
                    publishers[topic].put(message.data, source_ns=message.stamp_ns)
                    sent[topic] = sent.get(topic, 0) + 1
                frames += 1
                advance(frames, "")
        return {
            "frames": frames,
            "of": total,
            "unposed_frames_left_out": index.num_unposed,
            "messages": sum(sent.values()),
            "topics": sent,
        }
