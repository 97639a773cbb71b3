"""A policy drives the stand-in cell over zenoh: real sessions, a real recorder, a real server."""

import json
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from loopback import free_endpoint
from test_openpi import pack, served

from bridge.episode import streams
from bridge.episode.cdr.messages import JointSample
from bridge.episode.metadata import tagged
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.episode.topics import POLICY_TARGETS
from bridge.record.control import RecorderClient, serve_control
from bridge.record.recorder import Recorder
from bridge.robots.default import ARM_JOINTS
from bridge.robots.robot import GRIPPER_WIDTH
from bridge.sources.standin.session import run_session
from bridge.sources.standin.settings import SessionConfig
from bridge.terminal import Output
from bridge.wire.config import WireConfig
from bridge.wire.qos import Qos
from bridge.wire.session import WireSession, open_session
from twin.policies import runner as running
from twin.policies.config import RolloutConfig
from twin.policies.runner import CellRunner

QUIET = Output(quiet=True)


class Laboratory(NamedTuple):
    """A recorder behind a router, and whoever joins."""

    run: RunFolder
    endpoint: str

    def join(self) -> WireSession:
        return open_session(WireConfig(connect=(self.endpoint,)))

    @contextmanager
    def acting(self, policy: str, **more: Any) -> Iterator[CellRunner]:
        """The runner of a policy, until the block ends."""
        about = {"timeout_s": 1.0, **more}
        config = RolloutConfig(policy=policy, name="mine", cell="standin", **about)
        stop = threading.Event()
        with self.join() as session:
            runner = CellRunner(session, config, QUIET)
            thread = threading.Thread(target=runner.run, args=(stop,))
            thread.start()
            try:
                yield runner
            finally:
                stop.set()
                thread.join()
                runner.close()

    def trial(self, max_s: float = 1.5) -> tuple[dict[str, Any], Episode]:
        """One start of the stand-in cell, driven by whoever acts."""
        config = SessionConfig(
            planner="policy", policy="mine", scan=False, trials=1, max_s=max_s,
            conditions=("without_replanning",), image_scale=0.1,
        )  # fmt: skip
        with self.join() as session:
            summary = run_session(session, config, QUIET)
        return summary, Episode.open(self.run.episodes_dir / "trial_0001.mcap")


@pytest.fixture
def laboratory(tmp_path: Path) -> Iterator[Laboratory]:
    run, endpoint = RunFolder.create(tmp_path / "run"), free_endpoint()
    with open_session(WireConfig(mode="router", connect=(), listen=(endpoint,))) as session:
        recorder = Recorder(run, now_ns=session.now_ns)
        session.subscribe("**", recorder.receive)
        serve_control(session, recorder)
        yield Laboratory(run, endpoint)
        recorder.close()


def moved_rad(episode: Episode) -> float:
    return float(np.ptp(streams.joint_track(episode).position, axis=0).max())


def outcome_of(episode: Episode) -> tuple[str, str]:
    assert episode.outcome is not None
    return episode.outcome.result, str(episode.outcome.detail)


def test_what_a_policy_sends_moves_the_arm_and_says_who_acted(laboratory: Laboratory) -> None:
    with laboratory.acting("scripted_policies:nodding"):
        summary, episode = laboratory.trial(max_s=3.0)
    assert summary["outcomes"] == {"without_replanning": {"failure": 1}}
    assert episode.info.policy == "mine"
    assert tagged(episode.info.tags, "checkpoint:").startswith("code=scripted_policies:nodding map")
    assert len(tagged(episode.info.tags, "mapping:")) > 6
    began, ended = (e for e in streams.events(episode) if e["type"].startswith("execution"))
    assert began["data"]["prompt"] == "Put the red cube into the box."
    assert ended["data"]["asked"] > 0
    sent = streams.joint_track(episode, POLICY_TARGETS)
    assert sent.names == (*ARM_JOINTS, GRIPPER_WIDTH)
    pan, went = streams.joint_track(episode).position[:, 0], sent.position[:, 0]
    assert went.max() > went[0] + 0.1
    assert pan.max() == pytest.approx(went.max(), abs=0.06)  # the last one may not be reached


def lasting(data: bytes) -> bytes:
    time.sleep(3.0)
    return data


BAD: dict[str, tuple[Callable[[bytes], bytes | str], str, str]] = {
    "silent": (lasting, "unknown", "said nothing for 1 s"),
    "text": (lambda _: "Traceback\nValueError: no such key", "unknown", "ValueError: no such key"),
    "not a number": (lambda _: pack({"actions": np.full(7, np.nan)}), "unknown", "not finite"),
    "another shape": (lambda _: pack({"actions": np.zeros((2, 2, 7))}), "unknown", "have shape"),
    "another arm": (lambda _: pack({"actions": np.zeros(8)}), "unknown", "takes rows of 7"),
    "too large": (lambda _: bytes(65 << 20), "unknown", "closed the connection"),
    "out of limits": (lambda _: pack({"actions": np.full(7, 9.0)}), "failure", "beyond its limits"),
    "in degrees": (
        lambda _: pack({"actions": np.array([-15.0, -98, 78, -70, -90, 75, 0.08])}),
        "failure",
        "degrees = true",
    ),
    "too fast": (lambda _: pack({"actions": np.zeros(7)}), "failure", "moves at"),
}


@pytest.mark.parametrize("name", BAD)
def test_a_bad_answer_moves_nothing_and_is_told(laboratory: Laboratory, name: str) -> None:
    answer, result, words = BAD[name]
    with served(answer) as (address, _), laboratory.acting(address):
        _, episode = laboratory.trial(max_s=4.0)
    found, detail = outcome_of(episode)
    assert found == result
    assert words in detail
    assert moved_rad(episode) < 0.01


def test_a_policy_that_is_slower_than_the_trial_is_not_judged(laboratory: Laboratory) -> None:
    with served(lasting) as (address, _), laboratory.acting(address, timeout_s=30.0):
        _, episode = laboratory.trial(max_s=1.0)
    assert outcome_of(episode) == ("unknown", "the policy gave no answer in time")
    assert moved_rad(episode) < 0.01


def test_a_server_that_closes_ends_the_trial(laboratory: Laboratory) -> None:
    def broken(_: bytes) -> bytes:
        raise ValueError("gone")  # the server closes the connection

    with served(broken) as (address, _), laboratory.acting(address):
        _, episode = laboratory.trial()
    assert outcome_of(episode)[0] == "unknown"
    assert "closed the connection" in outcome_of(episode)[1]
    assert moved_rad(episode) < 0.01


def test_a_camera_that_the_cell_lacks_is_named(
    laboratory: Laboratory, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(running, "READY_S", 3.0)
    mapping = tmp_path / "map.toml"
    mapping.write_text('[images.front]\ncamera = "front"\n')
    with laboratory.acting("scripted_policies:still", map=mapping):
        _, episode = laboratory.trial()
    result, detail = outcome_of(episode)
    assert result == "unknown"
    assert "nothing came on /standin/cam/front/color/image in 3 s" in detail
    assert "/standin/cam/side/color/image" in detail
    assert moved_rad(episode) < 0.01


def test_nobody_acts_and_nothing_moves(laboratory: Laboratory) -> None:
    _, episode = laboratory.trial()
    assert outcome_of(episode)[0] == "unknown"
    assert "no policy acts: nobody answered on standin/policy/mine" in outcome_of(episode)[1]
    assert moved_rad(episode) < 0.01


def test_the_operators_stop_ends_it(laboratory: Laboratory) -> None:
    with ExitStack() as stack:
        runner = stack.enter_context(laboratory.acting("scripted_policies:nodding"))

        def stop_once_it_moves(sample: object) -> None:
            began.set()

        began = threading.Event()
        client = stack.enter_context(laboratory.join())
        client.subscribe(f"standin{POLICY_TARGETS}", stop_once_it_moves)

        def stop() -> None:
            began.wait(60.0)
            RecorderClient(client).stop({"result": "failure", "k": 0, "n": 1, "detail": "stop"})

        thread = threading.Thread(target=stop)
        thread.start()
        summary, episode = laboratory.trial(max_s=60.0)
        thread.join()
    assert summary["stopped"] is True
    assert runner.ended.stopped == "operator: the episode was ended"
    assert outcome_of(episode) == ("failure", "stop")
    assert streams.events(episode)[-1]["type"] in ("execution_ended", "label")


def test_the_cell_holds_without_a_fresh_target_and_then_stops(laboratory: Laboratory) -> None:
    """A runner that dies in the middle of a motion."""
    with laboratory.join() as session:
        topic = f"/standin{POLICY_TARGETS}"
        targets = session.publisher(topic, "sensor_msgs/msg/JointState", qos=Qos.CONTROL)
        ended = {"episode": "trial_0001", "stopped": "", "problem": "", "asked": 1}
        sent: list[int] = []

        def answer(payload: bytes) -> bytes:
            about = {"policy": "mine", "rate_hz": 2.0, "tags": [], "ended": ended}
            return json.dumps(about).encode()

        def on_joints(sample: Any) -> None:
            joints = JointSample.from_cdr(sample.data)
            if len(sent) < 5:
                goal = np.append(joints.position + 0.1 * np.eye(6)[0], 0.085)
                names, none = (*ARM_JOINTS, GRIPPER_WIDTH), np.zeros(0)
                target = JointSample(
                    stamp_ns=joints.stamp_ns, names=names, position=goal, velocity=none, effort=none
                )
                targets.put(target.to_cdr(), source_ns=joints.stamp_ns)
                sent.append(joints.stamp_ns)

        session.serve("standin/policy/mine", answer)
        session.subscribe("standin/joint_states", on_joints)
        _, episode = laboratory.trial(max_s=30.0)
    assert outcome_of(episode) == ("unknown", "watchdog: no fresh target for 1 s")
    track = streams.joint_track(episode)
    quiet = track.stamps_ns > sent[-1] + 450_000_000  # 0.2 s, and what a message takes
    assert 0.02 < np.ptp(track.position[:, 0]) < 0.1  # within the period of 0.5 s it was held
    assert np.ptp(track.position[quiet, 0]) < 0.005
