"""Turns the samples of a UR arm into messages and publishes them, numbered by the robot's time."""

from collections.abc import Sequence
from typing import NamedTuple, cast

from bridge.clock import NS_PER_S
from bridge.episode import schema
from bridge.sources.announcer import Announcer
from bridge.sources.host_clock import HostClock
from bridge.sources.numbered import NumberedPublisher
from bridge.sources.ur import messages
from bridge.sources.ur.client import Sample, Wish
from bridge.sources.ur.config import UrConfig
from bridge.sources.ur.template import MessageTemplate
from bridge.task.robot import ARM_JOINTS
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
    template: MessageTemplate


def wish_of(config: UrConfig) -> Wish:
    """What the controller is asked for."""
    gripper = config.make_gripper()
    needed = () if gripper is None else (gripper.signal.variable,)
    return Wish(required=(*REQUIRED, *needed), optional=OPTIONAL, rate_hz=config.rate_hz)


class ArmPublisher:
    """Publishes one arm over any number of connections to its controller."""

    def __init__(self, session: WireSession, config: UrConfig, announcer: Announcer) -> None:
        """Announce nothing yet: the topics follow from what the controller knows."""
        self._session = session
        self._cell = cell = config.cell
        self._announcer = announcer
        self._gripper = config.make_gripper()
        state = schema.JOINT_STATE
        targets = messages.joints_template(ARM_JOINTS, velocities=False)
        width = messages.joints_template((messages.GRIPPER_JOINT,), velocities=False)
        speed = messages.joints_template((messages.SPEED_NAME,), velocities=False)
        self._joints = _Topic(f"/{cell}/joint_states", state, messages.arm_template())
        self._targets = _Topic(f"/{cell}/joint_targets", state, targets)
        self._pose = _Topic(f"/{cell}/tcp/pose", schema.POSE_STAMPED, messages.pose_template())
        self._wrench = _Topic(
            f"/{cell}/tcp/wrench", schema.WRENCH_STAMPED, messages.wrench_template()
        )
        self._width = _Topic(f"/{cell}/gripper/state", state, width)
        self._frame = _Topic("/tf", schema.TF_MESSAGE, messages.frame_template())
        self._speed = _Topic(f"/{cell}/speed_scaling", state, speed)
        self._streams: dict[str, NumberedPublisher] = {}
        self._clock = HostClock()
        self._rate_hz = SLOW_HZ
        self._last_s: float | None = None
        self._number = 0
        self._slow_number = -1
        self._modes: tuple[int | None, int | None] = (None, None)
        self._said_speed = (0.0, -NS_PER_S, 0)

    def begin(self, rate_hz: float) -> None:
        """Say how many samples a second the connection that follows brings."""
        self._rate_hz = rate_hz

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
        slow_number = self._number // max(1, round(self._rate_hz / SLOW_HZ))
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
            steps = max(1, round((robot_s - last_s) * self._rate_hz))
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
            publisher = self._session.publisher(topic.name, topic.type_name, qos=Qos.CONTROL)
            stream = self._streams[topic.name] = NumberedPublisher(publisher)
        stream.put(number, topic.template.fill(stamp_ns, numbers), source_ns=stamp_ns)


def _vector(value: object) -> tuple[float, ...]:
    return cast("tuple[float, ...]", value)
