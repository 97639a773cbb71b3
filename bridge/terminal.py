"""What the commands print: data on stdout, progress and remarks on stderr."""

import json
import queue
import shutil
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from bridge.heartbeat import BEAT

Advance = Callable[[int, str], None]
"""Called as ``advance(done, note)`` by long work."""


RARE = Parameter(show=False)
"""A setting that help leaves out; docs/cli.md lists it, a file for ``--config`` may hold it."""


@Parameter(name="*", group="Output", negative=())
@dataclass(frozen=True, kw_only=True)
class Output:
    """How a command talks; every command takes these."""

    json: bool = False
    """Print the result as JSON on standard output."""
    verbose: Annotated[bool, Parameter(name=("--verbose", "-v"))] = False
    """Say more about what is going on."""
    quiet: Annotated[bool, Parameter(name=("--quiet", "-q"))] = False
    """Say nothing but results and errors."""

    def say(self, text: str) -> None:
        """Print a remark on stderr unless quiet."""
        if not self.quiet:
            _err().print(text, highlight=False, markup=False)
            BEAT.said_s = time.monotonic()

    def detail(self, text: str) -> None:
        """Print a remark on stderr when verbose."""
        if self.verbose:
            _err().print(text, highlight=False, markup=False, style="dim")

    def result(self, data: Mapping[str, Any], text: str) -> None:
        """Print the result: ``data`` as JSON with ``--json``, else ``text``."""
        if self.json:
            sys.stdout.write(json.dumps(data, indent=2, default=str) + "\n")
        else:
            sys.stdout.write(printable(text.rstrip("\n")) + "\n")
        sys.stdout.flush()

    @contextmanager
    def progress(self, label: str, total: int) -> Iterator[Advance]:
        """Show progress: a bar on a terminal, otherwise a plain line after each silence."""
        if self.quiet:
            yield lambda done, note: None
        elif sys.stderr.isatty():
            with BEAT.doing(None):
                yield from _bar(label, total)
        else:
            yield from _plain(label, total)


def printable(text: str) -> str:
    """Keep text of other programs from moving the cursor; line breaks and tabs stay."""
    return "".join(sign if sign.isprintable() or sign in "\n\t" else "?" for sign in text)


def how_to_activate() -> str:
    """What to do before a command that we advise is found; empty when it is found already."""
    if shutil.which("robot-gst"):
        return ""
    here = Path(".venv")
    named = f": . {here}/bin/activate" if here.resolve() == Path(sys.prefix) else ""
    return f"(robot-gst is not on the PATH: activate its Python environment first{named})"


def _err() -> Console:
    return Console(stderr=True, soft_wrap=True, emoji=False)


def _bar(label: str, total: int) -> Iterator[Advance]:
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[note]}"),
    )
    with Progress(*columns, console=_err()) as progress:
        task = progress.add_task(label, total=total, note="")
        yield lambda done, note: progress.update(task, completed=done, note=note)


def _plain(label: str, total: int) -> Iterator[Advance]:
    began = time.monotonic()
    done, note = 0, ""

    def text() -> str:
        left = _left((time.monotonic() - began) * (total - done) / done) if done else ""
        return f"{label}: {done} of {total}{left} {note}".rstrip()

    def advance(now_done: int, now_note: str) -> None:
        nonlocal done, note
        done, note = now_done, now_note
        BEAT.beat()

    with BEAT.doing(text):
        yield advance


def _left(seconds: float) -> str:
    """Say about how long it will still take, judging by what it took so far."""
    if seconds < 90:
        return f", about {seconds:.0f} s left,"
    minutes = seconds / 60
    if minutes < 90:
        return f", about {minutes:.0f} min left,"
    return f", about {minutes / 60:.1f} h left,"


@contextmanager
def stop_signals() -> Iterator[threading.Event]:
    """Set the event on SIGINT or SIGTERM instead of ending the process."""
    stopped = threading.Event()
    # A handler interrupts the main thread anywhere, also while that holds the event's own lock:
    # to set the event there would wait for ever. This queue may be used in a handler.
    came: queue.SimpleQueue[bool] = queue.SimpleQueue()

    def tell() -> None:
        while came.get():
            stopped.set()

    teller = threading.Thread(target=tell, name="stop signals", daemon=True)
    teller.start()
    before = {
        number: signal.signal(number, lambda *_: came.put(True))
        for number in (signal.SIGINT, signal.SIGTERM)
    }
    try:
        with BEAT.doing(None):
            yield stopped
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        came.put(False)
        teller.join()
