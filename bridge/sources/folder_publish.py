"""Publishes an RGB-D folder as if it were a live camera."""

import time
from collections.abc import Callable
from typing import Any

from bridge.sources.folder import folder_messages, num_frames
from bridge.sources.folder_config import FolderConfig
from bridge.sources.folder_index import FolderIndex
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
        fast: Do not wait between frames; stamps stay as far apart as the rate says.
        should_stop: Asked before each frame.
        advance: Told how many frames are out.

    Returns:
        Frames and messages sent, and messages by topic.
    """
    publishers: dict[str, WirePublisher] = {}
    sent: dict[str, int] = {}
    frames = 0
    start_s = time.monotonic()
    for messages in folder_messages(index, config, session.now_ns()):
        if not fast:
            time.sleep(max(0.0, start_s + frames / config.rate_hz - time.monotonic()))
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
