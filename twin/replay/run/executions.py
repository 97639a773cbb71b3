"""When a plan was executed, and why what was recorded of it says nothing."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from bridge.episode.streams import execution_ns


@dataclass(frozen=True, kw_only=True)
class Execution:
    """What the events of an episode say of one plan."""

    interval_ns: tuple[int, int] | None
    """Source times of start and end; None when it was not executed from beginning to end."""
    problem: str = ""
    """Why the execution cannot be replayed, although there was one."""


def execution_of(events: Iterable[Mapping[str, Any]], plan_id: str) -> Execution:
    """Find the execution of a plan.

    Args:
        events: All of an episode, in their order.
        plan_id: Whose.
    """
    mine = [event for event in events if event.get("plan_id") == plan_id]
    count = sum(event["type"] == "execution_started" for event in mine)
    start, end = execution_ns(mine, plan_id)
    interval = None if start is None or end is None else (start, end)
    problem = ""
    if count and interval is None:
        problem = f"the execution of plan {plan_id!r} began, and nobody recorded that it ended"
    elif count > 1:
        problem = (
            f"plan {plan_id!r} was executed {count} times, and which end belongs to which nobody "
            "can tell; give each execution a plan with an id of its own"
        )
    return Execution(interval_ns=interval, problem=problem)
