"""gst plan request v1: what a cell asks its planner, and what the planner answers.

A request says everything a planner may know, so a planner needs no memory: the same request has the
same answer. It does not say in which arm of a study its trial is; the cell writes that, the plan's
name and its parent into the plan that it publishes.
"""

import json
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from bridge.errors import InvalidRecordError
from bridge.geometry import se3
from bridge.task.plan import Plan
from bridge.task.record import check_record, load_record, made_of, parse_record
from bridge.task.verdict import Verdict

SCHEMA_VERSION = 1
SAME_PLACE_M = 1e-6
SAME_TURN_RAD = 1e-6
"""A plan copies its objects' poses from the request; what is left is rounding."""


@dataclass(frozen=True, kw_only=True)
class Refusal:
    """A plan that the gate refused in this trial, and why."""

    plan: Plan
    verdict: Verdict


@dataclass(frozen=True, kw_only=True)
class PlanRequest:
    """One question: how would you do this task from here?"""

    task: str
    task_sha256: str
    """Of the task file, which the run's ``tasks/`` or ``datasets/tasks`` has."""
    policy: str
    """How to plan; planners name those they have."""
    start_id: str
    seed: int
    """What is drawn at random is drawn with this."""
    round: int
    """How many plans of this trial were not executed; 0 asks for the best one."""
    robot: str
    joint_names: tuple[str, ...]
    joints_rad: tuple[float, ...]
    objects: tuple[dict[str, Any], ...]
    """One gst localisation v1 record per object of the task, all of them found."""
    stamp_ns: int = 0
    refused: tuple[Refusal, ...] = ()
    """What the gate refused before, oldest first; empty where nobody looks at its answers."""

    def Ts_base_object(self) -> dict[str, Float[np.ndarray, "4 4"]]:
        """Poses of the objects."""
        return {
            str(record["object"]): se3.pose_from_record(record["T_base_object"])
            for record in self.objects
        }

    def why_unfit(self, plan: Plan) -> str:
        """Say why a plan is no answer to this request; empty where it is one."""
        if (plan.task, plan.task_sha256) != (self.task, self.task_sha256):
            return (
                f"it is for task {plan.task!r} of sha256 {plan.task_sha256[:12] or 'unknown'}, "
                f"asked was {self.task!r} of {self.task_sha256[:12]}"
            )
        if plan.robot != self.robot or plan.joint_names != self.joint_names:
            return f"it is for robot {plan.robot!r} and its joints, asked was {self.robot!r}"
        if plan.policy != self.policy:
            return f"it was made by policy {plan.policy!r}, asked was {self.policy!r}"
        if any(waypoint.joints_rad is None for waypoint in plan.tau):
            return "it has waypoints without joints"
        for name, T in self.Ts_base_object().items():
            if name not in plan.entities:
                return f"it does not say where it has {name}"
            try:
                T_plan = se3.pose_from_record(plan.entities[name])
            except (InvalidRecordError, TypeError):
                return f"where it has {name} cannot be read"
            away_m = float(np.linalg.norm(T_plan[:3, 3] - T[:3, 3]))
            turned = float(np.abs(T_plan[:3, :3] - T[:3, :3]).max())
            if away_m > SAME_PLACE_M or turned > SAME_TURN_RAD:
                return (
                    f"it was made for another scene: it has {name} {away_m * 1e3:.3f} mm from "
                    "where the request says, or turned"
                )
        return ""

    def to_json(self) -> bytes:
        """Serialise, refusing what the schema refuses."""
        record = asdict(replace(self, refused=()))
        record["refused"] = [
            {"plan": json.loads(each.plan.to_json()), "verdict": json.loads(each.verdict.to_json())}
            for each in self.refused
        ]
        record = json.loads(json.dumps({"schema_version": SCHEMA_VERSION, **record}))
        check_record(record, name="plan_request")
        return json.dumps(record, separators=(",", ":")).encode()

    @staticmethod
    def from_json(data: bytes) -> "PlanRequest":
        """Parse and check. Raises ``InvalidRecordError`` naming what does not fit."""
        record = parse_record(data, name="plan_request")
        for item in record["objects"]:
            check_record(item, name="localisation")
        refused = tuple(
            Refusal(
                plan=Plan.from_json(json.dumps(each["plan"]).encode()),
                verdict=Verdict.from_json(json.dumps(each["verdict"]).encode()),
            )
            for each in record.pop("refused", [])
        )
        return replace(made_of(PlanRequest, record, name="plan_request"), refused=refused)


@dataclass(frozen=True, kw_only=True)
class PlanAnswer:
    """A plan, or why there is none."""

    plan: Plan | None = None
    reason: str = ""
    heard: bool = True
    remarks: tuple[str, ...] = ()
    """For whoever looks after the planner; they are not sent."""

    def to_json(self) -> bytes:
        """The plan itself, or ``{"plan": null, "reason": ...}``."""
        if self.plan is not None:
            return self.plan.to_json()
        return json.dumps({"plan": None, "reason": self.reason}).encode()

    @staticmethod
    def from_json(data: bytes) -> "PlanAnswer":
        """Parse and check. Raises ``InvalidRecordError`` naming what does not fit."""
        record = load_record(data, name="plan answer")
        if "plan" in record and record["plan"] is None:
            return PlanAnswer(reason=str(record.get("reason") or "the planner does not say why"))
        return PlanAnswer(plan=Plan.from_json(data))
