"""A UR arm, played by an RTDE server of our own, from its controller into a checked episode."""

import json
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import Joined
from rtde_server import TYPES, RtdeServer, counting_state

import robot_gst
from bridge.episode import schema, streams
from bridge.episode.cdr.messages import JointSample, transforms_from_cdr
from bridge.episode.check import check_episode
from bridge.episode.reader import Episode
from bridge.episode.topics import DROPS
from bridge.sources.ur.config import UrConfig
from bridge.sources.ur.publish import UrSource
from bridge.terminal import Output
from bridge.wire.clocks import ask_clocks
from bridge.wire.session import WireSample

QUIET = Output(quiet=True)
ANSWER_S = 20.0


class Running:
    """``UrSource`` on a thread of its own, and how far what it publishes has come."""

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

    def reach(self, number: int) -> None:
        """Let it publish until this sample is out."""
        end_s = time.monotonic() + ANSWER_S
        while self._newest < number:
            assert time.monotonic() < end_s
            assert self.error is None
            time.sleep(0.01)

    def end_after(self, number: int) -> dict[str, Any]:
        """Let it publish until this sample is out, and no longer."""
        self.reach(number)
        return self.end()

    def _run(self, joined: Joined, config: UrConfig, output: Output) -> None:
        try:
            source = UrSource("127.0.0.1", config)
            self.result = source.run(joined.client, self.stop, output)
        except Exception as error:  # noqa: BLE001  # told to the test
            self.error = error

    def end(self) -> dict[str, Any]:
        self._heard.close()
        self.stop.set()
        self._thread.join(timeout=ANSWER_S)
        assert self.error is None
        return self.result


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
    running.reach(550)
    assert "lab/alive" in joined.client.query_alive("**")
    (clock,) = ask_clocks(joined.client, timeout_s=ANSWER_S)
    assert clock.source == "lab"
    assert {"/lab/joint_states", "/tf"} <= clock.topics
    joined.control.stop({"result": "success"})  # a source that ends first has an unknown tail
    result = running.end()
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
    with RtdeServer(counting_state, types=types, version=(3, 5, 0, 1), text=b"hello") as server:
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
    topics = set(Episode.open(joined.episode_path("t1")).topics()) - {DROPS}
    assert topics == {"/lab/joint_states"}


def test_the_command_publishes_and_counts(
    joined: Joined, server: RtdeServer, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["publish", "ur", "127.0.0.1", "--port", str(server.port), "--duration", "1.2"]
    assert robot_gst.run([*arguments, "--connect", joined.endpoint, "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["samples"] > 50
    assert (answer["lost"], answer["connections"]) == (0, 1)
