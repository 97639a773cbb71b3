"""Where the gate sees the objects: the perception that planner and gate share in some cells."""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float

from bridge.episode.topics import LOCALISE, cell_topic
from bridge.errors import BridgeError
from bridge.geometry import se3
from bridge.sources.standin.streams import Session
from bridge.task.record import check_record
from bridge.task.task_file import Task


class NotSeenError(BridgeError):
    """There is no pose to plan from."""


@dataclass(frozen=True, kw_only=True)
class GateSight:
    """One answer of the gate's service ``/gate/localise``, or that there was none."""

    found: bool | None
    """Whether every object of the task was found; None: nobody looked."""
    reason: str = ""
    Ts_base_object: Mapping[str, Float[np.ndarray, "4 4"]] = field(default_factory=dict)
    records: tuple[dict[str, Any], ...] = ()
    """The gst localisation v1 records they are from, in the order of the task's objects."""

    @property
    def problem(self) -> str:
        """Why nothing can be planned."""
        if self.found is None:
            return f"no localisation ({self.reason})"
        return f"object not found: {self.reason}"

    def needed(self) -> dict[str, Float[np.ndarray, "4 4"]]:
        """The poses of all objects."""
        if not self.found:
            raise NotSeenError(self.problem)
        return dict(self.Ts_base_object)

    @staticmethod
    def from_json(data: bytes, task: Task) -> "GateSight":
        """Read an answer; one that cannot be read, or lacks an object, is none."""
        try:
            record = json.loads(data)
            found, reason = record["found"], str(record["reason"] or "")
            if found is not True:
                return GateSight(found=False if found is False else None, reason=reason)
            records = {str(item["object"]): item for item in record["objects"]}
            poses = dict(_pose(item) for item in records.values())
        except (BridgeError, ValueError, KeyError, TypeError, RecursionError) as error:
            return GateSight(found=None, reason=f"the gate's answer cannot be read: {error}")
        missing = [key for key in task.objects if key not in poses]
        if missing:
            reason = f"the gate's answer says nothing of {', '.join(missing)}"
            return GateSight(found=None, reason=reason)
        return GateSight(
            found=True,
            Ts_base_object={key: poses[key] for key in task.objects},
            records=tuple(records[key] for key in task.objects),
        )


def ask_where(
    session: Session, cell: str, task: Task, task_sha256: str, *, timeout_s: float
) -> GateSight:
    """Ask a cell's gate where a task's objects are."""
    key = cell_topic(cell, LOCALISE)[1:]
    payload = json.dumps({"task": task.name, "task_sha256": task_sha256}).encode()
    try:
        answer = session.query(key, payload, timeout_s=timeout_s)
        return GateSight.from_json(answer, task)
    except BridgeError as error:
        return GateSight(found=None, reason=str(error))


def _pose(record: dict[str, Any]) -> tuple[str, Float[np.ndarray, "4 4"]]:
    known = check_record(record, name="localisation")
    T = se3.pose_from_record(known["T_base_object"])
    if not all(math.isfinite(value) for value in T.ravel().tolist()):
        message = f"the pose of {known['object']} is not finite"
        raise ValueError(message)
    return str(known["object"]), T
