"""The recorder as a process: a status line, a clean end."""

import contextlib
import ctypes
import threading
import time
from pathlib import Path
from typing import Any

from bridge.episode.metadata import EpisodeInfo
from bridge.episode.run_folder import RunFolder
from bridge.record.config import RecorderConfig
from bridge.record.errors import MissingTopicsError, in_short
from bridge.record.live import LiveRecorder
from bridge.record.recorder import Recorder
from bridge.record.status import describe_status
from bridge.task.task_file import TaskFile
from bridge.terminal import Output
from bridge.wire.config import WireConfig
from bridge.wire.errors import is_loopback
from bridge.wire.session import open_session

STATUS_PERIOD_S = 5.0
WAIT_S = 0.25
"""How often it looks whether the required topics are there."""


M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3  # as mallopt(3) numbers them
KEPT_BYTES = 32 << 20


def keep_freed_memory() -> None:
    """Let the memory of one image serve the next, rather than ask the system for each."""
    with contextlib.suppress(OSError, AttributeError):  # another C library
        for threshold in (M_TRIM_THRESHOLD, M_MMAP_THRESHOLD):
            ctypes.CDLL(None).mallopt(threshold, KEPT_BYTES)


def run_recorder(
    run_path: Path,
    *,
    wire: WireConfig,
    config: RecorderConfig,
    stop: threading.Event,
    output: Output,
    episode: EpisodeInfo | None = None,
    duration_s: float | None = None,
    anyway: bool = False,
    task: TaskFile | None = None,
) -> dict[str, Any] | None:
    """Record until ``stop`` is set, the duration is over, or the disk fails.

    Args:
        anyway: Start ``episode`` although topics are missing that the contract requires; else it
            waits for them.

    Returns:
        The answer to the last stop if this call stopped an episode, else None.
    """
    keep_freed_memory()
    with open_session(wire) as session:
        run = RunFolder.create(run_path)
        recorder = LiveRecorder(session, run, config, output.say, task)
        _say_where(output, wire, config.recorder, run)
        try:
            if episode is not None and not _start(recorder.core, episode, stop, output, anyway):
                return None
            _watch(recorder.core, stop, duration_s, output)
        finally:
            answer = recorder.close()
        if recorder.core.error is not None:
            raise recorder.core.error
    return answer


def _start(
    recorder: Recorder, episode: EpisodeInfo, stop: threading.Event, output: Output, anyway: bool
) -> bool:
    """Start an episode when the topics are there that its contract requires; say what lacks."""
    told = ""
    while True:
        try:
            answer = recorder.start(episode, anyway=anyway)
        except MissingTopicsError as error:
            if (text := f"waiting: {in_short(error.missing)}") != told:
                output.say(text)
                told = text
            if stop.wait(WAIT_S):
                return False
        else:
            if remark := answer.get("task_remark"):
                output.say(str(remark))
            if answer.get("missing"):
                output.say(f"warning: started although {in_short(answer['missing'])}")
            return True


def _say_where(output: Output, wire: WireConfig, recorder: str, run: RunFolder) -> None:
    where = ", ".join(wire.listen)
    output.say(f"recorder {recorder!r} listens on {where}, writes to {run.path}")
    for endpoint in wire.listen:
        if not is_loopback(endpoint):
            output.say(
                f"warning: {endpoint} can be reached from other machines; whoever reaches it can "
                "publish and control. Use --config with access control, or 127.0.0.1."
            )


def _watch(
    recorder: Recorder, stop: threading.Event, duration_s: float | None, output: Output
) -> None:
    """Say what happens, and every few seconds how it goes, until it is over."""
    end_s = None if duration_s is None else time.monotonic() + duration_s
    last_s, last_messages = time.monotonic(), 0
    while not stop.wait(0.1) and not recorder.failed.is_set():
        while recorder.news:
            output.say(recorder.news.popleft())
        now_s = time.monotonic()
        if end_s is not None and now_s >= end_s:
            return
        if now_s >= last_s + STATUS_PERIOD_S:
            status = recorder.status()
            messages = status.get("messages", 0)
            rate_hz = max(0, messages - last_messages) / (now_s - last_s)
            last_messages, last_s = messages, now_s
            output.say(describe_status(status, rate_hz))
