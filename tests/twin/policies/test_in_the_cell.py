"""A policy drives the stand-in cell over zenoh: real sessions, a real recorder, a real server."""

import json
import re
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from loopback import recording
from patience import wait_until
from test_openpi import Answer, pack, served

from bridge.episode import schema, streams
from bridge.episode.cdr.messages import JointSample
from bridge.episode.metadata import tagged
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.episode.topics import POLICY_TARGETS
from bridge.record.control import RecorderClient
from bridge.robots.default import ARM_JOINTS
from bridge.robots.robot import GRIPPER_WIDTH
from bridge.sources.standin.driven import HOLD_NS, STOP_NS
from bridge.sources.standin.session import run_session
from bridge.sources.standin.settings import SessionConfig
from bridge.sources.standin.streams import Streams
from bridge.terminal import Output
from bridge.wire.config import WireConfig
from bridge.wire.session import WireSession, open_session
from twin.policies import runner as running
from twin.policies.config import RolloutConfig
from twin.policies.runner import CellRunner

QUIET = Output(quiet=True)
NODDING = "scripted_policies:nodding"


class Laboratory(NamedTuple):
    """A recorder behind a router, and whoever joins."""

    run: RunFolder
    endpoint: str

    def join(self) -> WireSession:
        return open_session(WireConfig(connect=(self.endpoint,)))

    @contextmanager
    def acting(self, policy: str, **more: Any) -> Iterator[CellRunner]:
        about = {"name": "mine", "cell": "standin", "timeout_s": 1.0, **more}
        stop = threading.Event()
        with self.join() as session:
            runner = CellRunner(session, RolloutConfig(policy=policy, **about), QUIET)
            thread = threading.Thread(target=runner.run, args=(stop,))
            thread.start()
            try:
                yield runner
            finally:
                stop.set()
                thread.join()
                runner.close()

    def trial(self, max_s: float = 1.5) -> tuple[dict[str, Any], Episode, str, float]:
        """One start, driven by whoever acts: how it was labelled, and how far a joint moved."""
        number = 1 + len(list(self.run.episodes_dir.glob("trial_*.mcap")))
        config = SessionConfig(
            planner="policy", policy="mine", scan=False, trials=1, first_trial=number, max_s=max_s,
            conditions=("without_replanning",), image_scale=0.1,
        )  # fmt: skip
        with self.join() as session:
            summary = run_session(session, config, QUIET)
        path = self.run.episodes_dir / f"trial_{number:04d}.mcap"
        wait_until(path.is_file, f"{path.name} that somebody else may have ended", within_s=60.0)
        episode = Episode.open(path)
        assert episode.outcome is not None
        moved = float(np.ptp(streams.joint_track(episode).position, axis=0).max())
        return summary, episode, f"{episode.outcome.result}: {episode.outcome.detail}", moved


@pytest.fixture(scope="module")
def laboratory(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Laboratory]:
    run = RunFolder.create(tmp_path_factory.mktemp("laboratory") / "run")
    with recording(run) as endpoint:
        yield Laboratory(run, endpoint)


def test_what_a_policy_sends_moves_the_arm_and_says_who_acted(laboratory: Laboratory) -> None:
    with laboratory.acting(NODDING):
        _, episode, label, _ = laboratory.trial(max_s=3.0)
    assert label.startswith("failure: the middle of cube is ")
    assert episode.info.policy == "mine"
    assert tagged(episode.info.tags, "checkpoint:").startswith(f"code={NODDING} map=")
    assert len(tagged(episode.info.tags, "mapping:")) > 6
    began, ended = (e for e in streams.events(episode) if e["type"].startswith("execution"))
    assert began["data"]["prompt"] == "Put the red cube into the box."
    assert ended["data"]["asked"] > 0
    sent = streams.joint_track(episode, POLICY_TARGETS)
    assert sent.names == (*ARM_JOINTS, GRIPPER_WIDTH)
    pan, went = streams.joint_track(episode).position[:, 0], sent.position[:, 0]
    assert went.max() > went[0] + 0.1
    assert pan.max() == pytest.approx(went.max(), abs=0.06)  # the last one may not be reached


def test_a_policy_that_is_done_ends_its_trial_and_is_judged(laboratory: Laboratory) -> None:
    with laboratory.acting("scripted_policies:nodding_until_it_turned") as runner:
        _, episode, label, moved = laboratory.trial(max_s=60.0)
    assert label.startswith("failure: the middle of cube is ")
    assert runner.ended.done
    assert moved > 0.1
    assert np.ptp(streams.joint_track(episode).stamps_ns) < 30e9  # the cell's clock


def test_an_arm_that_is_pressed_too_hard_stops_and_its_trial_fails(laboratory: Laboratory) -> None:
    with laboratory.acting("scripted_policies:pressing"):
        _, episode, label, _ = laboratory.trial(max_s=30.0)
    assert re.match(r"failure: contact_force: .* with \d+ N, the limit is 150 N: the middle", label)
    (mark,) = (event for event in streams.events(episode) if event["type"] == "mark")
    assert mark["data"]["force_N"] > 150


def lasting(data: bytes) -> bytes:
    time.sleep(3.0)
    return data


def failing(_: bytes) -> bytes:
    raise ValueError("the server closes the connection")


def sending(*numbers: float) -> Callable[[bytes], bytes]:
    return lambda _: pack({"actions": np.array(numbers)})


BAD: list[tuple[Answer, str]] = [
    (lasting, "unknown: .* said nothing for 1 s"),
    (lambda _: "Traceback\nValueError: no such key", "unknown: .* ValueError: no such key"),
    (failing, "unknown: .* closed the connection"),
    (lambda _: bytes(65 << 20), "unknown: .* closed the connection"),
    (lambda _: pack({"actions": np.zeros((2, 2, 7))}), "unknown: .* have shape"),
    (sending(*[np.nan] * 7), "unknown: .* not finite"),
    (sending(*[0.0] * 8), "unknown: .* takes rows of 7"),  # of another arm
    (sending(*[9.0] * 7), "failure: limits: .* beyond its limits"),
    (sending(-15, -98, 78, -70, -90, 75, 0.08), "failure: limits: .* degrees = true"),
    (sending(*[0.0] * 7), "failure: limits: .* moves at"),  # too far for a tenth of a second
]


@pytest.mark.parametrize(("answer", "words"), BAD)
def test_a_bad_answer_moves_nothing_and_is_told(
    laboratory: Laboratory, answer: Answer, words: str
) -> None:
    with served(answer) as (address, _), laboratory.acting(address):
        _, _, label, moved = laboratory.trial(max_s=4.0)
    assert re.match(words, label)
    assert moved < 0.01


def test_a_camera_that_the_cell_lacks_is_named(
    laboratory: Laboratory, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(running, "READY_S", 3.0)
    mapping = tmp_path / "map.toml"
    mapping.write_text('[images.front]\ncamera = "front"\n')
    with laboratory.acting("scripted_policies:still", map=mapping):
        _, _, label, moved = laboratory.trial()
    assert "nothing came on /standin/cam/front/color/image in 3 s" in label
    assert "the cell shows /robot_description, " in label
    assert moved < 0.01


def test_a_gripper_of_which_nobody_speaks_is_not_taken_for_open(
    laboratory: Laboratory, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Streams, "gripper", lambda *_: None)
    with laboratory.acting(NODDING):
        _, _, label, moved = laboratory.trial()
    assert "nobody says the gripper's width [m] on a topic .../gripper/state" in label
    assert moved < 0.01


def test_the_operators_stop_ends_it(laboratory: Laboratory) -> None:
    def stop() -> None:
        began.wait(60.0)
        RecorderClient(client).stop({"result": "failure", "k": 0, "n": 1, "detail": "stop"})

    began, thread = threading.Event(), threading.Thread(target=stop)
    with laboratory.acting(NODDING) as runner, laboratory.join() as client:
        client.subscribe(f"standin{POLICY_TARGETS}", lambda _: began.set())
        thread.start()
        summary, _, label, _ = laboratory.trial(max_s=60.0)
        thread.join()
    assert (summary["stopped"], label) == (True, "failure: stop")
    assert runner.ended.stopped == "operator: the episode was ended"


def test_the_cell_holds_without_a_fresh_target_and_then_stops(laboratory: Laboratory) -> None:
    """A runner that dies in the middle of a motion; nobody at all before it."""
    ended = {"episode": "", "stopped": "", "problem": "", "asked": 1}
    about = {"policy": "mine", "rate_hz": 2.0, "tags": [], "ended": ended}
    sent, none = list[int](), np.zeros(0)

    def on_joints(sample: Any) -> None:
        if len(sent) < 5:
            joints = JointSample.from_cdr(sample.data)
            goal = np.append(joints.position + 0.1 * np.eye(6)[0], 0.085)
            names, sent[:] = (*ARM_JOINTS, GRIPPER_WIDTH), [*sent, joints.stamp_ns]
            told = {"stamp_ns": sent[-1], "names": names, "velocity": none, "effort": none}
            targets.put(JointSample(position=goal, **told).to_cdr(), source_ns=sent[-1])

    with laboratory.join() as session:
        targets = session.publisher(f"/standin{POLICY_TARGETS}", schema.JOINT_STATE)
        session.serve("standin/policy/mine", lambda _: json.dumps(about).encode())
        session.subscribe("standin/joint_states", on_joints)
        _, episode, label, moved = laboratory.trial(max_s=30.0)
    assert (HOLD_NS, STOP_NS) == (200_000_000, 1_000_000_000)  # as docs/policies.md says
    assert label == "unknown: watchdog: no fresh target for 1 s"
    track = streams.joint_track(episode)
    quiet = track.stamps_ns > sent[-1] + HOLD_NS + 250_000_000  # which a message may take
    assert 0.02 < moved < 0.1  # within the period of 0.5 s it was held
    assert np.ptp(track.position[quiet, 0]) < 0.005
