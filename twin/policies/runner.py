"""Let a policy act in a cell, over zenoh: observations in, targets out at a fixed rate.

Whoever starts a trial of the policy at the recorder lets it begin (``ctl start --policy NAME``),
and whoever ends the episode stops it. Nothing is sent that a limit of the robot refuses.
"""

import json
import queue
import threading
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, UInt8

from bridge.episode.cdr.messages import JointSample, color_from_message, string_from_cdr
from bridge.episode.provenance import hash_settings
from bridge.episode.topics import (
    CAMERAS,
    COLOR_IMAGE,
    COLOR_TOPIC,
    EVENT,
    GRIPPER_STATE,
    JOINT_STATES,
    POLICY_TARGETS,
    ROBOT_DESCRIPTION,
    STOPPED_BY_OPERATOR,
    cell_topic,
    policy_key,
    refuse_bad_name,
    type_of_topic,
)
from bridge.errors import GstError
from bridge.record.control import RecorderClient
from bridge.robots.robot import GRIPPER_WIDTH
from bridge.terminal import Output, stop_signals
from bridge.wire.config import WireConfig
from bridge.wire.qos import Qos
from bridge.wire.session import WireSample, WireSession, open_session
from twin.policies.config import RolloutConfig
from twin.policies.errors import PolicyError, StoppedError
from twin.policies.limits import Knot, refuse_target
from twin.policies.mapping import Interpreter, is_end, read_mapping
from twin.policies.policy import open_policy, who_acts
from twin.robot.model import RobotModel, load_robot
from twin.robot.posture import width_in

HOLD_S, STOP_S = 0.2, 1.0
"""Without a fresh observation for so long the arm is held, and the trial stopped."""
READY_S = 30.0
"""A cell that shows itself shows all of it within this time."""
POLL_S = 0.2
"""How often the recorder is asked whether the trial still goes on."""
LOOK_NS = 1_000_000_000
"""The start is seen at rest for so long before anything moves."""
LEAVE_S = 2.0


class Begun(NamedTuple):
    """A trial that somebody started."""

    episode: str
    instruction: str
    seed: int
    over: threading.Event
    """Somebody has ended it."""
    left: threading.Event
    """Nothing is sent any more."""


class _Seen(NamedTuple):
    sample: WireSample
    stamp_ns: int
    """The cell's clock."""
    received_s: float
    every_s: float
    """Since the one before."""


@dataclass
class Ended:
    """What became of a trial, as the cell is told that asks."""

    episode: str = ""
    stopped: str = ""
    """The limit or the person who stopped it; empty: it goes on, or the cell ended it."""
    problem: str = ""
    """Why the trial says nothing of the policy; empty: it does."""
    done: bool = False
    """The policy wants nothing more."""
    asked: int = 0


@dataclass
class View:
    """The newest of all that a cell publishes."""

    seen: dict[str, _Seen] = field(default_factory=dict)
    """By topic."""
    news: threading.Condition = field(default_factory=threading.Condition)

    def take(self, sample: WireSample) -> None:
        """Keep a sample; on the network thread."""
        with self.news:
            before = self.seen.get(sample.topic)
            stamp_ns = sample.received_ns if sample.source_ns is None else sample.source_ns
            every_s = 0.0 if before is None else (stamp_ns - before.stamp_ns) * 1e-9
            self.seen[sample.topic] = _Seen(sample, stamp_ns, time.monotonic(), every_s)
            self.news.notify_all()

    def forget(self) -> None:
        """Begin anew; the robot stays who it is."""
        with self.news:
            for topic in set(self.seen) - {ROBOT_DESCRIPTION}:
                del self.seen[topic]


class CellRunner:
    """Serves one policy to one cell until it is closed."""

    def __init__(self, session: WireSession, config: RolloutConfig, output: Output) -> None:
        """Open the policy and answer for it; nothing moves before a trial begins."""
        self.session, self.cell, self.output = session, config.cell, output
        self.config = config
        self.mapping = read_mapping(config.map)
        self.name = config.name or config.policy
        self.recorder = RecorderClient(session, timeout_s=5.0)
        self.ended = Ended()
        self._begun: queue.SimpleQueue[Begun] = queue.SimpleQueue()
        self._last = Begun("", "", 0, threading.Event(), threading.Event())
        self.policy = open_policy(config.policy, config.timeout_s)
        self.view = View()
        for ending in (JOINT_STATES, GRIPPER_STATE, f"{CAMERAS}*{COLOR_IMAGE}"):
            session.follow(cell_topic(self.cell, ending), self.view.take)
        session.follow(ROBOT_DESCRIPTION, self.view.take)
        self.targets = self._publisher(POLICY_TARGETS, Qos.CONTROL)
        self.events = self._publisher(EVENT, Qos.RELIABLE)
        session.serve(policy_key(self.cell, self.name), self._answer)

    def _publisher(self, ending: str, qos: Qos) -> Any:
        topic = cell_topic(self.cell, ending)
        return self.session.publisher(topic, type_of_topic(topic) or "", qos=qos)

    def identity(self) -> dict[str, Any]:
        """Who acts: of the episode's metadata."""
        about, prompt = self.policy.metadata, self.mapping.prompt
        tags = [
            f"checkpoint:{who_acts(self.config.policy, self.mapping, about)}",
            f"mapping:{self.mapping.sha256()}",
        ]
        tags += [f"prompt:{prompt}"] if prompt else []
        tags += [f"server:{hash_settings(dict(about))}"] if about else []
        return {"policy": self.name, "rate_hz": self.mapping.rate_hz, "tags": tags}

    def _answer(self, payload: bytes) -> bytes:
        """Say who acts; with an episode, begin in it."""
        try:
            request = dict(json.loads(payload or b"{}"))
        except (ValueError, TypeError) as error:
            raise PolicyError(f"{policy_key(self.cell, self.name)} takes JSON: {error}") from error
        if request.get("policy", self.name) != self.name:
            raise PolicyError(f"policy {self.name!r} acts here, not {request['policy']!r}")
        if request.get("episode"):
            text, seed = str(request.get("instruction") or ""), int(request.get("start_seed") or 0)
            self._last.over.set()
            self.ended = Ended(episode=str(request["episode"]))
            over, left = threading.Event(), threading.Event()
            self._last = Begun(self.ended.episode, text, seed, over, left)
            self._begun.put(self._last)
        elif request.get("over") == self.ended.episode:
            if request.get("by") != "cell" and not self._last.over.is_set():
                self.ended.stopped = self.ended.stopped or STOPPED_BY_OPERATOR
            self._last.over.set()
            self._last.left.wait(LEAVE_S)
        answer = {**self.identity(), "ended": vars(self.ended)}
        return json.dumps(answer).encode()

    def run(self, stop: threading.Event) -> int:
        """Act in every trial that begins, until told to stop; how many there were."""
        count = 0
        while not stop.is_set():
            try:
                begun = self._begun.get(timeout=POLL_S)
            except queue.Empty:
                continue
            if begun.episode == self.ended.episode:
                count += 1
                self._try(begun, self.ended, stop)
        return count

    def _try(self, begun: Begun, ended: Ended, stop: threading.Event) -> None:
        asking = threading.Event()
        watch = threading.Thread(target=self._watch, args=(ended, asking), daemon=True)
        watch.start()
        try:
            over = begun.over.is_set
            Trial(self, begun, ended, lambda: stop.is_set() or over() or bool(ended.stopped)).act()
        except GstError as error:
            ended.problem = str(error)
        finally:
            begun.left.set()
            asking.set()
            watch.join()
        told = ended.problem or ended.stopped or "ended"
        self.output.say(f"{begun.episode}: {told} after {ended.asked} answers")

    def _watch(self, ended: Ended, done: threading.Event) -> None:
        """Stop with the episode: the operator's stop, whoever gives it."""
        while not done.wait(POLL_S):
            try:
                now = self.recorder.status()["episode"]
            except (GstError, KeyError) as error:
                ended.stopped = f"recorder: it does not answer ({error})"
                return
            if now != ended.episode:
                ended.stopped = ended.stopped or STOPPED_BY_OPERATOR
                return

    def close(self) -> None:
        """Let the policy go."""
        self.policy.close()


class Trial:
    """One trial, from its begin to its end."""

    def __init__(
        self, runner: CellRunner, begun: Begun, ended: Ended, over: Callable[[], bool]
    ) -> None:
        """Take over what the runner has; ``over`` says when to send no more."""
        self._runner, self._begun, self._ended, self._over = runner, begun, ended, over
        self._view, self._policy, self._cell = runner.view, runner.policy, runner.cell
        self._view.forget()

    def act(self) -> None:
        """Ask and follow until it is over; the arm is held while the policy thinks."""
        robot = self._robot()
        speak = Interpreter(self._runner.mapping, robot, self._begun.instruction)
        self._cameras(speak)  # waits for those that are named
        if not self._wait_until(self._now_ns() + LOOK_NS, READY_S):
            return
        cameras = self._cameras(speak)
        joints_rad, width_m = self._posture(robot)
        knots: list[Knot] = [(self._now_ns(), joints_rad)]
        self._policy.reset(self._begun.seed)
        self._tell("execution_started", self._runner.identity() | self._about())
        with ThreadPoolExecutor(1) as pool:  # which waits for the policy's last answer
            try:
                self._loop(robot, speak, cameras, knots, width_m, pool)
            except StoppedError as error:
                self._ended.stopped = str(error)
            except GstError as error:
                self._ended.problem = str(error)
            finally:
                self._tell("execution_ended", vars(self._ended))
                self._begun.left.set()

    def _loop(
        self,
        robot: RobotModel,
        speak: Interpreter,
        cameras: Mapping[str, str],
        knots: list[Knot],
        width_m: float,
        pool: ThreadPoolExecutor,
    ) -> None:
        rows = rest = np.zeros((0, speak.num_values()))
        thinking: Future[np.ndarray | None] | None = None
        due_ns, period_s = knots[0][0], 1.0 / speak.mapping.rate_hz
        period_ns = round(period_s * 1e9)
        while self._wait_until(due_ns):
            fresh = self._is_fresh(cameras.values())
            if not len(rows) and thinking is None and fresh:
                told = speak.observation(self._pictures(cameras), *self._posture(robot))
                thinking = pool.submit(self._asked, speak, told)
                wait((thinking,), timeout=period_s / 2)  # a quick one answers in time
            if thinking is not None and thinking.done():
                answer, thinking = thinking.result(), None
                if answer is None:
                    self._ended.done = True
                    return
                self._ended.asked += 1
                horizon = speak.mapping.horizon or len(answer)
                rows, rest = answer[:horizon], answer[horizon:]
            joints_rad = knots[-1][1]
            if len(rows) and fresh:
                joints_rad, width_m = speak.target(rows[0], joints_rad, width_m)
                rows = rows[1:]
            elif len(rest) and thinking is not None and fresh:
                joints_rad, width_m = speak.target(rest[0], joints_rad, width_m)
                rest = rest[1:]
            refuse_target(robot, knots, joints_rad, width_m, period_s)
            knots[:] = [*knots[-1:], (knots[-1][0] + period_ns, joints_rad)]
            self._send(robot, joints_rad, width_m)
            due_ns = max(due_ns, self._now_ns() - period_ns // 2) + period_ns

    def _asked(self, speak: Interpreter, told: dict[str, Any]) -> np.ndarray | None:
        answer = self._policy.infer(told)
        return None if is_end(answer) else speak.rows(answer)

    def _send(
        self, robot: RobotModel, joints_rad: Float[np.ndarray, " num_joints"], width_m: float
    ) -> None:
        nothing, stamp_ns = np.zeros(0), self._now_ns()
        sample = JointSample(
            stamp_ns=stamp_ns,
            names=(*robot.joints, GRIPPER_WIDTH),
            position=np.append(joints_rad, width_m),
            velocity=nothing,
            effort=nothing,
        )
        self._runner.targets.put(sample.to_cdr(), source_ns=stamp_ns)

    def _newest(self, ending: str) -> _Seen:
        return self._view.seen[cell_topic(self._cell, ending)]

    def _now_ns(self) -> int:
        return self._newest(JOINT_STATES).stamp_ns

    def _wait_until(self, due_ns: int, silent_s: float = STOP_S) -> bool:
        """Wait until the cell's clock is there; False: it is over.

        Raises:
            PolicyError: The cell shows nothing any more.
        """
        with self._view.news:
            while not self._over():
                newest = self._newest(JOINT_STATES)
                if newest.stamp_ns >= due_ns:
                    return True
                if time.monotonic() - newest.received_s > silent_s:
                    raise PolicyError(f"stopped: no joint states of the cell for {silent_s:g} s")
                self._view.news.wait(HOLD_S / 4)
        return False

    def _is_fresh(self, topics: Any) -> bool:
        """Whether what the policy would see is of now; pictures are as old as they come.

        Raises:
            PolicyError: A camera shows nothing any more.
        """
        for topic in topics:
            seen = self._view.seen[topic]
            late_s = (self._now_ns() - seen.stamp_ns) * 1e-9 - max(seen.every_s, 0.0)
            if late_s > STOP_S:
                raise PolicyError(f"stopped: no picture on {topic} for {STOP_S:g} s")
            if late_s > HOLD_S:
                return False
        return True

    def _robot(self) -> RobotModel:
        description = self._expected(ROBOT_DESCRIPTION)
        self._expected(cell_topic(self._cell, JOINT_STATES))
        return load_robot(string_from_cdr(description.sample.data))

    def _expected(self, topic: str) -> _Seen:
        """Wait for what was never seen."""
        began_s = time.monotonic()
        with self._view.news:
            while topic not in self._view.seen:
                waited_s = min(time.monotonic() - began_s, READY_S)
                if self._over() or waited_s == READY_S:
                    there = ", ".join(sorted(self._view.seen)) or "nothing"
                    what = f"nothing came on {topic} in {waited_s:.0f} s"
                    raise PolicyError(f"{what}; the cell shows {there}")
                self._view.news.wait(HOLD_S)
            return self._view.seen[topic]

    def _cameras(self, speak: Interpreter) -> dict[str, str]:
        """Topics by camera."""
        wanted = speak.cameras()
        for name in wanted:
            self._expected(f"/{self._cell}{CAMERAS}{name}{COLOR_IMAGE}")
        there = (COLOR_TOPIC.search(topic) for topic in list(self._view.seen))
        names = wanted or tuple(sorted(found[1] for found in there if found))
        return {name: f"/{self._cell}{CAMERAS}{name}{COLOR_IMAGE}" for name in names}

    def _pictures(self, cameras: Mapping[str, str]) -> dict[str, UInt8[np.ndarray, "h w 3"]]:
        return {
            name: color_from_message(seen.type_name, seen.data).image_u8()
            for name, seen in (
                (name, self._view.seen[topic].sample) for name, topic in cameras.items()
            )
        }

    def _posture(self, robot: RobotModel) -> tuple[Float[np.ndarray, " num_joints"], float]:
        sample = JointSample.from_cdr(self._newest(JOINT_STATES).sample.data)
        missing = [name for name in robot.joints if name not in sample.names]
        if missing:
            raise PolicyError(f"the cell's joint states lack {', '.join(missing)}")
        joints_rad = sample.position[[sample.names.index(name) for name in robot.joints]]
        gripper = self._view.seen.get(cell_topic(self._cell, GRIPPER_STATE))
        if gripper is not None:
            return joints_rad, float(JointSample.from_cdr(gripper.sample.data).position[0])
        widths_m = width_in(sample.names, sample.position[None], robot.record)
        if widths_m is None:
            raise PolicyError(f"nobody says the gripper's width [m] on a topic ...{GRIPPER_STATE}")
        return joints_rad, float(widths_m[0])

    def _about(self) -> dict[str, Any]:
        """What does not fit into tags."""
        about = json.loads(json.dumps(dict(self._policy.metadata), default=str))
        prompt = self._runner.mapping.prompt or self._begun.instruction
        return {"prompt": prompt, "server": about}

    def _tell(self, kind: str, data: Mapping[str, Any]) -> None:
        stamp_ns = self._now_ns()
        record = {"schema_version": 1, "stamp_ns": stamp_ns, "type": kind, "data": dict(data)}
        self._runner.events.put(json.dumps(record).encode(), source_ns=stamp_ns)


def serve_cell(config: RolloutConfig, output: Output) -> int:
    """Let a policy act in a cell until SIGINT or SIGTERM; how many trials there were."""
    refuse_bad_name("cell", config.cell)
    with stop_signals() as stop, open_session(WireConfig(connect=config.connect)) as session:
        runner = CellRunner(session, config, output)
        try:
            output.say(f"policy ready: {config.name or config.policy} in cell {config.cell}")
            return runner.run(stop)
        finally:
            runner.close()
