"""The command listens where it should, says so, and ends when told to, whatever it does."""

import json
import os
import re
import signal
import socket
import subprocess
import sys
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from serving import dashboard

import robot_gst
from bridge.episode.metadata import EpisodeInfo
from bridge.episode.run_folder import RunFolder
from bridge.episode.writer import EpisodeWriter
from bridge.errors import UsageError
from bridge.terminal import Output
from dashboards import demo
from dashboards.config import DashboardConfig
from dashboards.demo import DemoConfig, run_demo
from dashboards.errors import DashboardError, NotHereError
from dashboards.guard import Admission, host_name, is_loopback
from dashboards.library import derived_paths, episode_path
from dashboards.server import Address, listen


def test_a_taken_port_is_one_clear_sentence() -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        with pytest.raises(DashboardError, match=rf"port {port}: .*in use.*--port 0"):
            listen(DashboardConfig(port=port))


@pytest.mark.parametrize("port", [70_000, -1])
@pytest.mark.parametrize("config", [DashboardConfig, DemoConfig])
def test_a_port_that_cannot_be_is_refused_before_anything_is_done(
    config: type[DashboardConfig | DemoConfig], port: int
) -> None:
    with pytest.raises(UsageError, match="at least 0 and at most 65535"):
        config(port=port)


def test_a_demo_of_an_unknown_task_is_refused_before_anything_is_recorded(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no task named 'nonsense'"):
        run_demo(tmp_path / "run", DemoConfig(quick=True, task=("nonsense",)), Output(quiet=True))
    assert not (tmp_path / "run").exists()


def test_an_address_that_is_not_ours_is_refused() -> None:
    with pytest.raises(DashboardError, match=r"cannot listen on 192\.0\.2\.1"):
        listen(DashboardConfig(host="192.0.2.1", port=0))


def test_by_default_only_this_machine_is_listened_to() -> None:
    with listen(DashboardConfig(port=0)) as listener:
        host, port = listener.getsockname()
    assert host == "127.0.0.1"
    assert port > 0


def test_the_address_can_be_opened_and_tunnelled() -> None:
    address = Address(host="127.0.0.1", port=8600, token=None)
    assert address.url == "http://127.0.0.1:8600/"
    assert address.ssh_line.startswith("ssh -L 8600:127.0.0.1:8600 ")
    assert Address(host="::1", port=1, token=None).url == "http://[::1]:1/"
    assert Address(host="0.0.0.0", port=1, token="t").url == "http://127.0.0.1:1/?token=t"


def test_loopback_is_told_from_the_rest() -> None:
    here, elsewhere = ("127.0.0.1", "127.8.0.1", "::1", "localhost"), ("0.0.0.0", "192.168.1.5")
    assert [*filter(is_loopback, (*here, *elsewhere, "example.org"))] == [*here]


def test_every_listed_file_has_a_page_and_nothing_else_has(run: RunFolder) -> None:
    for name in ("t1", "rosbag 2024.05 [a]"):
        with EpisodeWriter(run.episodes_dir / f"{name}.mcap") as writer:
            writer.describe(EpisodeInfo(id="x", kind="trial"))
    with EpisodeWriter(run.derived_dir / "t1.replay.x.mcap"):
        pass
    for path in run.episodes():
        assert episode_path(run, path.stem) == path
    for name in ("t2", "t1/../../derived/t1.replay.x", "t1.replay.x", "", "*"):
        with pytest.raises(NotHereError):
            episode_path(run, name)
    assert derived_paths(run, "*", "replay") == []
    assert [path.name for path in derived_paths(run, "t1", "replay")] == ["t1.replay.x.mcap"]


def test_host_headers_are_split_from_their_port() -> None:
    assert host_name("LOCALHOST:80") == "localhost"
    assert host_name("[::1]:80") == "::1"
    assert host_name("a:b") == ""
    assert not Admission().admits_host("")


@pytest.mark.slow
@pytest.mark.parametrize("kind", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_command_with_zero(shared_run: RunFolder, kind: int) -> None:
    with dashboard(shared_run) as (process, url):
        assert re.fullmatch(r"http://127\.0\.0\.1:\d+/", url)
        process.send_signal(kind)
        _, errors = process.communicate(timeout=20)
        assert process.returncode == 0
        assert "Traceback" not in errors


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
def test_a_page_that_takes_minutes_does_not_hold_the_command(run: RunFolder) -> None:
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
    tmp_path: Path, run: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
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
