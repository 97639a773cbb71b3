"""The recorder as a process: keys, a status line, a clean end."""

import contextlib
import os
import select
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from bridge.episode.contract import health_lines
from bridge.episode.metadata import EpisodeInfo, Outcome
from bridge.episode.run_folder import RunFolder
from bridge.errors import GstError
from bridge.record.config import EpisodeAbout, RecorderConfig
from bridge.record.control import parse_info
from bridge.record.errors import MissingTopicsError, in_short
from bridge.record.live import LiveRecorder
from bridge.record.recorder import Recorder
from bridge.record.status import describe_status
from bridge.task.task_file import TaskFile
from bridge.terminal import Output
from bridge.wire.config import WireConfig
from bridge.wire.errors import is_loopback
from bridge.wire.session import open_session

HELP = (
    "keys: s start (S although topics are missing), x stop, m mark, y success, n failure; "
    "Ctrl-C ends"
)


@contextlib.contextmanager
def single_keys() -> Iterator[bool]:
    """Deliver keys without Return while the context lasts; yields False without a terminal."""
    if not sys.stdin.isatty():
        yield False
        return
    import termios  # noqa: PLC0415  # not on every system
    import tty  # noqa: PLC0415

    before = termios.tcgetattr(sys.stdin)
    try:
        tty.setcbreak(sys.stdin)
        yield True
    finally:
        termios.tcsetattr(sys.stdin, termios.TCSADRAIN, before)


def pressed_key() -> str:
    """Return a key that was pressed, or "" at once."""
    ready, _, _ = select.select([sys.stdin], [], [], 0)
    return os.read(sys.stdin.fileno(), 1).decode(errors="replace") if ready else ""


def next_info(run: RunFolder, about: EpisodeAbout) -> EpisodeInfo:
    """Describe the next episode: the first free number after the kind's name."""
    taken = {path.name.split(".")[0] for path in run.episodes_dir.iterdir()}
    number = 1
    while f"{about.kind}_{number:04d}" in taken:
        number += 1
    return parse_info(f"{about.kind}_{number:04d}", vars(about))


class Keys:
    """Turns keys into commands."""

    def __init__(self, recorder: Recorder, run: RunFolder, about: EpisodeAbout) -> None:
        """Choose what episodes started by a key are."""
        self._recorder = recorder
        self._run = run
        self._about = about

    def poll(self) -> str:
        """Act on a key that was pressed, if any; returns a line to show, or ""."""
        return self.act(pressed_key())

    def act(self, key: str) -> str:
        """Do what a key stands for; a refusal is a line to show as well."""
        try:
            return self._act(key)
        except GstError as error:
            return str(error)

    def _act(self, key: str) -> str:
        recorder = self._recorder
        if key in ("s", "S"):
            info = next_info(self._run, self._about)
            return f"started {recorder.start(info, anyway=key == 'S')['episode']}"
        if key == "x":
            return _summary(recorder.stop(reason="keyboard"))
        if key == "m":
            return f"marked {recorder.mark('')['episode']}"
        if key in ("y", "n"):
            result = "success" if key == "y" else "failure"
            outcome = Outcome(result=result, k=int(key == "y"))
            return f"{recorder.label(outcome=outcome)['episode']}: {result}"
        return ""


def _summary(answer: dict[str, Any]) -> str:
    line = f"{answer['episode']}: {answer['messages']} messages, {answer['lost']} lost"
    return "\n  ".join([line, *health_lines(answer)])


STATUS_PERIOD_S = 5.0
WAIT_S = 0.25
"""How often it looks whether the required topics are there."""
LIVE_PERIOD_S = 0.5


def run_recorder(
    run_path: Path,
    *,
    wire: WireConfig,
    config: RecorderConfig,
    stop: threading.Event,
    output: Output,
    episode: EpisodeInfo | None = None,
    duration_s: float | None = None,
    about: EpisodeAbout | None = None,
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
    with open_session(wire) as session:
        run = RunFolder.create(run_path)
        recorder = LiveRecorder(session, run, config, output.say, task)
        _say_where(output, wire, config.recorder, run)
        try:
            if episode is not None and not _start(recorder.core, episode, stop, output, anyway):
                return None
            with single_keys() as has_keys:
                keys = Keys(recorder.core, run, about or EpisodeAbout()) if has_keys else None
                _watch(recorder.core, stop, duration_s, output, keys)
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
    recorder: Recorder,
    stop: threading.Event,
    duration_s: float | None,
    output: Output,
    keys: Keys | None,
) -> None:
    end_s = None if duration_s is None else time.monotonic() + duration_s
    if keys is not None:
        output.say(HELP)
    with _status_line(output) as (show, say, period_s):
        last_s = time.monotonic()
        last_messages = 0
        while not stop.wait(0.1) and not recorder.failed.is_set():
            if keys is not None and (said := keys.poll()):
                say(said)
            while recorder.news:
                say(recorder.news.popleft())
            now_s = time.monotonic()
            if end_s is not None and now_s >= end_s:
                return
            if now_s >= last_s + period_s:
                status = recorder.status()
                messages = status.get("messages", 0)
                rate_hz = max(0, messages - last_messages) / (now_s - last_s)
                last_messages, last_s = messages, now_s
                show(describe_status(status, rate_hz))


@contextmanager
def _status_line(
    output: Output,
) -> Iterator[tuple[Callable[[str], None], Callable[[str], None], float]]:
    """Ways to show the status and to say something else, and how often to show it [s].

    On a terminal the status is rewritten in place; otherwise it is a new line every few seconds.
    """
    if output.quiet or not sys.stderr.isatty():
        yield output.say, output.say, STATUS_PERIOD_S
        return
    from rich.console import Console  # noqa: PLC0415  # only for terminals
    from rich.live import Live  # noqa: PLC0415
    from rich.text import Text  # noqa: PLC0415

    console = Console(stderr=True, highlight=False, markup=False)
    with Live(console=console, auto_refresh=False, transient=True) as live:

        def show(text: str) -> None:
            live.update(Text(text), refresh=True)

        yield show, console.print, LIVE_PERIOD_S
