"""Keys on a terminal: start, stop, mark and label without another window."""

import contextlib
import os
import select
import sys
from collections.abc import Iterator
from typing import Any

from bridge.episode.metadata import EpisodeInfo, Outcome
from bridge.episode.run import RunFolder
from bridge.errors import GstError
from bridge.record.config import EpisodeAbout
from bridge.record.control import parse_info
from bridge.record.recorder import Recorder

HELP = (
    "keys: s start, x stop, p pause or resume, m mark, y success, n failure, "
    "w write the pre-roll; Ctrl-C ends"
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
        if key == "s":
            return f"started {recorder.start(next_info(self._run, self._about))['episode']}"
        if key == "x":
            return _summary(recorder.stop(reason="keyboard"))
        if key == "p":
            if recorder.is_paused:
                return f"resumed {recorder.resume()['episode']}"
            return f"paused {recorder.pause()['episode']}"
        if key == "w":
            return _summary(recorder.snapshot(next_info(self._run, self._about)))
        if key == "m":
            return f"marked {recorder.mark('')['episode']}"
        if key in ("y", "n"):
            result = "success" if key == "y" else "failure"
            outcome = Outcome(result=result, k=int(key == "y"))
            return f"{recorder.label(outcome=outcome)['episode']}: {result}"
        return ""


def _summary(answer: dict[str, Any]) -> str:
    return f"{answer['episode']}: {answer['messages']} messages, {answer['lost']} lost"
