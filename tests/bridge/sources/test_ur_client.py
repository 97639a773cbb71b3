"""Our RTDE client with a controller, with one that misbehaves, and with what is none."""

import contextlib
import json
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from conftest import Joined
from rtde_server import RtdeServer

import robot_gst
from bridge.sources.ur import rtde as client_module
from bridge.sources.ur.config import ControllerError, NotRtdeError
from bridge.sources.ur.rtde import RtdeClient, Wish

ANSWER_S = 20.0


def connect(port: int, wish: Wish | None = None) -> RtdeClient:
    return RtdeClient(
        "127.0.0.1",
        port,
        wish or Wish(required=("actual_q",)),
        now_ns=time.monotonic_ns,
        on_text=lambda text: None,
    )


def test_a_required_variable_that_is_unknown_is_named(server: RtdeServer) -> None:
    with pytest.raises(ControllerError, match="does not know output_double_register_47"):
        connect(server.port, Wish(required=("actual_q", "output_double_register_47")))


def test_nobody_there_is_one_sentence() -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    with pytest.raises(ControllerError, match=f"127.0.0.1:{port}: no UR controller answers"):
        connect(port)


class Peer:
    """Answers with the same bytes, slowly if asked, then hangs up or stays."""

    def __init__(self, data: bytes, *, pause_s: float = 0.0, stay: bool = False) -> None:
        """Listen."""
        self._listener = socket.socket()
        self._listener.bind(("127.0.0.1", 0))
        self._listener.listen()
        self.port = self._listener.getsockname()[1]
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._serve, args=(data, pause_s, stay), daemon=True)
        self._thread.start()

    def _serve(self, data: bytes, pause_s: float, stay: bool) -> None:
        connection, _ = self._listener.accept()
        with connection:
            for start in range(0, len(data), 1 if pause_s else max(1, len(data))):
                if self._over.wait(pause_s):
                    return
                try:
                    connection.sendall(data[start : start + (1 if pause_s else len(data))])
                except OSError:
                    return
            if stay:
                self._over.wait(ANSWER_S)
                return
            connection.shutdown(socket.SHUT_WR)  # and read on, or what was sent is discarded
            connection.settimeout(ANSWER_S)
            with contextlib.suppress(OSError):
                while connection.recv(4096):
                    pass

    def close(self) -> None:
        self._over.set()
        self._thread.join(timeout=5.0)
        self._listener.close()


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"SSH-2.0-OpenSSH_9.6\r\n", "not a UR controller's RTDE interface: it sent b'SSH"),
        (b"\x00\x04V\x00", "does not speak version 2"),
        (b"\x00\x04V\x01\x00\x07v\x00\x00\x00\x05", "a version of 4 bytes"),
        (b"\x00\x04V\x01\x00\x04S\x01", "a package 'S' in answer to 'v'"),
        (b"\x00\x04V", "it closed the connection"),
        (b"", "is gone"),
    ],
)
def test_a_peer_that_is_no_controller_is_one_sentence(data: bytes, words: str) -> None:
    peer = Peer(data)
    try:
        with pytest.raises(ControllerError) as caught:
            connect(peer.port)
        assert words in str(caught.value)
    finally:
        peer.close()


@pytest.mark.slow
@pytest.mark.parametrize("pause_s", [0.0, 0.4])
def test_a_peer_that_never_finishes_is_left_in_time(
    pause_s: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert client_module.AGREE_S <= 5.0
    monkeypatch.setattr(client_module, "AGREE_S", 2.5)
    text = b"\x00\x09M\x02hi\x01x\x00"  # words without end are no agreement either
    peer = Peer(text * 4000 if pause_s else b"", pause_s=pause_s, stay=True)
    try:
        with pytest.raises(ControllerError, match="gone"):
            connect(peer.port)
    finally:
        peer.close()


def test_a_package_with_a_wrong_length_ends_the_connection(server: RtdeServer) -> None:
    server.types["actual_q"] = "VECTOR6D"
    client = connect(server.port)
    rows = client.samples()
    assert next(rows).values["actual_q"][0] == 0.0  # type: ignore[index]
    server.types["actual_q"] = "DOUBLE"  # the controller changes its mind
    server.state = lambda number: {"actual_q": 1.0}
    with pytest.raises(NotRtdeError, match=r"bytes, expected 57"):
        for _ in rows:
            pass
    client.close()


def test_a_stall_of_ours_loses_nothing(server: RtdeServer) -> None:
    client = connect(server.port)
    found = []
    for sample in client.samples():
        found.append(round(sample.values["actual_q"][0] * 1e3))  # type: ignore[index]
        if len(found) == 50:
            while len(server.sent) < 300:  # half a second of samples that nobody reads
                time.sleep(0.01)
        if len(found) == 400:
            break
    client.close()
    assert found == list(range(400))


def test_the_command_says_what_is_wrong(
    joined: Joined, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    peer = Peer(b"HTTP/1.1 400 Bad Request\r\n\r\n")
    arguments = ["publish", "ur", "127.0.0.1", "--connect", joined.endpoint, "--quiet"]
    try:
        assert robot_gst.run([*arguments, "--port", str(peer.port)]) == 1
    finally:
        peer.close()
    said = capsys.readouterr().err
    assert "not a UR controller's RTDE interface" in said
    assert said.count("\n") == 1
    (tmp_path / "a.urdf").write_text("<xml/>")
    assert robot_gst.run([*arguments, "--robot", str(tmp_path / "a.urdf")]) == 2


@pytest.mark.slow
@pytest.mark.parity
def test_the_server_satisfies_an_independent_client() -> None:
    """``ur-rtde`` is written against real controllers; what it reads, our client reads too."""
    pytest.importorskip("rtde_receive")
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("127.0.0.1", 30004))
        except OSError:
            pytest.skip("port 30004, the only one ur-rtde knows, is taken on this machine")
    code = (
        "import rtde_receive, json, time\n"
        "r = rtde_receive.RTDEReceiveInterface('127.0.0.1', 125.0,"
        " ['timestamp', 'actual_q', 'actual_TCP_pose', 'robot_mode'])\n"
        "time.sleep(0.3)\n"
        "print(json.dumps([r.getActualQ(), r.getActualTCPPose(), r.getRobotMode()]))\n"
        "r.disconnect()\n"
    )
    fixed = {"actual_q": [1.0, 2.0, 3.0, 4.0, 5.0, 6.0], "robot_mode": 7}
    fixed["actual_TCP_pose"] = [0.1, 0.2, 0.3, 0.4, 0.5, 0.6]
    with RtdeServer(lambda number: fixed, port=30004) as server:
        done = subprocess.run(  # a process of its own: it holds the interpreter while it waits
            [sys.executable, "-c", code], capture_output=True, text=True, timeout=30, check=True
        )
        theirs = json.loads(done.stdout.splitlines()[-1])
        client = connect(server.port, Wish(required=("actual_q", "actual_TCP_pose", "robot_mode")))
        ours = next(client.samples()).values
        client.close()
    assert theirs == [
        list(ours["actual_q"]),  # type: ignore[arg-type]
        list(ours["actual_TCP_pose"]),  # type: ignore[arg-type]
        ours["robot_mode"],
    ]
