"""An executed replay laid over the planned one and over the recording."""

from typing import Any

from bridge.episode import streams
from bridge.episode.reader import Episode
from bridge.errors import GstError
from bridge.task.predicate import evaluate_success
from twin.replay.config import ReplayConfig
from twin.replay.divergence import Divergence, diverge
from twin.replay.job import ReplayJob
from twin.replay.result import ReplayResult
from twin.replay.trace import (
    CONTACT_M,
    Recording,
    Trace,
    rollout_of_recording,
    states_of_recording,
    trace_of_file,
    trace_of_recording,
    trace_of_result,
)
from twin.replay.verdict import findings_of
from twin.robot.collision import hulls_of
from twin.robot.model import load_robot

Findings = dict[tuple[str, str], bool | None]


def recorded_findings(recording: Recording, config: ReplayConfig) -> tuple[dict[str, Any], ...]:
    """What the success predicates, and the one on contacts, say of the recording itself."""
    robot = load_robot(recording.scene.urdf)
    rollout = rollout_of_recording(recording, robot, hulls_of(robot), config)
    task = recording.scene.task
    return tuple(findings_of(task, rollout, "recorded", tolerance_m=CONTACT_M))


def compare(job: ReplayJob, result: ReplayResult, recording: Recording, end_ns: int) -> Divergence:
    """Lay the executed replay over the planned one, if it is there, and over the recording."""
    robot = load_robot(recording.scene.urdf)
    executed = trace_of_result(result, "executed", end_ns)
    recorded = trace_of_recording(recording, robot, job.config.sample_rate_hz)
    traces = [executed, recorded]
    task = job.task
    findings = {
        "executed": _findings(findings_of(task, result, "replayed")),
        "recorded": {
            (finding.kind, finding.object_id): finding.value
            for finding in evaluate_success(task, states_of_recording(recording, robot))
        },
    }
    planned = _planned(job, recording)
    if planned is not None:
        trace, findings["planned"] = planned
        traces.append(trace)
    return diverge(job.plan_id, traces, findings=findings)


def _planned(job: ReplayJob, recording: Recording) -> tuple[Trace, Findings] | None:
    """The planned replay, if there is one that can be read."""
    try:
        path = job.planned().path()
        trace = trace_of_file(path, "planned", job.start_ns, recording.plan.tau[-1].t_ns)
        verdict = streams.verdicts(Episode.open(path))[-1][1]
    except (GstError, IndexError, StopIteration):
        return None
    return trace, _findings([f for f in verdict.findings if f["side"] == "replayed"])


def _findings(found: list[dict[str, Any]]) -> Findings:
    return {(item["kind"], str(item.get("object", ""))): item["value"] for item in found}
