"""Dashboard and demo end when they are told to, whatever they are doing."""

import json
import os
import signal
import socket
import subprocess
import sys
from pathlib import Path
from urllib.parse import urlsplit

import pytest

import robot_gst
from bridge.episode.run_folder import RunFolder
from dashboards import demo

ROOT = Path(__file__).resolve().parents[2]
SLOW = """
import sys, time
import robot_gst
from dashboards import app

def judge(run):
    print("asked", flush=True)
    time.sleep(100)

app.judge = judge
sys.exit(robot_gst.run(["dashboard", sys.argv[1], "--port", "0", "--json"]))
"""


@pytest.mark.slow
def test_a_page_that_takes_minutes_does_not_hold_the_command(tmp_path: Path) -> None:
    run = RunFolder.create(tmp_path / "run")
    process = subprocess.Popen(
        [sys.executable, "-c", SLOW, str(run.path)], cwd=ROOT, stdout=subprocess.PIPE, text=True
    )
    with process:
        try:
            assert process.stdout is not None
            text = ""
            while not text.endswith("}\n"):
                line = process.stdout.readline()
                assert line, "the dashboard ended"
                text += line
            port = urlsplit(json.loads(text)["url"]).port
            with socket.create_connection(("127.0.0.1", port), timeout=20) as page:
                page.sendall(b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
                assert process.stdout.readline() == "asked\n"
                process.send_signal(signal.SIGTERM)
                assert process.wait(30) == 0
        finally:
            process.kill()


def test_a_demo_terminated_while_it_replays_leaves_no_replay_behind(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = RunFolder.create(tmp_path / "run")
    pid_file = tmp_path / "pid"
    code = (
        "import os, signal, sys, time; "
        "open(sys.argv[1], 'w').write(str(os.getpid())); "
        "os.kill(os.getppid(), signal.SIGTERM); time.sleep(60)"
    )
    monkeypatch.setattr(demo, "_record", lambda *_: demo.Recorded())
    monkeypatch.setattr(demo, "_command", lambda _: [sys.executable, "-c", code, str(pid_file)])
    before = signal.signal(signal.SIGTERM, signal.SIG_IGN)
    try:
        assert robot_gst.run(["demo", str(run.path), "--quiet"]) == 130
    finally:
        signal.signal(signal.SIGTERM, before)
    with pytest.raises(ProcessLookupError):
        os.kill(int(pid_file.read_text()), 0)


@pytest.mark.skipif(sys.platform == "win32", reason="processes are adopted on POSIX")
def test_what_a_killed_command_started_ends_too() -> None:
    """Else a recorder that nobody needs writes on, and the command cannot be resumed."""
    child = (
        "import time; from bridge.ending import end_with_starter; end_with_starter(); "
        "print('watches', flush=True); time.sleep(600)"
    )
    code = (
        "import sys; from dashboards import demo; "
        f"demo._command = lambda _: [sys.executable, '-c', {child!r}]; "
        "demo.start_command([]).wait()"
    )
    command = [sys.executable, "-c", code]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as starter:
        assert starter.stdout is not None
        assert starter.stdout.readline() == "watches\n"
        starter.kill()
        assert starter.stdout.read() == ""  # nobody holds its other end any more
