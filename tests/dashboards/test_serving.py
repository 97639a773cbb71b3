"""The command listens where it should, says so, and ends when asked; a real browser sees it."""

import re
import signal
import socket
from pathlib import Path

import pytest
from serving import dashboard

from bridge.episode.metadata import EpisodeInfo
from bridge.episode.run_folder import RunFolder
from bridge.episode.writer import EpisodeWriter
from bridge.errors import UsageError
from bridge.terminal import Output
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


def test_every_listed_file_has_a_page_and_nothing_else_has(tmp_path: Path) -> None:
    run = RunFolder.create(tmp_path / "run")
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
