"""The row of one replay in the table of a run."""

from collections.abc import Mapping
from typing import Any

from bridge.episode import schema, streams
from bridge.episode.reader import Episode
from bridge.errors import GstError
from bridge.task.record import parse_record
from bridge.task.verdict import Verdict
from twin.replay.failure import NOT_EVALUATED
from twin.replay.job import ReplayJob

MAY_STAY_OPEN = ("settled", "shape")
"""Predicates that a recording without an answer to them may succeed without."""


def row_of_existing(job: ReplayJob) -> dict[str, Any] | None:
    """Return the row of a replay that is there already, None when it must be made."""
    if not job.path().is_file():
        return None
    try:
        episode = Episode.open(job.path())
        verdict, divergence = streams.verdicts(episode)[-1][1], divergence_of(episode)
    except (GstError, IndexError):
        return None
    return judged(job, verdict, divergence, skipped=True)


def divergence_of(episode: Episode) -> dict[str, Any] | None:
    """The gst divergence record of a replay; None where it was compared with nothing."""
    records = [
        parse_record(message.data, name="divergence")
        for message in episode.messages(episode.topics_of_type(schema.DIVERGENCE))
    ]
    return records[-1] if records else None


def row_of_failure(job: ReplayJob, message: str) -> dict[str, Any]:
    """Return the row of a trajectory that was not evaluated, with the reason."""
    why = message.removeprefix(NOT_EVALUATED)
    return {**_row(job), "error": f"{NOT_EVALUATED}{why}", "reason": f"{NOT_EVALUATED}{why}"}


def _row(job: ReplayJob) -> dict[str, Any]:
    return {
        "episode": job.episode_path.stem,
        "plan": job.plan_id,
        "task": job.task.name,
        "trajectory": job.trajectory,
        "mode": job.config.mode,
        "executed": job.was_executed,
        "file": job.path().name,
        "skipped": False,
        "accepted": None,
        "first_failing": None,
        "reason": None,
        "error": None,
        "engine": None,
        "warnings": [],
        "predicates": None,
        "divergence": None,
    }


def judged(
    job: ReplayJob,
    verdict: Verdict,
    divergence: Mapping[str, Any] | None = None,
    *,
    skipped: bool = False,
) -> dict[str, Any]:
    """A trajectory's row: verdict, and where it diverges from the others (None: not compared)."""
    return {
        **_row(job),
        "skipped": skipped,
        "accepted": verdict.accepted,
        "first_failing": verdict.first_failing,
        "reason": verdict.reason,
        "engine": verdict.engine,
        "warnings": list(verdict.warnings),
        "predicates": predicates_hold(verdict),
        "p_success": verdict.p_success,
        "divergence": None if divergence is None else dict(divergence),
    }


def predicates_hold(verdict: Verdict) -> bool | None:
    """Whether the success predicates hold; None when what is known does not say.

    One look afterwards seldom tells whether a thing lies still or kept its shape: those may stay
    open. A thing that nobody found was not seen to be where it belongs.
    """
    values = [
        item["value"]
        for item in verdict.findings
        if item["value"] is not None or item["kind"] not in MAY_STAY_OPEN
    ]
    if False in values:
        return False
    return None if None in values or not values else True
