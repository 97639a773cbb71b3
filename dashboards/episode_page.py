"""What the episode page shows, gathered from one recorded episode and its replays."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bridge.episode.catalogue import outcome_of
from bridge.episode.metadata import Outcome
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.task.plan import Plan
from bridge.task.verdict import Factor, Verdict
from dashboards import episode_plots
from dashboards.clock import PageClock
from dashboards.comparison import agrees
from dashboards.figures import StageChart, TimePlot
from dashboards.frames import CameraTrack
from dashboards.library import derived_paths, episode_path
from dashboards.recording import Problems, Recording, read_recording
from evaluator.compare import TrialRow


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
    """False of a replay that was made again since, with other settings or in another scene."""


@dataclass(frozen=True, kw_only=True)
class CameraView:
    """One camera: its frames' page times, and the one to show first."""

    id: str
    times_s: tuple[float, ...]
    shown_s: float


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
    row: TrialRow | None
    label: Outcome | None
    """How it ended; a label given after the fact counts."""
    agrees: bool | None
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
    sent_plan: Plan | None
    problems: tuple[str, ...]


GATE_BEFORE = "Gate, before motion"
FACTORS = (
    ("ik", "the arm can reach every pose"),
    ("clearance", "nothing is touched that should not be"),
    ("terminal", "the task ends in success"),
)


def build_page(
    run: RunFolder, episode_id: str, row: TrialRow | None, t_s: float | None
) -> EpisodePage:
    """Gather the page of one episode.

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
    telling = (view for view in verdicts if view.of_sent_plan and view.counts)
    failure_t_s = next((f.t_s for view in telling for f in view.factors if _fails(f)), None)
    cursor = clock.clamp(_first_known(t_s, failure_t_s, clock.end_s))
    return EpisodePage(
        recording=recording,
        replays=replays,
        row=row,
        label=problems.attempt(lambda: outcome_of(run, Episode.open(path)), recording.outcome),
        agrees=None if row is None else agrees(row),
        verdicts=verdicts,
        gated=any(view.title == GATE_BEFORE and view.of_sent_plan for view in verdicts),
        stages=episode_plots.stages(recording, clock, failure_t_s),
        plots=episode_plots.main_plots(recording, replays, sent_plan, row, clock),
        joint_plots=episode_plots.joint_plots(recording, clock),
        cameras=tuple(_camera(track, clock, cursor) for track in recording.cameras.values()),
        events=tuple(_event(event, clock) for event in recording.events),
        clock=clock,
        t_s=cursor,
        failure_t_s=failure_t_s,
        sent_plan=sent_plan,
        problems=tuple(problems.texts),
    )


def _first_known(*values: float | None) -> float:
    return next(value for value in values if value is not None)


def _fails(view: FactorView) -> bool:
    return view.factor.value is False and view.t_s is not None


def _read_replays(
    paths: Sequence[Path], recording: Recording, problems: Problems
) -> tuple[Recording, ...]:
    """Read what was made of a recording, in the order in which it was made.

    What was made of other bytes than the file holds now comes first. Of several replays of one
    trajectory the last counts, for the evaluator as here.
    """
    found = []
    for path in sorted(paths, key=lambda path: (path.stat().st_mtime_ns, path.name)):
        replay = problems.attempt(lambda path=path: read_recording(path), None)  # type: ignore[misc]
        if replay is not None:
            found.append(replay)
            problems.texts.extend(replay.problems)
    found.sort(key=lambda replay: _source_of(replay) == recording.sha256)
    return tuple(found)


def _source_of(replay: Recording) -> str | None:
    return None if replay.derived is None else replay.derived.source_sha256


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
        counts = last[_trajectory_of(replay)] is replay
        for _, verdict in replay.verdicts:
            title = f"{verdict.trajectory.capitalize()} in the twin"
            subtitle = verdict.mode if counts else f"{verdict.mode}, made again since"
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


def _camera(track: CameraTrack, clock: PageClock, t_s: float) -> CameraView:
    times = tuple(round(clock.seconds(stamp), 3) for stamp in track.stamps_ns)
    return CameraView(
        id=track.camera_id, times_s=times, shown_s=times[track.nearest(clock.stamp_ns(t_s))]
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
