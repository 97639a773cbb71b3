"""The real command as a process of its own."""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from bridge.episode.run_folder import RunFolder
from dashboards import comparison
from dashboards.comparison import Judgement, judge
from evaluator.report.review import refresh

ROOT = Path(__file__).parents[2]


def judged(run: RunFolder) -> Judgement:
    """Return what is known of a run, read as it is now."""
    if judge(run, reads=False).is_old:
        refresh(run)
    return judge(run, reads=False)


@contextmanager
def reader_held(run: RunFolder) -> Iterator[None]:
    """Start what reads a run behind its pages, and let it wait."""
    judge(run)
    update = comparison._KNOWN[run].update
    assert update is not None
    os.kill(update.pid, signal.SIGSTOP)
    try:
        yield
    finally:
        os.kill(update.pid, signal.SIGCONT)


@contextmanager
def dashboard(
    run: RunFolder, port: int = 0, *options: str
) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """Start the real command and wait for its address."""
    with serving(run, port, *options) as (process, record):
        yield process, str(record["url"])


@contextmanager
def serving(
    run: RunFolder, port: int = 0, *options: str
) -> Iterator[tuple[subprocess.Popen[str], dict[str, object]]]:
    """Start the real command and wait for all that it prints when it is ready."""
    command = [
        sys.executable,
        "-m",
        "robot_gst",
        "dashboard",
        str(run.path),
        "--port",
        str(port),
        "--json",
        *options,
    ]
    process = subprocess.Popen(
        command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    assert process.stderr is not None
    try:
        text = ""
        while not text.endswith("}\n"):
            line = process.stdout.readline()
            assert line, process.stderr.read()
            text += line
        yield process, json.loads(text)
    finally:
        if process.poll() is None:
            process.kill()
        process.communicate()
