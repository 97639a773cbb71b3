"""Publishes an RGB-D folder as if it were a live camera."""

import time
from collections.abc import Callable
from typing import Any

from bridge.clock import s_from_ns
from bridge.sources.folder.config import FolderConfig
from bridge.sources.folder.frames import FolderIndex
from bridge.sources.folder.messages import folder_messages, frame_times_ns, num_frames
from bridge.terminal import Advance
from bridge.wire.session import WirePublisher, WireSession


def publish_folder_frames(
    session: WireSession,
    index: FolderIndex,
    config: FolderConfig,
    *,
    fast: bool,
    should_stop: Callable[[], bool],
    advance: Advance,
) -> dict[str, Any]:
    """Send every frame at its time, or as fast as the network takes them.

    Args:
        session: An open session.
        index: The checked folder.
        config: Names and rate.
        fast: Do not wait between frames; stamps keep their distance.
        should_stop: Asked before each frame.
        advance: Told how many frames are out.

    Returns:
        Frames and messages sent, and messages by topic.
    """
    publishers: dict[str, WirePublisher] = {}
    sent: dict[str, int] = {}
    frames = 0
    start_ns, start_s = session.now_ns(), time.monotonic()
    times = frame_times_ns(index, config, start_ns)
    for messages in folder_messages(index, config, start_ns):
        if not fast:
            due_s = start_s + s_from_ns(min(times[frames]) - start_ns)
            time.sleep(max(0.0, due_s - time.monotonic()))
        if should_stop():
            break
        for message in messages:
            if message.topic not in publishers:
                publishers[message.topic] = session.publisher(message.topic, message.type_name)
            publishers[message.topic].put(message.data, source_ns=message.stamp_ns)
            sent[message.topic] = sent.get(message.topic, 0) + 1
        frames += 1
        advance(frames, "")
    return {
        "frames": frames,
        "of": num_frames(index, config),
        "unposed_frames_left_out": index.num_unposed,
        "messages": sum(sent.values()),
        "topics": sent,
    }
