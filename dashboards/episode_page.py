"""What the episode page shows, gathered from one recorded episode and its replays."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from bridge.episode.catalogue import outcome_of
from bridge.episode.metadata import Outcome, why_not_counted
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.task.plan import Plan
from bridge.task.verdict import Factor, Verdict
from dashboards import trial_plots
from dashboards.figures import StageChart, TimePlot
from dashboards.frames import RENDERED, CameraTrack
from dashboards.library import derived_paths, episode_path
from dashboards.moments import Cause, Moment, cause_of, moment_of
from dashboards.recording import PageClock, Problems, Recording, read_recording
from dashboards.wording import event_words
from evaluator.trial_row import TrialRow
from twin.scene.store.library import not_scanned_in


@dataclass(frozen=True, kw_only=True)
class VerdictView:
    """One verdict with where it comes from."""

    title: str
    subtitle: str
    verdict: Verdict
    factors: tuple[tuple[str, str, Factor, float | None], ...]
    """Name, meaning, the factor, and the page's time of its first failing instant."""
    of_sent_plan: bool
    counts: bool
    """False for a replay that was redone since, with other settings or in another scene, and for
    one in an engine that never counts."""
    nearest: str
    """Where the smallest clearance was, in words; empty where the verdict does not say."""

    @property
    def is_main(self) -> bool:
        """Whether it is of the plan that was sent, and counts; the others are folded away."""
        return self.of_sent_plan and self.counts


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
class EpisodePage:
    """Everything the episode template needs."""

    recording: Recording
    replays: tuple[Recording, ...]
    row: TrialRow | None
    label: Outcome | None
    """How it ended; a label given after the fact counts."""
    verdicts: tuple[VerdictView, ...]
    gated: bool
    """The plan that was sent had a verdict before motion."""
    stages: StageChart | None
    plots: tuple[TimePlot, ...]
    joint_plots: tuple[TimePlot, ...]
    cameras: tuple[CameraView, ...]
    events: tuple[tuple[float, str, str], ...]
    """Page time [s], what happened, and to what."""
    clock: PageClock
    t_s: float
    failure_t_s: float | None
    divergence: Moment | None
    """The first divergence of recording and twin, where the replays tell one."""
    divergence_t_s: float | None
    cause: Cause | None
    """Why recorded and twin disagree."""
    sent_plan: Plan | None
    not_scanned: tuple[str, ...]
    """Objects that the twin draws from the task's shape, because no scan saw them."""
    problems: tuple[str, ...]


GATE_BEFORE = "Gate, before motion"
FACTORS = {
    "ik": "the arm can reach every pose",
    "clearance": "nothing is touched that should not be",
    "terminal": "the task ends in success",
}


def build_page(
    run: RunFolder, episode_id: str, row: TrialRow | None, t_s: float | None
) -> EpisodePage:
    """Gather the page of one episode.

    Args:
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
    replays = read_replays(derived_paths(run, episode_id, "replay"), recording, problems)
    sent_plan = sent_plan_of(recording)
    clock = PageClock.of(recording)
    verdicts = _verdicts(recording, replays, sent_plan, clock)
    factors = (each for view in verdicts if view.is_main for each in view.factors)
    failures_s = (t for *_, factor, t in factors if factor.value is False and t is not None)
    failure_t_s = next(failures_s, None)
    moment = None if row is None else moment_of(run, row)
    divergence_t_s = None if moment is None else clock.of_plan_time(moment.plan_id, moment.t_ns)
    shown = trial_plots.shown_replays(replays, sent_plan)
    failed = {name for name, answer in (row.stages if row else ()) if answer is False}
    known = (t for t in (t_s, divergence_t_s, failure_t_s) if t is not None)
    cursor = clock.clamp(next(known, clock.end_s))
    not_scanned = problems.attempt(lambda: not_scanned_in(run, Episode.open(path)), list[str]())
    return EpisodePage(
        recording=recording,
        replays=replays,
        row=row,
        label=problems.attempt(lambda: outcome_of(run, Episode.open(path)), recording.outcome),
        verdicts=verdicts,
        gated=any(view.title == GATE_BEFORE and view.of_sent_plan for view in verdicts),
        stages=trial_plots.trial_lanes(recording, shown, clock, failure_t_s, failed),
        plots=trial_plots.main_plots(recording, replays, sent_plan, row, clock),
        joint_plots=trial_plots.plots_of_joints(recording, shown, clock),
        cameras=tuple(
            _camera(track, replays, clock, cursor)
            for name, track in recording.cameras.items()
            if not name.startswith(RENDERED)
        ),
        events=tuple((clock.seconds(e["stamp_ns"]), *event_words(e)) for e in recording.events),
        clock=clock,
        t_s=cursor,
        failure_t_s=failure_t_s,
        divergence=moment,
        divergence_t_s=divergence_t_s,
        cause=None if row is None else cause_of(run, row),
        sent_plan=sent_plan,
        not_scanned=tuple(not_scanned),
        problems=tuple(problems.texts),
    )


def read_replays(
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


def sent_plan_of(recording: Recording) -> Plan | None:
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
        views.append(_view(title, "recorded", verdict, sent_id, clock))
    last = {_trajectory_of(replay): replay for replay in replays}
    for replay in replays:
        never = _why_never(replay, recording)
        counts = last[_trajectory_of(replay)] is replay and not never
        for _, verdict in replay.verdicts:
            title = f"{verdict.trajectory.capitalize()} in the twin"
            subtitle = verdict.mode if counts else f"{verdict.mode}, {never or 'redone since'}"
            views.append(_view(title, subtitle, verdict, sent_id, clock, counts=counts))
    order = {"Planned in the twin": 1, "Executed in the twin": 2}
    views.sort(key=lambda view: (not view.of_sent_plan, not view.counts, order.get(view.title, 0)))
    return tuple(views)


def _view(
    title: str,
    subtitle: str,
    verdict: Verdict,
    sent_id: str | None,
    clock: PageClock,
    *,
    counts: bool = True,
) -> VerdictView:
    factors: dict[str, Factor] = {name: getattr(verdict, name) for name in FACTORS}
    return VerdictView(
        title=title,
        subtitle=subtitle,
        verdict=verdict,
        factors=tuple(
            (name, FACTORS[name], each, clock.of_plan_time(verdict.plan_id, each.first_t_ns))
            for name, each in factors.items()
        ),
        of_sent_plan=sent_id is None or verdict.plan_id == sent_id,
        counts=counts,
        nearest=_nearest_words(verdict),
    )


def _nearest_words(verdict: Verdict) -> str:
    found = verdict.nearest
    if found is None:
        return ""
    one, other = found["bodies"]
    return f"{found['distance_m'] * 1e3:.1f} mm: {one} – {other}"


def _camera(
    track: CameraTrack, replays: Sequence[Recording], clock: PageClock, t_s: float
) -> CameraView:
    return replace(
        camera_view(track, clock, t_s), twin=_twin_view(track.camera_id, replays, clock, t_s)
    )


def camera_view(track: CameraTrack, clock: PageClock, t_s: float) -> CameraView:
    """Lay out a camera's frames, the one nearest to a page time [s] first."""
    times = tuple(round(clock.seconds(stamp), 3) for stamp in track.stamps_ns)
    shown_s = times[track.nearest(clock.stamp_ns(t_s))]
    return CameraView(id=track.camera_id, times_s=times, shown_s=shown_s)


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
            found.append((made.trajectory == trial_plots.PLANNED, age, replay, track))
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
