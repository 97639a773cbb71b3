"""The dashboard ends when it is told to, whatever it is doing."""

import json
import signal
import socket
import subprocess
import sys
from pathlib import Path
from urllib.parse import urlsplit

import pytest

from bridge.episode.run import RunFolder

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
