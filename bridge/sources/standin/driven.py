"""Follow the targets that a policy's runner sends, as a robot's controller does: the fresh ones."""

import json
import time
from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np

from bridge.clock import ns_from_s
from bridge.episode.cdr.codec import MalformedMessageError
from bridge.episode.cdr.messages import JointSample
from bridge.episode.topics import POLICY_TARGETS, cell_topic, policy_key
from bridge.errors import BridgeError
from bridge.robots.default import ARM_JOINTS, MAX_WIDTH_M, ROBOT
from bridge.robots.robot import GRIPPER_WIDTH
from bridge.sources.standin.cell import TICK_NS, StandinCell
from bridge.sources.standin.streams import Session
from bridge.task.causes import Cause
from bridge.task.predicate import all_hold, evaluate_success

HOLD_NS, STOP_NS = ns_from_s(0.2), ns_from_s(1.0)
"""Without a fresh target for so long the arm is held, and the trial stopped; the cell's clock."""
FIRST_NS = ns_from_s(30.0)
"""A policy may load before its first target."""
LOOK_NS, ASK_S = ns_from_s(0.5), 10.0
"""How often the operator looks whether the task is done, and how long a runner may be silent."""
LAG_TICKS = round(ns_from_s(0.3) / TICK_NS)
"""The arm may be where it was sent so long ago."""
TRACKING_RAD = ROBOT.tracking_error_rad or np.inf
"""The controller stops an arm that is farther from its target."""


class Controller:
    """Takes targets for one cell; without them nothing moves."""

    def __init__(self, cell: StandinCell, session: Session, name: str, policy: str) -> None:
        """Listen."""
        self._cell, self._session, self._key = cell, session, policy_key(name, policy)
        self._newest = deque[bytes](maxlen=1)
        session.subscribe(cell_topic(name, POLICY_TARGETS)[1:], self._take)

    def _take(self, sample: Any) -> None:
        self._newest.append(sample.data)

    def _ask(self, **request: Any) -> dict[str, Any]:
        data = json.dumps(request).encode()
        return dict(json.loads(self._session.query(self._key, data, timeout_s=ASK_S)))

    def drive(self, episode: str, max_s: float) -> tuple[str, str]:
        """Follow until the task is done, something stops it, or time is up.

        Returns:
            The limit or the person who stopped it, and why it says nothing of the policy; or "".
        """
        try:
            stopped = self._follow(1.0 / float(self._ask()["rate_hz"]), max_s)
            told = dict(self._ask(over=episode, by="cell")["ended"])
        except BridgeError as error:
            return "", f"no policy acts: {error}"
        except (ValueError, KeyError, TypeError) as error:
            return "", f"what answers on {self._key} is no policy's runner ({error!r})"
        if stopped.startswith((Cause.CONTACT_FORCE, "limits", "tracking")):
            return stopped, ""
        if told.get("done"):
            return "", ""
        unasked = "" if told["asked"] else "the policy gave no answer in time"
        return told["stopped"], told["problem"] or ("" if told["stopped"] else stopped or unasked)

    def _follow(self, period_s: float, max_s: float) -> str:
        """What stopped it; empty: the task is done, or time is up."""
        cell = self._cell
        began_ns, began_s, ends_ns = cell.now_ns, time.monotonic(), None
        line = _Line(cell.target_rad.copy(), cell.target_rad.copy(), cell.now_ns, period_s)
        sent = deque[np.ndarray](maxlen=LAG_TICKS)
        fresh_ns, looked_ns = None, cell.now_ns
        self._newest.clear()
        while ends_ns is None or cell.now_ns < ends_ns:
            if self._newest:
                refused = self._take_target(self._newest.pop(), line)
                if refused:
                    return refused
                fresh_ns = cell.now_ns
                ends_ns = ends_ns or fresh_ns + ns_from_s(max_s)
            elif fresh_ns is None and cell.now_ns - began_ns > FIRST_NS:
                return f"watchdog: no target came in {FIRST_NS * 1e-9:g} s"
            elif fresh_ns is not None and cell.now_ns - fresh_ns > STOP_NS:
                return f"watchdog: no fresh target for {STOP_NS * 1e-9:g} s"
            elif fresh_ns is not None and cell.now_ns - fresh_ns > HOLD_NS:
                line.hold(cell.now_ns)
            cell.follow(np.array([TICK_NS]), line.at(cell.now_ns + TICK_NS)[None])
            sent.append(cell.target_rad)
            if cell.stopped:
                return cell.stopped
            off_rad = np.abs(cell.encoders_rad - np.array(sent)).min(axis=0)
            if off_rad.max() > TRACKING_RAD:
                joint = ARM_JOINTS[int(np.argmax(off_rad))]
                return f"tracking: {joint} is {off_rad.max():.3f} rad from where it was sent"
            if cell.now_ns - looked_ns >= LOOK_NS:
                looked_ns = cell.now_ns
                if all_hold(evaluate_success(cell.world.task, cell.truth.rollout())) is True:
                    break
                ended = self._ask()["ended"] if fresh_ns is None else {}
                if ended.get("stopped") or ended.get("problem"):
                    break
            ahead_s = (cell.now_ns - began_ns) * 1e-9 - (time.monotonic() - began_s)
            time.sleep(max(ahead_s, 0.0))
        return ""

    def _take_target(self, data: bytes, line: "_Line") -> str:
        """Go to a target from here on; why not, if it is refused."""
        try:
            sample = JointSample.from_cdr(data)
        except MalformedMessageError as error:
            return f"target: {error}"
        names = (*ARM_JOINTS, GRIPPER_WIDTH)
        if sample.names != names or not np.isfinite(sample.position).all():
            return f"target: {', '.join(sample.names)} at {sample.position} is none of this arm"
        joints_rad, width_m = sample.position[:-1], float(sample.position[-1])
        now_rad = line.at(self._cell.now_ns)
        refused = self._cell.kinematics.why_refused(joints_rad, line.goal_rad, line.period_s)
        if refused:
            return refused
        line.start_rad, line.goal_rad, line.since_ns = now_rad, joints_rad, self._cell.now_ns
        self._cell.grip(min(max(width_m, 0.0), MAX_WIDTH_M))
        return ""


@dataclass
class _Line:
    """From one target to the next."""

    start_rad: np.ndarray
    goal_rad: np.ndarray
    since_ns: int
    period_s: float

    def at(self, now_ns: int) -> np.ndarray:
        share = min((now_ns - self.since_ns) * 1e-9 / self.period_s, 1.0)
        return np.asarray(self.start_rad + (self.goal_rad - self.start_rad) * share)

    def hold(self, now_ns: int) -> None:
        """Stay where it is now."""
        self.start_rad = self.goal_rad = self.at(now_ns)
