"""Which plan of a trial is executed: a planner proposes, the gate judges, the arm decides.

Whoever moves the robot asks the gate itself: what a planner says of its plan counts for nothing.
"""

import hashlib
import json
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from bridge.episode.metadata import NOTHING_EXECUTED, WITH, WITHOUT, EpisodeInfo
from bridge.episode.topics import GATE, PLAN, cell_topic
from bridge.errors import BridgeError, UsageError
from bridge.geometry import se3
from bridge.robots.default import ARM_JOINTS, ROBOT_NAME
from bridge.sources.standin.cell import StandinCell
from bridge.sources.standin.gate_sight import GateSight, ask_where
from bridge.sources.standin.kinematics import UnreachablePoseError
from bridge.sources.standin.planner import (
    GROUNDING,
    GROUNDING_GATE,
    POLICY_NAME,
    draw_error,
    perceive,
    plan_pick_and_place,
)
from bridge.sources.standin.settings import BUILT_IN, SessionConfig
from bridge.sources.standin.streams import Session
from bridge.task.plan import Plan
from bridge.task.plan_request import PlanAnswer, PlanRequest, Refusal
from bridge.task.verdict import Verdict

COIN_STREAM = 707
WIRE_POLICY = "nominal"
ARM_OF = {WITHOUT: "without", WITH: "with"}
"""What a condition means outside a study."""


class BuiltInPlanner:
    """The cell's own scripted planner, asked as one on the wire is."""

    def __init__(self, cell: StandinCell, grounding: str) -> None:
        """Plan for a cell; ``grounding`` says in words where the poses are from."""
        self._cell, self._grounding = cell, grounding

    def ask(self, request: PlanRequest) -> PlanAnswer:
        """Draw the candidate of this start and round."""
        cell = self._cell
        noise = cell.file.noise_for(cell.task.name)
        seeds = {"start_seed": request.seed, "round_": request.round}
        several = range(len(cell.task.manipulated))
        try:
            plan = plan_pick_and_place(
                cell.task,
                request.Ts_base_object(),
                [draw_error(noise, **seeds, index=index) for index in several],
                kinematics=cell.kinematics,
                joints_start_rad=np.array(request.joints_rad),
                max_joint_speed_rad_s=cell.file.max_joint_speed_rad_s,
                plan_id=f"plan_{request.round}",
                condition=WITHOUT,
                start_id=request.start_id,
                round_=request.round,
                grounding=self._grounding,
            )
        except UnreachablePoseError as error:
            return PlanAnswer(reason=str(error))
        return PlanAnswer(plan=replace(plan, task_sha256=request.task_sha256))


class WirePlanner:
    """A planner that answers on ``<cell>/plan``."""

    def __init__(self, session: Session, cell: str, timeout_s: float) -> None:
        """Ask the planner of a cell; silent longer than ``timeout_s``, it is not there."""
        self._session, self._timeout_s = session, timeout_s
        self._key = cell_topic(cell, PLAN)[1:]

    def ask(self, request: PlanRequest) -> PlanAnswer:
        """Send the request; what comes back is believed only where it fits."""
        try:
            data = self._session.query(self._key, request.to_json(), timeout_s=self._timeout_s)
        except BridgeError as error:
            return PlanAnswer(reason=f"no planner answers on {self._key}: {error}", heard=False)
        try:
            return PlanAnswer.from_json(data)
        except BridgeError as error:
            reason = f"no planner answers on {self._key} with a plan or a reason: {error}"
            return PlanAnswer(reason=reason, heard=False)


@dataclass(frozen=True, kw_only=True)
class Decision:
    """What will be executed, and why nothing when nothing is."""

    plan: Plan | None
    verdict: Verdict | None = None
    """The yes by which it is executed; None where no gate was to be obeyed."""
    void: bool
    """Nobody judged the plan, or nobody planned: the trial says nothing about the planner."""
    remark: str


class Decider:
    """Chooses what one cell executes in each trial."""

    def __init__(
        self, cell: StandinCell, session: Session, config: SessionConfig, task_sha256: str
    ) -> None:
        """Prepare; nothing is asked before ``decide``."""
        self._cell, self._session, self._config = cell, session, config
        self._task_sha256 = task_sha256
        built_in = config.planner == BUILT_IN
        self._stood: dict[str, np.ndarray] = {}
        """Where the objects stood when the gate was asked."""
        self.policy = config.policy or (POLICY_NAME if built_in else WIRE_POLICY)
        if built_in and self.policy != POLICY_NAME:
            message = (
                f"the built-in planner has the policy {POLICY_NAME!r} alone, not {self.policy!r}. "
                "Start a planner (robot-gst plan RUN --live) and add --planner wire."
            )
            raise UsageError(message)
        noise = cell.file.noise_for(cell.task.name)
        self.sees_by_gate = not built_in or noise.perception == "gate"
        self._planner: BuiltInPlanner | WirePlanner = (
            BuiltInPlanner(cell, GROUNDING_GATE if self.sees_by_gate else GROUNDING)
            if built_in
            else WirePlanner(session, config.cell, config.planner_timeout_s)
        )

    def decide(self, info: EpisodeInfo, start_seed: int) -> Decision:
        """Propose, ask the gate and draw again, as the trial's condition or study arm says.

        In the arm *without* the first plan is executed; in *with* the first that the gate accepts;
        in *control* the first for which a coin says yes, whose planner hears of no verdict. Outside
        a study the conditions mean the first two.
        """
        config, task = self._config, (self._cell.task, self._task_sha256)
        sight: GateSight | None = None
        if self.sees_by_gate:  # what the gate says is all that is known of the objects
            sight = ask_where(self._session, config.cell, *task, timeout_s=config.gate_timeout_s)
        if sight is not None and not sight.found:
            return self._nothing(sight.problem, void=sight.found is None)
        arm = info.study_arm or ARM_OF[info.condition]
        request = self._request(info, start_seed, sight)
        coin = np.random.default_rng([COIN_STREAM, config.study_seed, start_seed])
        refusals: list[Refusal] = []
        parent: Plan | None = None
        why = ""
        for round_ in range(1 if arm == "without" else config.rounds):
            steering = tuple(refusals) if arm == "with" else ()
            answer = self._ask(replace(request, round=round_, refused=steering))
            if answer.plan is None:
                if not answer.heard:
                    return self._nothing(answer.reason, void=True)
                why = f"the planner found no plan: {answer.reason}"
                self._note(why)
                continue
            plan = _stamped(answer.plan, info, round_, parent)
            self._cell.streams.plan(plan, self._cell.now_ns)
            # It is asked in every arm of a study, and obeyed in one.
            asked = arm == "with" or info.study_arm or config.ask_always
            verdict, reason = self._ask_gate(plan) if asked else (None, "")
            if arm == "without":
                return Decision(plan=plan, void=False, remark="")
            last = round_ == config.rounds - 1
            if arm == "control":
                if coin.random() < (config.coin or 0.0):
                    return Decision(plan=plan, void=False, remark="")
                self._note_refusal(plan, "the coin says no", last=last)
                parent, why = plan, f"the coin said no to {round_ + 1} plans"
                continue
            if verdict is not None and verdict.accepted is True:
                return Decision(plan=plan, void=False, remark="", verdict=verdict)
            if verdict is None or verdict.accepted is None:
                return self._unverified(plan, reason)
            self._note_refusal(plan, reason, last=last)
            refusals.append(Refusal(plan=plan, verdict=verdict))
            parent = plan
            why = f"the gate refused {len(refusals)} plans, the last because {reason}"
        return Decision(plan=None, void=False, remark=f"{NOTHING_EXECUTED}, {why}")

    def still_allowed(self, decision: Decision) -> Decision:
        """Of a plan that a yes allows: whether it still does, now that the arm is to move."""
        cell, plan, verdict = self._cell, decision.plan, decision.verdict
        if plan is None or verdict is None:
            return decision
        places = cell.world.Ts_base_object()
        moved = {name: T[:3, 3] - self._stood[name] for name, T in places.items()}
        why = why_stale(
            verdict, plan.to_json(), cell.now_ns, cell.encoders_rad, moved, self._judged_in()
        )
        return decision if not why else self._unverified(plan, f"the gate's yes is void: {why}")

    def _judged_in(self) -> dict[str, Any]:
        """In which scene and calibration the gate judges now; nothing where it is silent."""
        key, limit_s = cell_topic(self._config.cell, GATE)[1:], self._config.gate_timeout_s
        try:
            return dict(json.loads(self._session.query(key, b"", timeout_s=limit_s)))
        except (BridgeError, ValueError, TypeError):
            return {}

    def _request(self, info: EpisodeInfo, start_seed: int, sight: GateSight | None) -> PlanRequest:
        cell = self._cell
        if sight is None:
            noise = cell.file.noise_for(cell.task.name)
            seen = perceive(cell.world.Ts_base_object(), noise, start_seed=start_seed)
            records = tuple(_record(name, T, cell.now_ns) for name, T in seen.items())
        else:
            records = sight.records
        return PlanRequest(
            task=cell.task.name,
            task_sha256=self._task_sha256,
            policy=self.policy,
            start_id=info.start_id or "",
            seed=start_seed,
            round=0,
            robot=ROBOT_NAME,
            joint_names=ARM_JOINTS,
            joints_rad=tuple(cell.home_rad.tolist()),
            objects=records,
            stamp_ns=cell.now_ns,
        )

    def _ask(self, request: PlanRequest) -> PlanAnswer:
        answer = self._planner.ask(request)
        unfit = "" if answer.plan is None else request.why_unfit(answer.plan)
        return PlanAnswer(reason=f"its answer is refused: {unfit}") if unfit else answer

    def _nothing(self, why: str, *, void: bool, **about: str) -> Decision:
        remark = f"{NOTHING_EXECUTED}, {why}"
        self._note(remark, **about)
        return Decision(plan=None, void=void, remark=remark)

    def _note(self, text: str, **about: str) -> None:
        self._cell.streams.event("note", self._cell.now_ns, **about, text=text)

    def _unverified(self, plan: Plan, reason: str) -> Decision:
        return self._nothing(f"no verdict ({reason})", void=True, plan_id=plan.id)

    def _note_refusal(self, plan: Plan, reason: str, *, last: bool) -> None:
        self._cell.streams.event(
            "note" if last else "replan",
            self._cell.now_ns,
            plan_id=plan.id,
            text=f"refused: {reason}",
            data={"round": plan.round},
        )

    def _ask_gate(self, plan: Plan) -> tuple[Verdict | None, str]:
        """Return the verdict, None when there is none, and why it is not a yes."""
        key = cell_topic(self._config.cell, GATE)[1:]
        places = self._cell.world.Ts_base_object()
        self._stood = {name: T[:3, 3].copy() for name, T in places.items()}
        self._cell.streams.joints_again()  # a planner may have thought for seconds
        limit_s, asked_s = self._config.gate_timeout_s, time.monotonic()
        try:
            answer = self._session.query(key, plan.to_json(), timeout_s=limit_s)
            verdict = Verdict.from_json(answer)
        except BridgeError as error:
            if time.monotonic() - asked_s < limit_s:  # at once: there is no gate, or it refused
                return None, str(error)
            return None, f"the wall-clock limit of {limit_s:g} s (--gate-timeout-s) struck first"
        if verdict.plan_id != plan.id:
            return None, f"the gate judged {verdict.plan_id!r} instead of {plan.id!r}"
        return verdict, verdict.reason or "the verdict is undecided"


MOVED_RAD = 0.05


def why_stale(
    verdict: Verdict,
    plan: bytes,
    now_ns: int,
    joints_rad: np.ndarray,
    moved_m: Mapping[str, np.ndarray],
    twin: Mapping[str, Any],
) -> str:
    """Say why a yes does not allow to execute a plan from here and now; "" when it does.

    Args:
        plan: The bytes that will be executed.
        now_ns: On the cell's clock.
        moved_m: How far objects have been moved since, as far as anybody knows.
        twin: In which scene and calibration the gate judges now.
    """
    basis = verdict.basis
    if verdict.accepted is not True or basis is None:
        return "it does not say what it was given for"
    if basis["plan_sha256"] != hashlib.sha256(plan).hexdigest():
        return "it was given for another plan"
    age_s = (now_ns - basis["judged_ns"]) * 1e-9
    if not 0 <= age_s <= basis["valid_s"]:
        return f"it is {age_s:.1f} s old, and holds for {basis['valid_s']:g} s"
    for name in ("scene_hash", "calibration_id"):
        then, now = basis.get(name), twin.get(name, "nothing")
        if then != now:
            return f"its {name} was {then or 'none'}, and the gate has {now or 'none'} now"
    off_rad = np.abs(np.asarray(joints_rad) - basis["joints_rad"])
    joint = int(np.argmax(off_rad))
    if not off_rad[joint] <= MOVED_RAD:
        told = f"{ARM_JOINTS[joint]} is {off_rad[joint]:.3f} rad from where it was"
        return f"{told}, and {MOVED_RAD:g} rad are allowed"
    for name, seen in basis["objects"].items():
        off_m = np.linalg.norm(moved_m.get(name, np.zeros(3)))
        if not off_m <= seen["margin_m"]:
            told = f"{name} is {off_m * 1e3:.0f} mm from where it was judged"
            return f"{told}, and {seen['margin_m'] * 1e3:.0f} mm are allowed"
    return ""


def _record(object_id: str, T: np.ndarray, stamp_ns: int) -> dict[str, Any]:
    return {
        "schema_version": 1,
        "stamp_ns": stamp_ns,
        "object": object_id,
        "found": True,
        "T_base_object": se3.pose_record(T),
        "method": GROUNDING,
    }


def _stamped(plan: Plan, info: EpisodeInfo, round_: int, parent: Plan | None) -> Plan:
    """Write into a planner's answer what the cell alone knows: whose plan it is, and which."""
    return replace(
        plan,
        id=f"{info.id}.plan_{round_}",
        parent_id=None if parent is None else parent.id,
        round=round_,
        condition=info.condition,
        study_arm=info.study_arm,
        start_id=info.start_id or "",
    )
