"""Where the gate sees the objects: the perception that planner and gate share in some cells."""

import json
from dataclasses import dataclass
from typing import Any

from bridge.episode.topics import LOCALISE, cell_topic
from bridge.errors import BridgeError
from bridge.geometry import se3
from bridge.sources.standin.streams import Session
from bridge.task.record import check_record, load_record
from bridge.task.task_file import Task


@dataclass(frozen=True, kw_only=True)
class GateSight:
    """One answer of the gate's service ``/gate/localise``, or that there was none."""

    found: bool | None
    """Whether every object of the task was found; None: nobody looked."""
    reason: str = ""
    records: tuple[dict[str, Any], ...] = ()
    """The gst localisation v1 records they are from, in the order of the task's objects."""

    @property
    def problem(self) -> str:
        """Why nothing can be planned."""
        if self.found is None:
            return f"no localisation ({self.reason})"
        return f"object not found: {self.reason}"

    @staticmethod
    def from_json(data: bytes, task: Task) -> "GateSight":
        """Read an answer; one that cannot be read, or lacks an object, is none."""
        try:
            record = load_record(data, name="answer of the gate")
            found, reason = record["found"], str(record["reason"] or "")
            if found is not True:
                return GateSight(found=False if found is False else None, reason=reason)
            records = {str(item["object"]): item for item in record["objects"]}
            for item in records.values():
                se3.pose_from_record(check_record(item, name="localisation")["T_base_object"])
        except (BridgeError, KeyError, TypeError) as error:
            return GateSight(found=None, reason=f"the gate's answer cannot be read: {error}")
        missing = [key for key in task.objects if key not in records]
        if missing:
            reason = f"the gate's answer says nothing of {', '.join(missing)}"
            return GateSight(found=None, reason=reason)
        return GateSight(found=True, records=tuple(records[key] for key in task.objects))


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
