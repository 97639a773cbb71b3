"""The session: an operator who records a scan, then trials, with the planner and the gate."""

import contextlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from bridge.episode.metadata import EpisodeInfo, Outcome
from bridge.errors import BridgeError, UsageError
from bridge.geometry import se3
from bridge.sources.standin.cell import StandinCell
from bridge.sources.standin.execution import execute_plan
from bridge.sources.standin.kinematics import UnreachablePoseError
from bridge.sources.standin.label import OPERATOR, label_trial, void_trial
from bridge.sources.standin.planner import (
    POLICY_NAME,
    draw_errors,
    perceive,
    plan_pick_and_place,
)
from bridge.sources.standin.probes import PROBES, NoRoomForProbeError, plan_probe
from bridge.sources.standin.scan import ScanConfig, joint_move, scan_joints
from bridge.sources.standin.settings import CONDITIONS, SessionConfig
from bridge.sources.standin.streams import Session
from bridge.task.plan import Plan
from bridge.task.robot import ROBOT_NAME
from bridge.task.verdict import Verdict
from bridge.terminal import Output

RESET_STREAM = 404
PROBE_STREAM = 505
PROBE_TRIES = 100
"""The object is put elsewhere until there is room for the probe."""
SEEDS_PER_SESSION = 1000
"""Session 7 starts at start seed 7000; sessions never share a start."""
LOOK_S = 0.9
"""The arm waits at home before a plan, so that the start is seen at rest."""
BETWEEN_S = 8.0
"""Putting the objects back takes a person about this long; nothing is published meanwhile."""
STILL_S = 0.16
"""The arm rests this long at a viewpoint before the picture."""
CONTROL_TIMEOUT_S = 60.0


@dataclass(frozen=True, kw_only=True)
class Decision:
    """What will be executed, and why nothing when nothing is."""

    plan: Plan | None
    void: bool
    """Nobody judged the plan: the trial says nothing about the planner."""
    remark: str


class Operator:
    """Runs one session against a recorder and, with replanning, a gate."""

    def __init__(
        self,
        cell: StandinCell,
        session: Session,
        config: SessionConfig,
        output: Output | None = None,
    ) -> None:
        """Prepare; nothing is published before ``scan`` or ``trials``."""
        unknown = sorted(set(config.conditions) - set(CONDITIONS))
        if unknown:
            message = f"condition {unknown[0]!r} is unknown. There are: {', '.join(CONDITIONS)}."
            raise UsageError(message)
        self._cell, self._session, self._config = cell, session, config
        self._output = output or Output(quiet=True)
        self._open = False
        self.scanned = False
        self.num_probes = 0
        self.results: list[tuple[EpisodeInfo, Outcome]] = []

    def start_seeds(self) -> list[int]:
        """One seed per start; both conditions share them."""
        first = self._config.seed * SEEDS_PER_SESSION
        return [first + k for k in range(self._config.trials)]

    def start_poses(self, start_seed: int, condition: str) -> dict[str, Float[np.ndarray, "4 4"]]:
        """The declared start as a person puts it down: a little off, differently each time."""
        noise = self._cell.file.noise_for(self._cell.task.name)
        poses = self._cell.task.draw_start(np.random.default_rng(start_seed))
        index = CONDITIONS.index(condition) if condition in CONDITIONS else len(CONDITIONS)
        rng = np.random.default_rng([RESET_STREAM, start_seed, index])
        for T in poses.values():
            turn = rng.normal(0.0, noise.reset_rad)
            q = np.array([np.cos(turn / 2), 0.0, 0.0, np.sin(turn / 2)])
            T[:3, :3] = se3.rotation_from_quaternion(q) @ T[:3, :3]
            T[:2, 3] += rng.normal(0.0, noise.reset_m, 2)
        return poses

    def scan(self) -> None:
        """Record one scan with the objects where the first trial has them."""
        cell = self._cell
        cell.reset(self.start_poses(self._config.seed * SEEDS_PER_SESSION, "scan"))
        self._begin(self._info(self._config.scan_id, kind="scan"))
        joints = cell.home_rad
        mount = next(item for item in cell.file.cameras.values() if item.moving)
        cell.wait(STILL_S)
        cell.capture()
        stops = scan_joints(mount, cell.kinematics, joints, ScanConfig())
        with self._output.progress("scan", len(stops)) as advance:
            for done, target in enumerate(stops, start=1):
                self._move(joints, target)
                cell.wait(STILL_S)
                cell.capture()
                joints = target
                advance(done, "viewpoints")
        self._move(joints, cell.home_rad)
        cell.wait(STILL_S)
        self._end(None)
        self.scanned = True

    def _move(self, start: Float[np.ndarray, "6"], end: Float[np.ndarray, "6"]) -> None:
        times, joints = joint_move(start, end, self._cell.file.max_joint_speed_rad_s)
        self._cell.follow(times, joints)

    def trials(self) -> None:
        """Record every trial: each start once per condition; ``results`` grows."""
        number = self._config.first_trial
        total = self._config.trials * len(self._config.conditions)
        with self._output.progress("trials", total) as advance:
            for start_seed in self.start_seeds():
                for condition in self._config.conditions:
                    info, outcome = self._trial(number, start_seed, condition)
                    self.results.append((info, outcome))
                    self._output.detail(f"{info.id} {condition}: {outcome.result}")
                    number += 1
                    advance(len(self.results), f"{info.id} {outcome.result}")

    def _trial(self, number: int, start_seed: int, condition: str) -> tuple[EpisodeInfo, Outcome]:
        cell = self._cell
        cell.reset(self.start_poses(start_seed, condition))
        info = self._info(
            f"trial_{number:04d}",
            kind="trial",
            condition=condition,
            policy=POLICY_NAME,
            trial=number,
            start_id=f"{cell.task.name}/{start_seed}",
            start_seed=start_seed,
        )
        self._begin(info)
        cell.cameras_running = True
        cell.wait(LOOK_S)
        decision = self._decide(info, start_seed)
        if decision.plan is not None:
            execute_plan(cell, decision.plan)
        else:
            cell.wait(LOOK_S)
        if decision.void:
            outcome = void_trial(cell.task, decision.remark)
        else:
            executed = decision.plan is not None
            outcome = label_trial(cell.task, cell.truth, executed=executed, remark=decision.remark)
        text = f"{outcome.result}: {outcome.detail}"
        cell.streams.event("label", cell.now_ns, text=text, outcome=asdict(outcome))
        cell.cameras_running = False
        self._end(outcome)
        return info, outcome

    def probes(self) -> None:
        """Record every probe of every round, each from a start of its own."""
        kinds = [kind for _ in range(self._config.probes) for kind in PROBES]
        with self._output.progress("probes", len(kinds)) as advance:
            for number, kind in enumerate(kinds, start=self._config.first_probe):
                self._probe(number, kind)
                self.num_probes += 1
                advance(self.num_probes, kind)

    def _probe(self, number: int, kind: str) -> None:
        cell, config = self._cell, self._config
        poses, plan = self._probe_start(number, kind)
        cell.reset(poses)
        info = self._info(
            f"probe_{number:04d}", kind="probe", start_id=plan.start_id, tags=(f"probe:{kind}",)
        )
        self._begin(info)
        cell.cameras_running = True
        cell.wait(LOOK_S)
        cell.streams.plan(plan, cell.now_ns)
        execute_plan(cell, plan)
        cell.cameras_running = False
        self._end(None)
        self._output.detail(f"{info.id} {kind}: recorded from seed {config.seed}")

    def _probe_start(
        self, number: int, kind: str
    ) -> tuple[dict[str, Float[np.ndarray, "4 4"]], Plan]:
        """Put the objects where there is room for the probe, and plan it as it is perceived."""
        cell, config = self._cell, self._config
        noise = cell.file.noise_for(cell.task.name)
        for attempt in range(PROBE_TRIES):
            rng = np.random.default_rng([PROBE_STREAM, config.seed, number, attempt])
            poses = cell.task.draw_start(rng)
            seed = config.seed * SEEDS_PER_SESSION + number
            with contextlib.suppress(NoRoomForProbeError):
                return poses, plan_probe(
                    kind,
                    cell.task,
                    perceive(poses, noise, start_seed=seed),
                    kinematics=cell.kinematics,
                    joints_start_rad=cell.home_rad,
                    max_joint_speed_rad_s=cell.file.max_joint_speed_rad_s,
                    plan_id=f"probe_{number:04d}.{kind}",
                    start_id=f"{cell.task.name}/probe/{config.seed}/{number}",
                    turn=1 if (number - 1) // len(PROBES) % 2 else -1,
                )
        raise NoRoomForProbeError(kind)

    def _decide(self, info: EpisodeInfo, start_seed: int) -> Decision:
        """Plan, and with replanning ask the gate until it accepts or the rounds are used up."""
        rounds = self._config.rounds if info.condition == "with_replanning" else 1
        parent: Plan | None = None
        refused, why = 0, ""
        for round_ in range(rounds):
            try:
                plan = self._candidate(info, start_seed, round_, parent)
            except UnreachablePoseError as error:
                why = f"the planner found no plan: {error}"
                self._cell.streams.event("note", self._cell.now_ns, text=why)
                continue
            self._cell.streams.plan(plan, self._cell.now_ns)
            if info.condition != "with_replanning":
                if self._config.ask_always:
                    self._ask_gate(plan)  # the gate publishes its verdict; nobody obeys it
                return Decision(plan=plan, void=False, remark="")
            verdict, reason = self._ask_gate(plan)
            accepted = None if verdict is None else verdict.accepted
            if accepted is True:
                return Decision(plan=plan, void=False, remark="")
            if accepted is None:
                return self._unverified(plan, reason)
            self._note_refusal(plan, reason, last=round_ == rounds - 1)
            parent = plan
            refused += 1
            why = f"the gate refused {refused} plans, the last because {reason}"
        return Decision(plan=None, void=False, remark=f"nothing executed, {why}")

    def _unverified(self, plan: Plan, reason: str) -> Decision:
        streams, now_ns = self._cell.streams, self._cell.now_ns
        if self._config.execute_unverified:
            remark = f"executed without a verdict ({reason})"
            streams.event("note", now_ns, plan_id=plan.id, text=remark)
            return Decision(plan=plan, void=False, remark=remark)
        remark = f"nothing executed, no verdict ({reason})"
        streams.event("note", now_ns, plan_id=plan.id, text=remark)
        return Decision(plan=None, void=True, remark=remark)

    def _note_refusal(self, plan: Plan, reason: str, *, last: bool) -> None:
        kind = "note" if last else "replan"
        self._cell.streams.event(
            kind,
            self._cell.now_ns,
            plan_id=plan.id,
            text=f"refused: {reason}",
            data={"round": plan.round},
        )

    def _candidate(
        self, info: EpisodeInfo, start_seed: int, round_: int, parent: Plan | None
    ) -> Plan:
        cell = self._cell
        noise = cell.file.noise_for(cell.task.name)
        return plan_pick_and_place(
            cell.task,
            perceive(cell.world.Ts_base_object(), noise, start_seed=start_seed),
            draw_errors(noise, len(cell.task.manipulated), start_seed=start_seed, round_=round_),
            kinematics=cell.kinematics,
            joints_start_rad=cell.home_rad,
            max_joint_speed_rad_s=cell.file.max_joint_speed_rad_s,
            plan_id=f"{info.id}.plan_{round_}",
            condition=info.condition,
            start_id=info.start_id or "",
            parent_id=None if parent is None else parent.id,
            round_=round_,
        )

    def _ask_gate(self, plan: Plan) -> tuple[Verdict | None, str]:
        """Return the verdict, None when there is none, and why it is not a yes."""
        key = f"{self._config.gate_cell or self._config.cell}/gate/verdict"
        try:
            answer = self._session.query(key, plan.to_json(), timeout_s=self._config.gate_timeout_s)
            verdict = Verdict.from_json(answer)
        except BridgeError as error:
            return None, str(error)
        if verdict.plan_id != plan.id:
            return None, f"the gate judged {verdict.plan_id!r} instead of {plan.id!r}"
        return verdict, _reason(verdict)

    def _info(self, episode_id: str, *, kind: str, **fields: Any) -> EpisodeInfo:
        task = self._cell.task
        return EpisodeInfo(
            id=episode_id,
            kind=kind,
            task=task.name,
            instruction=task.instruction,
            operator=OPERATOR,
            robot=ROBOT_NAME,
            cell=self._config.cell,
            stand_in=True,
            **fields,
        )

    def _begin(self, info: EpisodeInfo) -> None:
        record = {key: value for key, value in asdict(info).items() if value is not None}
        record["tags"] = list(info.tags)
        del record["id"]
        self._control("start", {"id": info.id, "info": record})
        self._open = True
        self._cell.announce()

    def _end(self, outcome: Outcome | None, *, discard: bool = False) -> None:
        record = None if outcome is None else asdict(outcome)
        answer = self._control("stop", {"outcome": record, "discard": discard})
        self._open = False
        self._output.detail(f"recorded {json.dumps(answer)}")
        self._cell.skip(BETWEEN_S)

    def abandon(self, *, discard: bool) -> None:
        """Close an episode that was interrupted, if one is open, or throw it away."""
        self._cell.cameras_running = False
        if self._open:
            self._end(void_trial(self._cell.task, "interrupted"), discard=discard)

    def _control(self, verb: str, request: Mapping[str, Any]) -> dict[str, Any]:
        key = f"rec/{self._config.recorder}/ctl/{verb}"
        payload = json.dumps(request).encode()
        answer = self._session.query(key, payload, timeout_s=CONTROL_TIMEOUT_S)
        return dict(json.loads(answer))


def _reason(verdict: Verdict) -> str:
    name = verdict.first_failing
    if name is None:
        return verdict.reason or "the verdict is undecided"
    factor = getattr(verdict, name)
    parts = [name, factor.cause or "", factor.detail or ""]
    return " ".join(part for part in parts if part)
