"""Lanes of a trial on the page's clock: stages, what the hand touches, and what is apart."""

from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np

from dashboards.figures import Span, StageChart, stage_chart
from dashboards.recording import PageClock, Recording
from dashboards.wording import length_text

GROUND = "table"
"""What contacts call what everything stands on."""
APART = {
    "tool_position": "tool apart",
    "tool_rotation": "tool apart",
    "gripper_width": "grip apart",
    "contact": "touch apart",
    "object_position": "object apart",
}
"""Lane of each quantity of a divergence; further ones get a lane of their own name."""


def trial_lanes(
    recording: Recording,
    replays: Mapping[str, Recording],
    clock: PageClock,
    failure_t_s: float | None,
    failed: Collection[str] = (),
) -> StageChart | None:
    """Draw stages, touches, divergences; marks at replanning and the twin's failure (page time)."""
    marks = [
        (clock.seconds(event["stamp_ns"]), f"replan: {event.get('text') or 'no reason'}", "replan")
        for event in recording.events
        if event["type"] == "replan"
    ]
    if failure_t_s is not None:
        marks.append((failure_t_s, "first failure in the twin", "failure"))
    touches = [
        (f"touch, {trajectory}", _touches(replay, clock)) for trajectory, replay in replays.items()
    ]
    return stage_chart(
        [
            ("planned", _planned_stages(recording, clock)),
            ("recorded", _recorded_stages(recording, clock, failed)),
            *touches,
            *_apart(replays, clock),
        ],
        marks,
        span_s=clock.span_s,
    )


def _touches(replay: Recording, clock: PageClock) -> list[Span]:
    """When the robot touches objects in the twin, and all touches that are not allowed."""
    found: dict[tuple[str, bool], list[tuple[float, float]]] = {}
    for record in replay.contacts:
        bodies = [str(body) for body in record["bodies"]]
        is_bad = record.get("allowed") is False
        held = [body for body in bodies if body in replay.objects]
        others = [body for body in bodies if body not in replay.objects and body != GROUND]
        ends = np.array([record["stamp_ns"], record["end_ns"]])
        times = clock.replay_seconds(replay, ends)
        if times is None or not (is_bad or (held and others)):
            continue
        label = " and ".join(bodies) if is_bad else held[0]
        found.setdefault((label, is_bad), []).append((float(times[0]), float(times[1])))
    spans = []
    for (label, is_bad), times_s in found.items():
        for start_s, end_s in _merged(times_s):
            title = f"{'collision' if is_bad else 'the robot touches'} {label}"
            title += f", {start_s:.2f} s to {end_s:.2f} s"
            style = "apart" if is_bad else "stage-1"
            spans.append(Span(start_s=start_s, end_s=end_s, label=label, style=style, title=title))
    return spans


def _merged(times_s: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Stretches of time without those that overlap."""
    merged: list[tuple[float, float]] = []
    for start_s, end_s in sorted(times_s):
        if merged and start_s <= merged[-1][1]:
            merged[-1] = (merged[-1][0], max(end_s, merged[-1][1]))
        else:
            merged.append((start_s, end_s))
    return merged


def _apart(replays: Mapping[str, Recording], clock: PageClock) -> list[tuple[str, list[Span]]]:
    """One lane for each quantity in which trajectories differ, from its first instant on."""
    lanes: dict[str, list[tuple[float, Mapping[str, Any]]]] = {}
    for replay in replays.values():
        told = replay.divergence or {"plan_id": "", "quantities": []}
        for each in told["quantities"]:
            lane = APART.get(each["quantity"], each["quantity"].replace("_", " "))
            start_s = clock.of_plan_time(told["plan_id"], each["first_t_ns"])
            if start_s is not None:
                lanes.setdefault(lane, []).append((start_s, each))
    drawn = []
    for lane, found in lanes.items():
        start_s, first = min(found, key=lambda item: item[0])
        title = "; ".join(f"{each['detail']}, from {t_s:.2f} s on" for t_s, each in found)
        span = Span(
            start_s=start_s, end_s=clock.end_s, label=_size(first), style="apart", title=title
        )
        drawn.append((lane, [span]))
    return drawn


def _size(quantity: Mapping[str, Any]) -> str:
    """How far apart, and between whom."""
    size, unit = float(quantity["size"]), quantity["unit"]
    text = length_text(size) if unit == "m" else f"{size:.2f} {unit}"
    return f"{' – '.join(quantity['between'])}: {text}"


def _planned_stages(recording: Recording, clock: PageClock) -> list[Span]:
    spans = []
    for _, plan in recording.plans:
        for index, stage in enumerate(plan.stages):
            start = clock.of_plan_time(plan.id, stage.t_start_ns)
            end = clock.of_plan_time(plan.id, stage.t_end_ns)
            if start is None or end is None:
                continue
            title = f"{stage.id}: {stage.text} ({start:.2f} s to {end:.2f} s, plan {plan.id})"
            style = f"stage-{index % 4}"
            spans.append(Span(start_s=start, end_s=end, label=stage.id, style=style, title=title))
    return spans


def _recorded_stages(recording: Recording, clock: PageClock, failed: Collection[str]) -> list[Span]:
    order = {
        stage.id: index for _, plan in recording.plans for index, stage in enumerate(plan.stages)
    }
    spans = []
    begun: dict[str, float] = {}
    for event in recording.events:
        stage_id = str(event.get("stage_id"))
        if event["type"] == "stage_started":
            begun[stage_id] = clock.seconds(event["stamp_ns"])
        elif event["type"] == "stage_ended" and stage_id in begun:
            start, end = begun.pop(stage_id), clock.seconds(event["stamp_ns"])
            label, style = stage_id, f"stage-{order.get(stage_id, 0) % 4}"
            if stage_id in failed:
                label, style = f"✗ {stage_id}", "apart"
            spans.append(Span(start_s=start, end_s=end, label=label, style=style))
    return spans
