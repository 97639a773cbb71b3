"""What the episode page shows, gathered from one recorded episode and its replays."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from bridge.episode.catalogue import outcome_of
from bridge.episode.metadata import Outcome, why_not_counted
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.episode.streams import JointTrack
from bridge.geometry.trajectory import PoseTrajectory
from bridge.task.plan import Plan
from bridge.task.verdict import Factor, Verdict
from dashboards.figures import Signal, Span, StageChart, TimePlot, stage_chart, time_plot
from dashboards.frames import RENDERED, CameraTrack
from dashboards.library import derived_paths, episode_path
from dashboards.queue_page import Moment, moment_of
from dashboards.recording import PageClock, Problems, Recording, read_recording
from evaluator.compare.trial import read_tcp_errors
from evaluator.review_index import IndexedTrial

RECORDED, PLANNED = "recorded", "planned"
REPLAY_STYLES = {"planned": "twin-planned", "executed": "twin-executed"}
LEAST_SPAN = {"m": 0.02, "mm": 5.0, "rad": 0.05}
"""A value axis covers at least this much of its unit."""
MARGIN_SETTING = "eps_col_m"
"""The replay setting that holds the safety distance."""
MM = 1000.0
"""Millimetres per metre."""

Samples = tuple[np.ndarray, np.ndarray]
"""Stamps [ns] and values."""


def episode_stages(
    recording: Recording, clock: PageClock, failure_t_s: float | None
) -> StageChart | None:
    """Draw planned stages, recorded stages, and marks for failure, replanning and gripper.

    Args:
        recording: The recorded episode.
        clock: Converts its stamps to the page's time.
        failure_t_s: Page time of the first failure in the twin [s]; None marks none.
    """
    marks = [
        (clock.seconds(event["stamp_ns"]), "replan", "replan")
        for event in recording.events
        if event["type"] == "replan"
    ]
    if failure_t_s is not None:
        marks.append((failure_t_s, "first failure in the twin", "failure"))
    return stage_chart(
        [
            ("planned", _planned_stages(recording, clock)),
            ("recorded", _recorded_stages(recording, clock)),
        ],
        marks,
        span_s=clock.span_s,
    )


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


def _recorded_stages(recording: Recording, clock: PageClock) -> list[Span]:
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
            style = f"stage-{order.get(stage_id, 0) % 4}"
            spans.append(Span(start_s=start, end_s=end, label=stage_id, style=style))
    return spans


def main_plots(
    recording: Recording,
    replays: Sequence[Recording],
    sent_plan: Plan | None,
    row: IndexedTrial | None,
    clock: PageClock,
) -> tuple[TimePlot, ...]:
    """Tool error, tool position, gripper, clearance and objects; only those that have data.

    Args:
        recording: The recorded episode.
        replays: All replays that could be read.
        sent_plan: Only its replays are drawn; None where no plan was sent.
        row: The trial beside its replays, for the tool's error; None where it was not compared.
        clock: Converts stamps to the page's time.
    """
    shown = _shown_replays(replays, sent_plan)
    plots = [
        _error_plot(recording, replays, row, clock),
        _clearance_plot(shown, clock),
        *(_tool_plot(recording, shown, axis, clock) for axis in range(3)),
        _width_plot(recording, shown, clock),
        *_object_plots(shown, clock),
    ]
    return tuple(plot for plot in plots if plot is not None)


def _shown_replays(replays: Sequence[Recording], sent_plan: Plan | None) -> dict[str, Recording]:
    """Pick one planned and one executed replay of the sent plan: dynamic, and the last made."""
    chosen: dict[str, Recording] = {}
    for replay in replays:
        derived = replay.derived
        if derived is None or derived.trajectory is None or sent_plan is None:
            continue
        if derived.plan_id not in (None, sent_plan.id):
            continue
        if derived.mode == "dynamic" or derived.trajectory not in chosen:
            chosen[derived.trajectory] = replay
    return dict(sorted(chosen.items(), reverse=True))


def _error_plot(
    recording: Recording, replays: Sequence[Recording], row: IndexedTrial | None, clock: PageClock
) -> TimePlot | None:
    start = None if row is None or row.plan_id is None else clock.of_plan_time(row.plan_id, 0)
    if row is None or start is None:
        return None
    names = {"planned": row.planned_replay, "executed": row.executed_replay}
    paths = {replay.path.name: replay.path for replay in replays}
    compared = {against: paths[name] for against, name in names.items() if name in paths}
    signals = [
        Signal(
            name=f"to twin, {series.against}",
            style=REPLAY_STYLES.get(series.against, "twin-executed"),
            t_s=series.t_s + start,
            values=MM * series.position_m,
        )
        for series in read_tcp_errors(recording.path, row.plan_id, compared)
    ]
    title, note = "Tool: recorded to replayed distance", "computed by the evaluator"
    return _plot(title, "mm", signals, clock, level=0.0, note=note)


def _tool_plot(
    recording: Recording, shown: dict[str, Recording], axis: int, clock: PageClock
) -> TimePlot | None:
    signals = [
        _plan_signal(recording, clock, lambda plan: plan.positions_m()[:, axis]),
        *_twin_signals(shown, clock, lambda replay: _position(replay.tcp, axis)),
        _recorded_signal(_position(recording.tcp, axis), clock),
    ]
    return _plot(f"Tool {'xyz'[axis]}", "m", signals, clock)


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
    return _position(replay.objects.get(name), 2, scale=MM)


def plots_of_joints(recording: Recording, clock: PageClock) -> tuple[TimePlot, ...]:
    """Draw one small plot per joint: planned and recorded.

    Args:
        recording: The recorded episode; joints are named by it, or by its first plan that names
            them.
        clock: Converts its stamps to the page's time.
    """
    track = recording.joints
    planned = (plan.joint_names for _, plan in recording.plans if plan.joint_names)
    names = next(planned, ()) if track is None else track.names
    plots = []
    for index, name in enumerate(names):
        signals = [
            _plan_signal(recording, clock, partial(_planned_joint, name=name)),
            _recorded_signal(_column(track, index), clock),
        ]
        title = name.removesuffix("_joint").replace("_", " ")
        plots.append(_plot(title, "rad", signals, clock, width=370, height=150))
    return tuple(plot for plot in plots if plot is not None)


def _planned_joint(plan: Plan, name: str) -> np.ndarray:
    if name not in plan.joint_names:
        return np.full(len(plan.tau), np.nan)
    column = plan.joint_names.index(name)
    return np.array([np.nan if w.joints_rad is None else w.joints_rad[column] for w in plan.tau])


def _position(track: PoseTrajectory | None, axis: int, scale: float = 1.0) -> Samples | None:
    return None if track is None else (track.stamps_ns, scale * track.p_m[:, axis])


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
            style = REPLAY_STYLES.get(trajectory, "twin-executed")
            name = f"twin, {trajectory}"
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


@dataclass(frozen=True, kw_only=True)
class FactorView:
    """One factor of a verdict; ``t_s`` is the page's time of the first failing instant."""

    name: str
    meaning: str
    factor: Factor
    plan_t_s: float | None
    t_s: float | None


@dataclass(frozen=True, kw_only=True)
class VerdictView:
    """One verdict with where it comes from."""

    title: str
    subtitle: str
    verdict: Verdict
    factors: tuple[FactorView, ...]
    file: str
    of_sent_plan: bool
    counts: bool
    """False for a replay that was redone since, with other settings or in another scene, and for
    one in an engine that never counts."""


@dataclass(frozen=True, kw_only=True)
class TwinView:
    """The twin's pictures from one recorded camera, drawn at the instants of recorded ones."""

    file: str
    """The replay that holds them."""
    trajectory: str
    times_s: tuple[float, ...]
    stamps_ns: tuple[int, ...]
    shown: int
    """Index of the one to show first."""


@dataclass(frozen=True, kw_only=True)
class CameraView:
    """One camera: its frames' page times, and the one to show first."""

    id: str
    times_s: tuple[float, ...]
    shown_s: float
    twin: TwinView | None = None


@dataclass(frozen=True, kw_only=True)
class EventView:
    """One line of the event list."""

    t_s: float
    type: str
    text: str


@dataclass(frozen=True, kw_only=True)
class EpisodePage:
    """Everything the episode template needs."""

    recording: Recording
    replays: tuple[Recording, ...]
    row: IndexedTrial | None
    label: Outcome | None
    """How it ended; a label given after the fact counts."""
    verdicts: tuple[VerdictView, ...]
    gated: bool
    """The plan that was sent had a verdict before motion."""
    stages: StageChart | None
    plots: tuple[TimePlot, ...]
    joint_plots: tuple[TimePlot, ...]
    cameras: tuple[CameraView, ...]
    events: tuple[EventView, ...]
    clock: PageClock
    t_s: float
    failure_t_s: float | None
    divergence: Moment | None
    """The first divergence of recording and twin, where the replays tell one."""
    divergence_t_s: float | None
    sent_plan: Plan | None
    problems: tuple[str, ...]


GATE_BEFORE = "Gate, before motion"
FACTORS = (
    ("ik", "the arm can reach every pose"),
    ("clearance", "nothing is touched that should not be"),
    ("terminal", "the task ends in success"),
)


def build_page(
    run: RunFolder, episode_id: str, row: IndexedTrial | None, t_s: float | None
) -> EpisodePage:
    """Gather the page of one episode.

    Args:
        run: The run folder.
        episode_id: Id of the recorded episode, as it stands in the address.
        row: The trial beside its replays; None where it was not compared.
        t_s: Page time of the cursor [s]; None puts it at the first divergence, else at the first
            failure, else at the end.

    Raises:
        NotHereError: When the run has no such episode.
        GstError: When the recorded file cannot be opened.
    """
    path = episode_path(run, episode_id)
    recording = read_recording(path)
    problems = Problems(list(recording.problems))
    replays = _read_replays(derived_paths(run, episode_id, "replay"), recording, problems)
    sent_plan = _sent_plan(recording)
    clock = PageClock.of(recording)
    verdicts = _verdicts(recording, replays, sent_plan, clock)
    factors = [f for view in verdicts if view.of_sent_plan and view.counts for f in view.factors]
    failures_s = [f.t_s for f in factors if f.factor.value is False and f.t_s is not None]
    failure_t_s = next(iter(failures_s), None)
    moment = None if row is None else moment_of(run, row)
    divergence_t_s = None if moment is None else clock.of_plan_time(moment.plan_id, moment.t_ns)
    known = (t for t in (t_s, divergence_t_s, failure_t_s) if t is not None)
    cursor = clock.clamp(next(known, clock.end_s))
    return EpisodePage(
        recording=recording,
        replays=replays,
        row=row,
        label=problems.attempt(lambda: outcome_of(run, Episode.open(path)), recording.outcome),
        verdicts=verdicts,
        gated=any(view.title == GATE_BEFORE and view.of_sent_plan for view in verdicts),
        stages=episode_stages(recording, clock, failure_t_s),
        plots=main_plots(recording, replays, sent_plan, row, clock),
        joint_plots=plots_of_joints(recording, clock),
        cameras=tuple(
            _camera(track, replays, clock, cursor)
            for name, track in recording.cameras.items()
            if not name.startswith(RENDERED)
        ),
        events=tuple(_event(event, clock) for event in recording.events),
        clock=clock,
        t_s=cursor,
        failure_t_s=failure_t_s,
        divergence=moment,
        divergence_t_s=divergence_t_s,
        sent_plan=sent_plan,
        problems=tuple(problems.texts),
    )


def _read_replays(
    paths: Sequence[Path], recording: Recording, problems: Problems
) -> tuple[Recording, ...]:
    """Read the replays of a recording in the order in which they were made.

    Replays that never count, and those of other bytes than the file holds now, come first. Of
    several replays of one trajectory the last counts, as in the evaluator.
    """
    found = []
    for path in sorted(paths, key=lambda path: (path.stat().st_mtime_ns, path.name)):
        replay = problems.attempt(lambda path=path: read_recording(path), None)  # type: ignore[misc]
        if replay is not None:
            found.append(replay)
            problems.texts.extend(replay.problems)
    found.sort(key=lambda replay: _may_count(replay, recording))
    return tuple(found)


def _why_never(replay: Recording, recording: Recording) -> str:
    made = replay.derived
    return "" if made is None else why_not_counted(made, stand_in=recording.info.stand_in)


def _may_count(replay: Recording, recording: Recording) -> bool:
    made = replay.derived
    is_current = made is not None and made.source_sha256 == recording.sha256
    return is_current and not _why_never(replay, recording)


def _trajectory_of(replay: Recording) -> tuple[str | None, ...]:
    made = replay.derived
    return (replay.path.name,) if made is None else (made.plan_id, made.trajectory, made.mode)


def _sent_plan(recording: Recording) -> Plan | None:
    """Return the last plan whose execution started, or the last one when none did."""
    plans = [plan for _, plan in recording.plans]
    sent = [plan for plan in plans if recording.executed_ns(plan.id)]
    return next(reversed(sent or plans), None)


def _verdicts(
    recording: Recording,
    replays: Sequence[Recording],
    sent_plan: Plan | None,
    clock: PageClock,
) -> tuple[VerdictView, ...]:
    sent_id = sent_plan.id if sent_plan else None
    views = []
    for stamp_ns, verdict in recording.verdicts:
        started = recording.executed_ns(verdict.plan_id)
        before = started is None or stamp_ns <= started[0]
        title = GATE_BEFORE if before else "Gate, after motion began"
        views.append(_view(title, "recorded", verdict, recording, sent_id, clock))
    last = {_trajectory_of(replay): replay for replay in replays}
    for replay in replays:
        never = _why_never(replay, recording)
        counts = last[_trajectory_of(replay)] is replay and not never
        for _, verdict in replay.verdicts:
            title = f"{verdict.trajectory.capitalize()} in the twin"
            subtitle = verdict.mode if counts else f"{verdict.mode}, {never or 'redone since'}"
            views.append(_view(title, subtitle, verdict, replay, sent_id, clock, counts=counts))
    order = {"Planned in the twin": 1, "Executed in the twin": 2}
    views.sort(key=lambda view: (not view.of_sent_plan, not view.counts, order.get(view.title, 0)))
    return tuple(views)


def _view(
    title: str,
    subtitle: str,
    verdict: Verdict,
    source: Recording,
    sent_id: str | None,
    clock: PageClock,
    *,
    counts: bool = True,
) -> VerdictView:
    factors = []
    for name, meaning in FACTORS:
        factor: Factor = getattr(verdict, name)
        plan_t_s = None if factor.first_t_ns is None else factor.first_t_ns * 1e-9
        factors.append(
            FactorView(
                name=name,
                meaning=meaning,
                factor=factor,
                plan_t_s=plan_t_s,
                t_s=clock.of_plan_time(verdict.plan_id, factor.first_t_ns),
            )
        )
    return VerdictView(
        title=title,
        subtitle=subtitle,
        verdict=verdict,
        factors=tuple(factors),
        file=source.path.name,
        of_sent_plan=sent_id is None or verdict.plan_id == sent_id,
        counts=counts,
    )


def _camera(
    track: CameraTrack, replays: Sequence[Recording], clock: PageClock, t_s: float
) -> CameraView:
    times = tuple(round(clock.seconds(stamp), 3) for stamp in track.stamps_ns)
    return CameraView(
        id=track.camera_id,
        times_s=times,
        shown_s=times[track.nearest(clock.stamp_ns(t_s))],
        twin=_twin_view(track.camera_id, replays, clock, t_s),
    )


def _twin_view(
    camera_id: str, replays: Sequence[Recording], clock: PageClock, t_s: float
) -> TwinView | None:
    """Find the pictures that a replay drew through this camera: the plan's before the execution's.

    Those of a plan that was never executed have no time on this page.
    """
    found = []
    for age, replay in enumerate(replays):
        track = replay.cameras.get(RENDERED + camera_id)
        made = replay.derived
        if track is None or made is None or made.plan_id not in clock.starts_ns:
            continue
        if clock.recorded_ns[0] <= track.stamps_ns[0] <= clock.recorded_ns[1]:
            found.append((made.trajectory == PLANNED, age, replay, track))
    if not found:
        return None
    _, _, replay, track = max(found, key=lambda each: each[:2])
    return TwinView(
        file=replay.path.name,
        trajectory=(replay.derived.trajectory if replay.derived else None) or "",
        times_s=tuple(round(clock.seconds(stamp), 3) for stamp in track.stamps_ns),
        stamps_ns=track.stamps_ns,
        shown=track.nearest(clock.stamp_ns(t_s)),
    )


def _event(event: dict[str, Any], clock: PageClock) -> EventView:
    parts = [str(event[name]) for name in ("stage_id", "plan_id", "text") if event.get(name)]
    for name in ("outcome", "data"):
        if event.get(name):
            parts.append(", ".join(f"{key} {value}" for key, value in event[name].items()))
    return EventView(
        t_s=clock.seconds(event["stamp_ns"]),
        type=event["type"].replace("_", " "),
        text=" · ".join(parts),
    )
