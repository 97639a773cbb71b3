"""Plots and lanes of a trial on the page's clock.

Plots: tool, gripper, clearance, objects, joints. Lanes: stages, touches, and what is apart.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from bridge.clock import NS_PER_S
from bridge.episode.executions import NO_PLAN
from bridge.episode.streams import JointTrack
from bridge.task.plan import Plan
from dashboards.figures import Signal, Span, StageChart, TimePlot, stage_chart, time_plot
from dashboards.recording import PageClock, Recording
from dashboards.wording import length_text
from evaluator.compare.motion import distance_over_time
from evaluator.errors import UndefinedStatisticError
from evaluator.metrics.trajectory import JointErrors, joint_errors
from evaluator.trial_row import TrialRow

RECORDED, PLANNED = "recorded", "planned"
LEAST_SPAN = {"mm": 5.0, "rad": 0.05, "mrad": 5.0}
"""A value axis covers at least this much of its unit."""
MARGIN_SETTING = "eps_col_m"
"""The replay setting that holds the safety distance."""
MM = 1000.0
"""Millimetres per metre."""
MRAD = 1000.0
"""Milliradians per radian."""
SMALL: dict[str, Any] = {"width": 370, "height": 130}
"""Size of a joint's plot [px]."""

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

Samples = tuple[np.ndarray, np.ndarray]
"""Stamps [ns] and values."""


def main_plots(
    recording: Recording,
    replays: Sequence[Recording],
    sent_plan: Plan | None,
    row: TrialRow | None,
    clock: PageClock,
) -> tuple[TimePlot, ...]:
    """Tool error, clearance, gripper and objects; only those that have data.

    Args:
        sent_plan: Only its replays are drawn; None where no plan was sent.
        row: The trial beside its replays, for the tool's error; None where it was not compared.
    """
    shown = shown_replays(replays, sent_plan)
    plots = [
        _error_plot(recording, replays, row, clock),
        _clearance_plot(shown, clock),
        _width_plot(recording, shown, clock),
        *_object_plots(shown, clock),
    ]
    return tuple(plot for plot in plots if plot is not None)


def shown_replays(replays: Sequence[Recording], sent_plan: Plan | None) -> dict[str, Recording]:
    """Pick a planned and an executed replay of what was sent: dynamic, and the last made."""
    chosen: dict[str, Recording] = {}
    for replay in replays:
        derived = replay.derived
        if derived is None or derived.trajectory is None:
            continue
        if derived.plan_id not in (None, NO_PLAN if sent_plan is None else sent_plan.id):
            continue
        if derived.mode == "dynamic" or derived.trajectory not in chosen:
            chosen[derived.trajectory] = replay
    return dict(sorted(chosen.items(), reverse=True))


def _error_plot(
    recording: Recording, replays: Sequence[Recording], row: TrialRow | None, clock: PageClock
) -> TimePlot | None:
    start = None if row is None or row.plan_id is None else clock.of_plan_time(row.plan_id, 0)
    if row is None or row.plan_id is None or start is None:
        return None
    names = {"planned": row.planned_replay, "executed": row.executed_replay}
    paths = {replay.path.name: replay.path for replay in replays}
    compared = {against: paths[name] for against, name in names.items() if name in paths}
    signals = []
    for against, path in compared.items():
        found = distance_over_time(recording.path, path, row.plan_id)
        if found is not None:
            name, t_s = f"to twin, {against}", found[0] + start
            style = f"twin-{against}"
            signals.append(Signal(name=name, style=style, t_s=t_s, values=MM * found[1]))
    title, note = "Tool: recorded to replayed distance", "computed by the evaluator"
    return _plot(title, "mm", signals, clock, level=0.0, note=note)


def _width_plot(
    recording: Recording, shown: dict[str, Recording], clock: PageClock
) -> TimePlot | None:
    def widths(plan: Plan) -> np.ndarray:
        return np.array([np.nan if w.width_m is None else MM * w.width_m for w in plan.tau])

    signals = [
        _plan_signal(recording, clock, widths),
        *_twin_signals(shown, clock, lambda replay: _column(replay.widths, scale=MM)),
        _recorded_signal(_column(recording.widths, scale=MM), clock),
    ]
    return _plot("Gripper opening", "mm", signals, clock)


def _clearance_plot(shown: dict[str, Recording], clock: PageClock) -> TimePlot | None:
    margins = (_margin_m(replay) for replay in shown.values() if replay.clearance is not None)
    margin = next((margin for margin in margins if margin is not None), None)
    return _plot(
        "Smallest clearance in the twin",
        "mm",
        _twin_signals(shown, clock, lambda replay: _column(replay.clearance, scale=MM)),
        clock,
        level=0.0 if margin is None else MM * margin,
        level_label="contact" if margin is None else "safety distance",
    )


def _margin_m(replay: Recording) -> float | None:
    settings = replay.derived.settings if replay.derived else {}
    nested = [value for value in settings.values() if isinstance(value, dict)]
    for group in (settings, *nested):
        value = group.get(MARGIN_SETTING)
        if isinstance(value, int | float):
            return float(value)
    return None


def _object_plots(shown: dict[str, Recording], clock: PageClock) -> list[TimePlot | None]:
    plots = []
    for name in dict.fromkeys(name for replay in shown.values() for name in replay.objects):
        heights = partial(_height, name=name)
        signals = _twin_signals(shown, clock, heights)
        if any(np.ptp(signal.values) > 1e-6 for signal in signals):
            plots.append(_plot(f"Height of {name} in the twin", "mm", signals, clock))
    return plots


def _height(replay: Recording, name: str) -> Samples | None:
    track = replay.objects.get(name)
    return None if track is None else (track.stamps_ns, MM * track.p_m[:, 2])


def plots_of_joints(
    recording: Recording, shown: dict[str, Recording], clock: PageClock
) -> tuple[TimePlot, ...]:
    """Draw each joint as planned, recorded and replayed, and how far recording and twin are apart.

    Args:
        recording: The recorded episode; joints are named by it, or by its first plan that names
            them.
    """
    track = recording.joints
    planned = (plan.joint_names for _, plan in recording.plans if plan.joint_names)
    names = next(planned, ()) if track is None else track.names
    errors = _joint_errors(track, shown, clock)
    plots = []
    for index, name in enumerate(names):
        signals = [
            _plan_signal(recording, clock, partial(_planned_joint, name=name)),
            *_twin_signals(shown, clock, partial(_replayed_joint, name=name)),
            _recorded_signal(_column(track, index), clock),
        ]
        title = name.removesuffix("_joint").replace("_", " ")
        note = _most_apart(errors, name)
        plots.append(_plot(title, "rad", signals, clock, note=note, **SMALL))
    apart = [
        Signal(
            name=f"to twin, {trajectory}",
            style=f"twin-{trajectory}",
            t_s=clock.all_seconds(each.stamps_ns),
            values=MRAD * np.sqrt((each.error_rad**2).mean(axis=1)),
        )
        for trajectory, each in errors.items()
    ]
    title, note = "All joints: recorded to replayed, root mean square", "computed by the evaluator"
    plots.append(_plot(title, "mrad", apart, clock, level=0.0, note=note, **SMALL))
    return tuple(plot for plot in plots if plot is not None)


def _joint_errors(
    track: JointTrack | None, shown: dict[str, Recording], clock: PageClock
) -> dict[str, JointErrors]:
    """Let the evaluator compare recorded joints with each replay's, where they share instants."""
    found = {}
    for trajectory, replay in shown.items():
        replayed = replay.joints
        t_s = None if replayed is None else clock.replay_seconds(replay, replayed.stamps_ns)
        if track is None or replayed is None or t_s is None:
            continue
        stamps_ns = clock.zero_ns + np.round(NS_PER_S * t_s).astype(np.int64)
        try:
            found[trajectory] = joint_errors(track, replace(replayed, stamps_ns=stamps_ns))
        except UndefinedStatisticError:  # they share no joint or no instant
            continue
    return found


def _most_apart(errors: Mapping[str, JointErrors], name: str) -> str:
    """Say how far a joint is from each replay's at most."""
    told = [
        f"{MRAD * np.abs(each.error_rad[:, each.names.index(name)]).max():.1f} mrad, {trajectory}"
        for trajectory, each in errors.items()
        if name in each.names
    ]
    return f"recorded and twin apart by at most {'; '.join(told)}" if told else ""


def _replayed_joint(replay: Recording, name: str) -> Samples | None:
    track = replay.joints
    if track is None or name not in track.names:
        return None
    return _column(track, track.names.index(name))


def _planned_joint(plan: Plan, name: str) -> np.ndarray:
    if name not in plan.joint_names:
        return np.full(len(plan.tau), np.nan)
    column = plan.joint_names.index(name)
    return np.array([np.nan if w.joints_rad is None else w.joints_rad[column] for w in plan.tau])


def _column(track: JointTrack | None, column: int = 0, scale: float = 1.0) -> Samples | None:
    return None if track is None else (track.stamps_ns, scale * track.position[:, column])


def _plan_signal(
    recording: Recording, clock: PageClock, values_of: Callable[[Plan], np.ndarray]
) -> Signal | None:
    """Join what every executed plan commanded, with a gap between two plans."""
    times, values = [], []
    for _, plan in recording.plans:
        start = clock.of_plan_time(plan.id, 0)
        if start is None or not plan.tau:
            continue
        times += [plan.times_ns() * 1e-9 + start, np.array([np.nan])]
        values += [values_of(plan), np.array([np.nan])]
    if not times:
        return None
    return Signal(
        name="commanded", style=PLANNED, t_s=np.concatenate(times), values=np.concatenate(values)
    )


def _recorded_signal(samples: Samples | None, clock: PageClock) -> Signal | None:
    if samples is None:
        return None
    stamps_ns, values = samples
    return Signal(name="recorded", style=RECORDED, t_s=clock.all_seconds(stamps_ns), values=values)


def _twin_signals(
    shown: dict[str, Recording], clock: PageClock, samples_of: Callable[[Recording], Samples | None]
) -> list[Signal]:
    """Draw one line per replay that has the samples and a time on this page."""
    signals = []
    for trajectory, replay in shown.items():
        samples = samples_of(replay)
        t_s = None if samples is None else clock.replay_seconds(replay, samples[0])
        if samples is not None and t_s is not None:
            name, style = f"twin, {trajectory}", f"twin-{trajectory}"
            signals.append(Signal(name=name, style=style, t_s=t_s, values=samples[1]))
    return signals


def _plot(
    title: str, unit: str, signals: Sequence[Signal | None], clock: PageClock, **options: Any
) -> TimePlot | None:
    return time_plot(
        title,
        unit,
        [signal for signal in signals if signal is not None],
        span_s=clock.span_s,
        least_span=LEAST_SPAN[unit],
        **options,
    )


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
