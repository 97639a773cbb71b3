"""Turns the samples of a UR arm into messages and publishes them, numbered by the robot's time."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from bridge.clock import NS_PER_S
from bridge.episode import schema
from bridge.sources.announcer import Announcer
from bridge.sources.host_clock import HostClock
from bridge.sources.numbered import NumberedPublisher
from bridge.sources.ur import messages
from bridge.sources.ur.client import Sample, Wish
from bridge.sources.ur.config import UrConfig
from bridge.wire.qos import Qos
from bridge.wire.session import WireSession

Vector = Float[np.ndarray, " count"]
SLOW_HZ = 125.0
"""The gripper and the transform of the tool change slowly enough for this rate."""
LONGEST_GAP_S = 3600.0
"""A longer jump of the robot's clock is a clock that was set, not lost samples."""
SPEED_STEP = 0.01
"""A change of the speed scaling worth a message; without one there is a message each second."""

REQUIRED = ("actual_q", "actual_qd")
FAST: dict[str, tuple[str, str, Callable[[Vector, int], bytes]]] = {
    "target_q": (
        "joint_targets",
        schema.JOINT_STATE,
        lambda q, stamp_ns: messages.joints_cdr(q, q[:0], stamp_ns),
    ),
    "actual_TCP_pose": (
        "tcp/pose",
        schema.POSE_STAMPED,
        lambda pose, stamp_ns: messages.tcp_cdr(messages.T_base_link_tcp(pose), stamp_ns),
    ),
    "actual_TCP_force": ("tcp/wrench", schema.WRENCH_STAMPED, messages.wrench_cdr),
}
"""Variables published with every sample: topic, type, how it is serialised."""
OPTIONAL = (*FAST, "speed_scaling", "robot_mode", "safety_mode")


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
        self._cell = config.cell
        self._announcer = announcer
        self._gripper = config.make_gripper()
        self._streams: dict[str, NumberedPublisher] = {}
        self._clock = HostClock()
        self._rate_hz = SLOW_HZ
        self._last_s: float | None = None
        self._number = 0
        self._slow_number = -1
        self._modes: tuple[int | None, int | None] | None = None
        self._speed = 0.0
        self._speed_said_ns = -NS_PER_S
        self._said = 0

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
        joints = self._streams.get("joint_states")
        return {
            "samples": joints.sent if joints else 0,
            "lost": joints.lost if joints else 0,
        }

    def _count(self, robot_s: float) -> int:
        """Number the sample by the robot's clock: what it left out becomes a gap."""
        last_s, self._last_s = self._last_s, robot_s
        steps = 1
        if last_s is not None and last_s < robot_s < last_s + LONGEST_GAP_S:
            steps = max(1, round((robot_s - last_s) * self._rate_hz))
        self._number += steps
        return steps - 1

    def _every_sample(self, sample: Sample, stamp_ns: int) -> None:
        q, qd = (messages.vector(sample.values, name) for name in REQUIRED)
        data = messages.joints_cdr(q, qd, stamp_ns)
        self._put("joint_states", schema.JOINT_STATE, data, stamp_ns, self._number)
        for variable, (topic, type_name, serialise) in FAST.items():
            if variable in sample.values:
                data = serialise(messages.vector(sample.values, variable), stamp_ns)
                self._put(topic, type_name, data, stamp_ns, self._number)

    def _slowly(self, sample: Sample, stamp_ns: int) -> None:
        number = self._slow_number
        if self._gripper is not None:
            width_m = self._gripper.width_m(sample.values)
            data = messages.number_cdr(messages.GRIPPER_JOINT, width_m, stamp_ns)
            self._put("gripper/state", schema.JOINT_STATE, data, stamp_ns, number)
        if "actual_TCP_pose" in sample.values:
            T = messages.T_base_link_tcp(messages.vector(sample.values, "actual_TCP_pose"))
            data = messages.tcp_frame_cdr(T, stamp_ns)
            self._put("/tf", schema.TF_MESSAGE, data, stamp_ns, number)

    def _on_change(self, sample: Sample, stamp_ns: int) -> None:
        values = sample.values
        modes = values.get("robot_mode"), values.get("safety_mode")
        if modes != self._modes and modes != (None, None):
            self._modes = modes  # type: ignore[assignment]
            self._announcer.event(messages.mode_event(self._cell, *modes, stamp_ns))  # type: ignore[arg-type]
        if "speed_scaling" not in values:
            return
        speed = float(values["speed_scaling"])  # type: ignore[arg-type]
        changed = abs(speed - self._speed) >= SPEED_STEP
        if changed or stamp_ns - self._speed_said_ns >= NS_PER_S:
            self._speed, self._speed_said_ns = speed, stamp_ns
            data = messages.number_cdr(messages.SPEED_NAME, speed, stamp_ns)
            self._said += 1
            self._put("speed_scaling", schema.JOINT_STATE, data, stamp_ns, self._said)

    def _put(self, topic: str, type_name: str, data: bytes, stamp_ns: int, number: int) -> None:
        stream = self._streams.get(topic)
        if stream is None:
            full = topic if topic.startswith("/") else f"/{self._cell}/{topic}"
            publisher = self._session.publisher(full, type_name, qos=Qos.CONTROL)
            stream = self._streams[topic] = NumberedPublisher(publisher)
        stream.put(number, data, source_ns=stamp_ns)
