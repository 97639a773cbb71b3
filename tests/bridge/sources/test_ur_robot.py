"""A UR arm, played by an RTDE server of our own, from its controller into a checked episode."""

import contextlib
import json
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import Joined
from rtde_server import TYPES, RtdeServer

import robot_gst
from bridge.episode import schema, streams
from bridge.episode.check import check_episode
from bridge.episode.reader import Episode
from bridge.episode.records import JointSample, transforms_from_cdr
from bridge.sources.ur import link
from bridge.sources.ur.client import RtdeClient, Wish
from bridge.sources.ur.config import UrConfig
from bridge.sources.ur.errors import ControllerError, NotRtdeError
from bridge.sources.ur.publish import publish_arm
from bridge.terminal import Output
from bridge.wire.session import WireSample

QUIET = Output(quiet=True)
ANSWER_S = 20.0


def state(number: int) -> dict[str, object]:
    """What the robot does: every value tells the sample it belongs to."""
    return {
        "actual_q": [number * 1e-3 + joint for joint in range(6)],
        "actual_qd": [0.125] * 6,
        "target_q": [number * 1e-3 + joint + 0.5 for joint in range(6)],
        "actual_TCP_pose": [0.1, 0.2, 0.3, 0.0, 0.0, number * 1e-3],
        "actual_TCP_force": [1.0, 2.0, 3.0, 4.0, 5.0, 6.0],
        "speed_scaling": 1.0 if number < 250 else 0.25,
        "robot_mode": 7,
        "safety_mode": 1 if number < 250 else 3,
        "actual_digital_output_bits": int(number >= 250),
    }


class Running:
    """``publish_arm`` on a thread of its own, and how far what it publishes has come."""

    def __init__(self, joined: Joined, config: UrConfig, output: Output = QUIET) -> None:
        """Start."""
        self.stop = threading.Event()
        self.result: dict[str, Any] = {}
        self.error: Exception | None = None
        self._newest = -1
        self._heard = joined.client.subscribe(f"{config.cell}/joint_states", self._hear)
        self._thread = threading.Thread(target=self._run, args=(joined, config, output))
        self._thread.start()

    def _hear(self, sample: WireSample) -> None:
        self._newest = round(JointSample.from_cdr(sample.data).position[0] * 1e3)

    def end_after(self, number: int) -> dict[str, Any]:
        """Let it publish until this sample is out."""
        end_s = time.monotonic() + ANSWER_S
        while self._newest < number:
            assert time.monotonic() < end_s
            assert self.error is None
            time.sleep(0.01)
        return self.end()

    def _run(self, joined: Joined, config: UrConfig, output: Output) -> None:
        try:
            self.result = publish_arm(
                joined.client, "127.0.0.1", config, stop=self.stop, output=output
            )
        except Exception as error:  # noqa: BLE001  # told to the test
            self.error = error

    def end(self) -> dict[str, Any]:
        self._heard.close()
        self.stop.set()
        self._thread.join(timeout=ANSWER_S)
        assert self.error is None
        return self.result


@pytest.fixture
def server() -> Iterator[RtdeServer]:
    with RtdeServer(state) as made:
        yield made


def samples_of(path: Path, topic: str) -> list[tuple[int, int, JointSample]]:
    """Sequence, publish time [ns] and content of each message."""
    return [
        (message.sequence, message.publish_time_ns, JointSample.from_cdr(message.data))
        for message in Episode.open(path).messages([topic])
    ]


@pytest.mark.slow
def test_an_arm_is_recorded_whole_and_checks_clean(joined: Joined, server: RtdeServer) -> None:
    server.last = 550
    config = UrConfig(cell="lab", rate_hz=250.0, port=server.port, gripper="digital_out:0")
    joined.control.start("t1", {"kind": "trial", "cell": "lab"})
    running = Running(joined, config)
    result = running.end_after(550)
    joined.control.stop({"result": "success"})
    path = joined.episode_path("t1")
    assert check_episode(path).faults == []
    assert check_episode(path).exit_code == 0

    joints = samples_of(path, "/lab/joint_states")
    numbers = [round(sample.position[0] * 1e3) for _, _, sample in joints]
    assert numbers == list(range(numbers[0], 551))  # every package, in order
    assert 100 < numbers[0] < 250  # half a second finds the offset between the clocks
    assert result["samples"] == len(joints)
    assert (result["lost"], result["connections"]) == (0, 1)
    stamps = np.array([stamp_ns for _, stamp_ns, _ in joints])
    assert np.abs(np.diff(stamps) - 4_000_000).max() <= 0.05 * 4_000_000 + 300
    assert [sample.stamp_ns for _, _, sample in joints] == stamps.tolist()

    episode = Episode.open(path)
    assert episode.topics()["/lab/joint_targets"].count == len(joints)
    assert episode.topics()["/lab/tcp/wrench"].type_name == schema.WRENCH_STAMPED
    widths = streams.joint_track(episode, "/gripper/state")
    assert widths.names == ("gripper_width",)
    assert widths.position[:, 0].min() == 0.0
    closed = widths.position[:, 0] == 0.0
    assert closed.sum() == pytest.approx(301 / 2, abs=2)  # 125 Hz of 250, from sample 250 on
    pose = streams.pose_track(episode, "/lab/tcp/pose")
    assert len(pose.stamps_ns) == len(joints)
    np.testing.assert_allclose(pose.p_m[0], [-0.1, -0.2, 0.3])
    items = [
        transforms_from_cdr(message.data)[0] for message in Episode.open(path).messages(["/tf"])
    ]
    assert {(item.parent, item.child) for item in items} == {("base_link", "tool0_controller")}
    urdf = streams.robot_description(episode)
    assert urdf is not None
    assert "shoulder_pan_joint" in urdf
    said = [event["text"] for event in streams.events(episode) if event["type"] == "note"]
    assert said == [
        "robot mode RUNNING, safety mode NORMAL",
        "robot mode RUNNING, safety mode PROTECTIVE_STOP",
    ]
    speeds = [sample.position[0] for _, _, sample in samples_of(path, "/lab/speed_scaling")]
    assert (speeds[0], speeds[-1], len(speeds)) == (
        1.0,
        0.25,
        3,
    )  # once, changed, a second (250 samples) later


@pytest.mark.slow
def test_packages_a_busy_controller_leaves_out_are_gaps(joined: Joined, server: RtdeServer) -> None:
    server.skipped = {200, 220, 221, 222, 300}
    server.last = 350
    joined.control.start("t1", {"kind": "trial"})
    running = Running(joined, UrConfig(cell="lab", rate_hz=250.0, port=server.port, robot="none"))
    assert running.end_after(350)["lost"] == 5
    joined.control.stop({"result": "success"})
    path = joined.episode_path("t1")
    joints = samples_of(path, "/lab/joint_states")
    first = joints[0]
    for sequence, _, sample in joints:  # the number of a message is that of the robot's sample
        expected = round((sample.position[0] - first[2].position[0]) * 1e3)
        assert sequence - first[0] == expected
    report = check_episode(path)
    assert report.topics["/lab/joint_states"].sequence_gaps == 5
    assert report.exit_code == 3


@pytest.mark.slow
def test_a_connection_cut_in_a_package_is_taken_up_again(
    joined: Joined, server: RtdeServer, capsys: pytest.CaptureFixture[str]
) -> None:
    server.cut_at = 250
    joined.control.start("t1", {"kind": "trial"})
    config = UrConfig(cell="lab", rate_hz=250.0, port=server.port, robot="none")
    running = Running(joined, config, Output())
    result = running.end_after(400)
    joined.control.stop({"result": "success"})
    assert result["connections"] == 2
    numbers = [
        round(sample.position[0] * 1e3)
        for _, _, sample in samples_of(joined.episode_path("t1"), "/lab/joint_states")
    ]
    missing = set(range(numbers[0], numbers[-1] + 1)) - set(numbers)
    assert missing == {250}  # the half package; the robot's clock says so
    assert result["lost"] == 1
    said = capsys.readouterr().err
    assert "the controller is gone (it closed the connection)" in said
    assert "the controller is back" in said


@pytest.mark.slow
def test_an_older_controller_does_without_what_it_does_not_know(
    joined: Joined, capsys: pytest.CaptureFixture[str]
) -> None:
    types = {name: TYPES[name] for name in ("timestamp", "actual_q", "actual_qd")}
    with RtdeServer(state, types=types, version=(3, 5, 0, 1), text=b"hello") as server:
        joined.control.start("t1", {"kind": "trial"})
        config = UrConfig(cell="lab", port=server.port, robot="none")
        running = Running(joined, config, Output(verbose=True))
        running.end_after(90)
        joined.control.stop()
        assert server.rates == [125.0, 125.0]
        assert set(server.recipes[1]) == set(types)
    said = capsys.readouterr().err
    assert "does not know target_q, actual_TCP_pose" in said
    assert "test: hello" in said
    topics = set(Episode.open(joined.episode_path("t1")).topics()) - {schema.DROPS_TOPIC}
    assert topics == {"/lab/joint_states"}


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
    assert link.AGREE_S <= 5.0
    monkeypatch.setattr(link, "AGREE_S", 2.5)
    text = b"\x00\x09M\x02hi\x01x\x00"  # words without end are no agreement either
    peer = Peer(text * 40 if pause_s else b"", pause_s=pause_s, stay=True)
    try:
        begin_s = time.monotonic()
        with pytest.raises(ControllerError, match="gone"):
            connect(peer.port)
        assert time.monotonic() - begin_s < 8.0
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
            time.sleep(0.5)
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
    assert robot_gst.run([*arguments, "--urdf", str(tmp_path / "none.urdf")]) == 2
    assert "URDF file not found" in capsys.readouterr().err
    (tmp_path / "a.urdf").write_text("<xml/>")
    assert robot_gst.run([*arguments, "--urdf", str(tmp_path / "a.urdf")]) == 2


def test_the_command_publishes_and_counts(
    joined: Joined, server: RtdeServer, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["publish", "ur", "127.0.0.1", "--port", str(server.port), "--duration", "1.2"]
    assert robot_gst.run([*arguments, "--connect", joined.endpoint, "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["samples"] > 50
    assert (answer["lost"], answer["connections"]) == (0, 1)


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
