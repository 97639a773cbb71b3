"""Publishes a UR arm: reads its controller for as long as it takes, and comes back to it."""

import threading
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, cast

from bridge.clock import NS_PER_S
from bridge.episode import schema
from bridge.episode.cdr.batch import Write, joint_writer, pose_writer
from bridge.episode.cdr.messages import string_to_cdr
from bridge.episode.schema import StampedMessage
from bridge.episode.topics import (
    GRIPPER_STATE,
    JOINT_STATES,
    JOINT_TARGETS,
    ROBOT_DESCRIPTION,
    SPEED_SCALING,
    TCP_POSE,
    TCP_WRENCH,
    TF,
    cell_topic,
)
from bridge.errors import UsageError
from bridge.robots.robot import DEFAULT_ROBOT, GRIPPER_WIDTH, Robot, read_robot, robot_of
from bridge.sources.device_samples import Announcer, HostClock, NumberedPublisher
from bridge.sources.ur import messages
from bridge.sources.ur.config import ControllerError, UrConfig
from bridge.sources.ur.rtde import RtdeClient, Sample, Wish
from bridge.terminal import Output
from bridge.wire.clocks import announce
from bridge.wire.qos import Qos
from bridge.wire.session import WireSession

SLOW_HZ = 125.0
"""The gripper and the transform of the tool change slowly enough for this rate."""
LONGEST_GAP_S = 3600.0
"""A longer jump of the robot's clock is a clock that was set, not lost samples."""
SPEED_STEP = 0.01
"""A change of the speed scaling worth a message; without one there is a message each second."""

REQUIRED = ("actual_q", "actual_qd")
OPTIONAL = (
    "target_q",
    "actual_TCP_pose",
    "actual_TCP_force",
    "speed_scaling",
    "robot_mode",
    "safety_mode",
)


class _Topic(NamedTuple):
    name: str
    type_name: str
    write: Write


BARE_UR5 = "ur5"
"""What --robot calls the default robot's arm without its gripper."""
NUM_JOINTS = 6


class ArmPublisher:
    """Publishes one arm over any number of connections to its controller."""

    def __init__(
        self, session: WireSession, config: UrConfig, announcer: Announcer, robot: Robot
    ) -> None:
        """Announce nothing yet: the topics follow from what the controller knows."""
        self._session = session
        self._cell = cell = config.cell
        self._announcer = announcer
        self._gripper = config.make_gripper()
        state = schema.JOINT_STATE
        base = robot.base_frame
        targets = joint_writer(robot.joints)
        speed = joint_writer((messages.SPEED_NAME,))
        joints = joint_writer(robot.joints, velocities=True)
        self._joints = _Topic(cell_topic(cell, JOINT_STATES), state, joints)
        self._targets = _Topic(cell_topic(cell, JOINT_TARGETS), state, targets)
        self._pose = _Topic(cell_topic(cell, TCP_POSE), schema.POSE_STAMPED, pose_writer(base))
        self._wrench = _Topic(
            cell_topic(cell, TCP_WRENCH), schema.WRENCH_STAMPED, messages.wrench_writer(base)
        )
        self._width = _Topic(cell_topic(cell, GRIPPER_STATE), state, joint_writer((GRIPPER_WIDTH,)))
        self._frame = _Topic(TF, schema.TF_MESSAGE, messages.frame_writer(base))
        self._speed = _Topic(cell_topic(cell, SPEED_SCALING), state, speed)
        self._streams: dict[str, NumberedPublisher] = {}
        self._clock = HostClock()
        self.rate_hz = SLOW_HZ
        """Samples a second that the connection brings."""
        self._last_s: float | None = None
        self._number = 0
        self._slow_number = -1
        self._modes: tuple[int | None, int | None] = (None, None)
        self._said_speed = (0.0, -NS_PER_S, 0)

    def put(self, sample: Sample) -> int:
        """Publish one sample; return how many are missing directly before it."""
        missing = self._count(sample.robot_s)
        try:
            stamp_ns = self._clock.map(round(sample.robot_s * NS_PER_S), sample.received_ns)
        except ValueError:  # the controller was started again
            self._clock = HostClock()
            return 0
        if stamp_ns is None:
            return 0
        self._every_sample(sample, stamp_ns)
        slow_number = self._number // max(1, round(self.rate_hz / SLOW_HZ))
        if slow_number != self._slow_number:
            self._slow_number = slow_number
            self._slowly(sample, stamp_ns)
        self._on_change(sample, stamp_ns)
        return missing

    def counts(self) -> dict[str, int]:
        """Samples sent, and lost before they got here."""
        joints = self._streams.get(self._joints.name)
        return {"samples": joints.sent if joints else 0, "lost": joints.lost if joints else 0}

    def _count(self, robot_s: float) -> int:
        """Number the sample by the robot's clock: what it left out becomes a gap."""
        last_s, self._last_s = self._last_s, robot_s
        steps = 1
        if last_s is not None and last_s < robot_s < last_s + LONGEST_GAP_S:
            steps = max(1, round((robot_s - last_s) * self.rate_hz))
        self._number += steps
        return steps - 1

    def _every_sample(self, sample: Sample, stamp_ns: int) -> None:
        values, number = sample.values, self._number
        joints = (*_vector(values["actual_q"]), *_vector(values["actual_qd"]))
        self._put(self._joints, joints, stamp_ns, number)
        if "target_q" in values:
            self._put(self._targets, _vector(values["target_q"]), stamp_ns, number)
        if "actual_TCP_pose" in values:
            pose = messages.tool_pose(_vector(values["actual_TCP_pose"]))
            self._put(self._pose, pose, stamp_ns, number)
        if "actual_TCP_force" in values:
            wrench = messages.tool_wrench(_vector(values["actual_TCP_force"]))
            self._put(self._wrench, wrench, stamp_ns, number)

    def _slowly(self, sample: Sample, stamp_ns: int) -> None:
        number = self._slow_number
        if self._gripper is not None:
            width_m = self._gripper.width_m(sample.values)
            self._put(self._width, (width_m,), stamp_ns, number)
        if "actual_TCP_pose" in sample.values:
            pose = messages.tool_pose(_vector(sample.values["actual_TCP_pose"]))
            self._put(self._frame, pose, stamp_ns, number)

    def _on_change(self, sample: Sample, stamp_ns: int) -> None:
        values = sample.values
        modes = cast(
            "tuple[int | None, int | None]", (values.get("robot_mode"), values.get("safety_mode"))
        )
        if modes != self._modes:
            self._modes = modes
            self._announcer.event(messages.mode_event(self._cell, *modes, stamp_ns))
        if "speed_scaling" in values:
            speed = cast("float", values["speed_scaling"])
            last, said_ns, number = self._said_speed
            if abs(speed - last) >= SPEED_STEP or stamp_ns - said_ns >= NS_PER_S:
                self._said_speed = (speed, stamp_ns, number + 1)
                self._put(self._speed, (speed,), stamp_ns, number)

    def _put(self, topic: _Topic, numbers: Sequence[float], stamp_ns: int, number: int) -> None:
        stream = self._streams.get(topic.name)
        if stream is None:
            publisher = self._session.publisher(topic.name, topic.type_name, qos=Qos.of(topic.name))
            stream = self._streams[topic.name] = NumberedPublisher(publisher)
        stream.put(number, topic.write(stamp_ns, numbers), source_ns=stamp_ns)


def _vector(value: object) -> tuple[float, ...]:
    return cast("tuple[float, ...]", value)


RETRY_S = 1.0


@dataclass(frozen=True)
class UrSource:
    """An arm as a ``bridge.sources.source.Source``."""

    host: str
    """Name or address of the controller."""
    config: UrConfig
    """What is read, and how it is named."""

    def run(self, session: WireSession, stop: threading.Event, output: Output) -> dict[str, Any]:
        """Publish until stopped.

        Returns:
            Samples sent, samples that did not reach us, and connections made.
        """
        host, config = self.host, self.config
        urdf = read_urdf(config)
        robot = robot_of(urdf or "")
        if len(robot.joints) != NUM_JOINTS:
            raise UsageError(
                f"--robot {robot.name} has {len(robot.joints)} joints; a UR controller moves "
                f"{NUM_JOINTS}."
            )
        client: RtdeClient | None = _connect(session, host, config, output)
        announce(session, config.cell)
        announcer = Announcer(session)
        if urdf is not None:
            description = StampedMessage(
                topic=ROBOT_DESCRIPTION,
                type_name=schema.STRING,
                data=string_to_cdr(urdf),
                stamp_ns=session.now_ns(),
            )
            announcer.fact("urdf", description)
        arm = ArmPublisher(session, config, announcer, robot)
        connections = 1
        try:
            while client is not None:
                arm.rate_hz = client.rate_hz
                _read(client, arm, stop=stop, output=output)
                client = _connect_again(session, host, config, stop=stop)
                if client is not None:
                    connections += 1
                    output.say(f"{host}: the controller is back")
        finally:
            announcer.close()
        if announcer.failure is not None:
            raise announcer.failure
        return {**arm.counts(), "connections": connections}


def read_urdf(config: UrConfig) -> str | None:
    """The robot's description: that of a robot file, or none."""
    if config.robot == "none":
        return None
    if config.robot == BARE_UR5:
        return read_robot(DEFAULT_ROBOT).arm_urdf()
    return read_robot(config.robot).description()


def _connect(session: WireSession, host: str, config: UrConfig, output: Output) -> RtdeClient:
    def on_text(text: str) -> None:
        output.detail(f"{host} says: {text}")

    gripper = config.make_gripper()
    needed = () if gripper is None else (gripper.signal.variable,)
    wish = Wish(required=(*REQUIRED, *needed), optional=OPTIONAL, rate_hz=config.rate_hz)
    client = RtdeClient(host, config.port, wish, now_ns=session.now_ns, on_text=on_text)
    version = ".".join(map(str, client.version))
    output.say(f"{host}: controller {version}, {client.rate_hz:g} samples a second")
    if client.missing:
        output.say(f"{host}: the controller does not know {', '.join(client.missing)}; left out")
    return client


def _connect_again(
    session: WireSession, host: str, config: UrConfig, *, stop: threading.Event
) -> RtdeClient | None:
    """Try until the controller is back or everything is stopped."""
    quiet = Output(quiet=True)
    while not stop.wait(RETRY_S):
        try:
            return _connect(session, host, config, quiet)
        except ControllerError:
            continue
    return None


def _read(client: RtdeClient, arm: ArmPublisher, *, stop: threading.Event, output: Output) -> None:
    """Publish what one connection brings, until it ends."""
    try:
        for sample in client.samples():
            missing = arm.put(sample)
            if missing:
                output.detail(f"{missing} samples missing at {sample.robot_s:.3f} s of the robot")
            if stop.is_set():
                return
    except ControllerError as error:
        output.say(f"{error} Trying again every second.")
    finally:
        client.close()
