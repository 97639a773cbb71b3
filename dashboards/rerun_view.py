"""One episode with its replays as a Rerun file (``.rrd``), on the recorded cell's source time.

``/recorded/...`` is the episode, ``/replayed/<planned|executed>/<dynamic|kinematic>/...`` what the
twin made of it, ``/plans/<id>`` the way of the tool in each plan. Stand-in truth is never shown.
"""

import re
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from bridge.episode import streams
from bridge.episode.catalogue import outcome_of
from bridge.episode.metadata import Outcome
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.errors import UsageError
from bridge.media.palette import Rgb, rgb
from bridge.task.plan import Plan
from bridge.task.task_file import Task
from dashboards.episode_page import read_replays, sent_plan_of
from dashboards.library import derived_paths
from dashboards.recording import PageClock, Problems, Recording, read_recording
from dashboards.rerun_entities import log_cameras, log_robot
from dashboards.rerun_file import TIMELINE, RerunFile
from dashboards.trial_plots import shown_replays
from dashboards.wording import condition_word, event_words, outcome_word, verdict_text
from twin.scene.store.library import FROM_TASK, NOT_SCANNED, not_scanned_in

EYE_M, TARGET_M = (1.5, -1.1, 0.9), (0.35, 0.0, 0.15)
"""Looking at the table in front of the robot from its left."""
RECORDED_WIDTH, REPLAYED_WIDTH = 3.0, 1.5
"""Points; a replay stays visible on the recorded line."""
PLAN_RADIUS_M = 0.002
AXES_M = 0.05
SERIES = {
    "joints/**": "joints [rad]",
    "gripper_width_m": "gripper width [m]",
    "clearance_m": "clearance [m]",
}
"""Ends of the entities in each plot, and its title."""
NOT_IN_A_PATH = r"[^A-Za-z0-9_.-]"


@dataclass(frozen=True, kw_only=True)
class Side:
    """Where one recording goes in the view."""

    prefix: str
    """Its entities start with this: ``recorded``, ``replayed/planned/dynamic``."""
    recording: Recording
    color: Rgb
    width: float = RECORDED_WIDTH
    """Of its lines [points]."""
    shift_ns: int = 0
    """Brings its stamps to the recorded cell's source time."""


@dataclass(frozen=True, kw_only=True)
class Exported:
    """What was written."""

    path: Path
    episode: str
    sides: tuple[str, ...]
    cameras: tuple[str, ...]
    notes: tuple[str, ...]
    """What is not shown, and why."""
    size_bytes: int


def export_rrd(episode_path: Path, out: Path, run: RunFolder | None = None) -> Exported:
    """Write an episode, and the replays its run has of it, as a Rerun recording.

    Raises:
        GstError: When the episode cannot be opened, or ``out`` not be written.
    """
    if out.suffix != ".rrd":
        message = f"--out {out} should end in .rrd; Rerun tells files by their ending."
        raise UsageError(message)
    episode = Episode.open(episode_path)
    recording = read_recording(episode_path)
    identity = f"{episode_path.stem}-{recording.sha256[:12]}"
    name = f"{episode_path.stem} (stand-in)" if recording.info.stand_in else episode_path.stem
    with RerunFile(out, recording_id=identity, name=name) as file:
        problems = Problems(file.notes)
        sides = list(_sides(file, recording, run))
        images = log_cameras(file, episode, sides[0].prefix, PageClock.of(recording).zero_ns)
        log_robot(file, streams.robot_description(episode), sides[0].prefix, recording)
        task, outcome = None, episode.outcome
        if recording.info.task:  # it knows the shapes of objects
            task = problems.attempt(lambda: streams.task_file(episode).task(), None)
        if run is not None and episode.derived is None:  # a label given after the fact counts
            outcome = problems.attempt(lambda: outcome_of(run, episode), outcome)
        not_scanned: list[str] = []
        if run is not None:
            not_scanned = problems.attempt(lambda: not_scanned_in(run, episode), not_scanned)
        for side in sides:
            log_side(file, side, task, not_scanned)
        for key in not_scanned:
            file.note(f"how {key} looks: {FROM_TASK}")
        _log_plans(file, recording)
        file.always("about", _about(recording, outcome, sides, file.notes))
        file.stream.send_blueprint(_layout(name, sides, images))
    return Exported(
        path=out,
        episode=recording.info.id,
        sides=tuple(side.prefix for side in sides),
        cameras=tuple(streams.camera_ids(episode)),
        notes=tuple(file.notes),
        size_bytes=out.stat().st_size,
    )


def run_of(episode_path: Path) -> RunFolder | None:
    """Return the run an episode lies in, or None for a file elsewhere."""
    parent = episode_path.resolve().parent
    return RunFolder(parent.parent) if parent.name in ("episodes", "derived", "plans") else None


def _sides(file: RerunFile, recording: Recording, run: RunFolder | None) -> Iterator[Side]:
    """Yield the recording, or the replay, and the replays that a trial's page shows beside it."""
    derived = recording.derived
    if derived is not None and derived.kind == "replay":
        yield _replay_side(recording, derived.trajectory, 0)
        return
    prefix = "recorded" if derived is None else derived.kind
    yield Side(prefix=prefix, recording=recording, color=rgb("recorded"))
    if run is None:
        file.note("no replays: the episode is not in a run folder")
        return
    clock = PageClock.of(recording)
    paths = derived_paths(run, recording.info.id, "replay")
    replays = read_replays(paths, recording, Problems(file.notes))
    shown = shown_replays(replays, sent_plan_of(recording))
    for trajectory, replay in shown.items():
        first = replay.first_stamp_ns()
        moved = None if first is None else clock.replay_seconds(replay, np.array([first]))
        if first is None or moved is None:
            file.note(f"{replay.path.name} is not shown: its plan was never executed")
        else:
            yield _replay_side(replay, trajectory, clock.stamp_ns(float(moved[0])) - first)
    if len(replays) > len(shown):
        count = len(replays) - len(shown)
        file.note(f"not shown: {count} more of the same plans, kinematic or older, or of others")


def _replay_side(replay: Recording, trajectory: str | None, shift_ns: int) -> Side:
    mode = None if replay.derived is None else replay.derived.mode
    color = rgb("twin-executed" if trajectory == "executed" else "twin-planned")
    prefix = f"replayed/{trajectory}/{mode}"
    return Side(
        prefix=prefix, recording=replay, color=color, width=REPLAYED_WIDTH, shift_ns=shift_ns
    )


def log_side(
    file: RerunFile, side: Side, task: Task | None, not_scanned: Collection[str] = ()
) -> None:
    """Log everything of one recording that is a number over time, a pose or a line of text."""
    recording, prefix = side.recording, side.prefix
    joints = recording.joints
    for track, leaves in (
        (joints, () if joints is None else tuple(f"joints/{name}" for name in joints.names)),
        (recording.widths, ("gripper_width_m",)),
        (recording.clearance, ("clearance_m",)),
    ):
        if track is None:
            continue
        for leaf, values in zip(leaves, track.position.T, strict=False):
            entity = f"{prefix}/{leaf}"
            line = rr.SeriesLines(names=[entity], colors=[side.color], widths=[side.width])
            file.always(entity, line)
            columns = rr.Scalars.columns(scalars=values)
            file.rows(entity, track.stamps_ns + side.shift_ns, columns)
    if recording.tcp is not None:
        file.poses(f"{prefix}/tcp", recording.tcp, side.shift_ns)
        file.always(f"{prefix}/tcp", rr.TransformAxes3D(AXES_M))
        # A radius below 0 is in points of the screen.
        way = rr.LineStrips3D([recording.tcp.p_m], radii=[-side.width], colors=[side.color])
        file.always(f"{prefix}/tcp_path", way)
    for name, poses in recording.objects.items():
        file.poses(f"{prefix}/objects/{name}", poses, side.shift_ns)
        file.always(f"{prefix}/objects/{name}", _shape(name, task, side.color, name in not_scanned))
    for event in recording.events:
        stamp_ns = int(event["stamp_ns"]) + side.shift_ns
        file.at(
            f"{prefix}/events", stamp_ns, rr.TextLog(": ".join(filter(None, event_words(event))))
        )
    for stamp_ns, verdict in recording.verdicts:
        level = rr.TextLogLevel.INFO if verdict.accepted else rr.TextLogLevel.WARN
        text = rr.TextLog(verdict_text(verdict), level=level)
        file.at(f"{prefix}/verdicts", stamp_ns + side.shift_ns, text)
    for problem in recording.problems:
        file.note(f"{recording.path.name}: {problem}")


def _shape(
    name: str, task: Task | None, color: Rgb, not_scanned: bool
) -> rr.Boxes3D | rr.TransformAxes3D:
    """The outlines of an object's boxes, where the task knows them."""
    model = None if task is None else task.objects.get(name)
    if model is None:
        return rr.TransformAxes3D(AXES_M)
    panels = model.panels()
    return rr.Boxes3D(
        centers=np.array([centre for centre, _ in panels]),
        half_sizes=np.array([size / 2 for _, size in panels]),
        colors=rgb("unknown") if not_scanned else color,
        labels=[f"{name}: {NOT_SCANNED}"] if not_scanned else None,
        show_labels=not_scanned,
        fill_mode=rr.components.FillMode.MajorWireframe,
    )


def _log_plans(file: RerunFile, recording: Recording) -> None:
    """Log the way of the tool in each plan from when it was published on, as the twin judged it."""
    accepted = {verdict.plan_id: verdict.accepted for _, verdict in recording.verdicts}
    for stamp_ns, plan in recording.plans:
        color = rgb({True: "good", False: "bad", None: "planned"}[accepted.get(plan.id)])
        way = rr.LineStrips3D(
            [plan.positions_m()],
            radii=[PLAN_RADIUS_M],
            colors=[color],
            labels=[_plan_text(plan)],
            show_labels=False,
        )
        file.at(f"plans/{re.sub(NOT_IN_A_PATH, '_', plan.id)}", stamp_ns, way)


def _plan_text(plan: Plan) -> str:
    words = [plan.id, plan.planner, f"policy {plan.policy}", f"round {plan.round}"]
    words += [] if plan.parent_id is None else [f"after {plan.parent_id}"]
    words += [] if plan.steered_by is None else [f"steered by {plan.steered_by.clause}"]
    return ", ".join(words)


def _layout(name: str, sides: Sequence[Side], images: Sequence[str]) -> rrb.Blueprint:
    """Place 3D view and cameras on the left, series and text on the right."""
    eye = rrb.EyeControls3D(position=EYE_M, look_target=TARGET_M, eye_up=(0.0, 0.0, 1.0))
    space = rrb.Spatial3DView(origin="/", name=name, eye_controls=eye)
    pictures = rrb.Grid(*(rrb.Spatial2DView(origin=f"/{entity}") for entity in images))
    right = [
        rrb.TimeSeriesView(
            origin="/",
            contents=[f"+ /{side.prefix}/{leaf}" for side in sides],
            name=title,
            plot_legend=rrb.PlotLegend(visible=False),
        )
        for leaf, title in SERIES.items()
    ]
    text = rrb.Tabs(
        rrb.TextLogView(origin="/", name="events and verdicts"),
        rrb.TextDocumentView(origin="/about", name="about"),
    )
    left = rrb.Vertical(space, pictures) if images else space
    return rrb.Blueprint(
        rrb.Horizontal(left, rrb.Vertical(*right, text), column_shares=[3, 2]),
        rrb.TimePanel(state="collapsed", timeline=TIMELINE),
        collapse_panels=True,
        auto_views=False,
    )


def _about(
    recording: Recording, outcome: Outcome | None, sides: Sequence[Side], notes: Sequence[str]
) -> rr.TextDocument:
    info = recording.info
    recorded = {"success": True, "failure": False}.get(outcome.result) if outcome else None
    lines = [f"# {recording.path.stem}", ""]
    if info.stand_in:
        lines += ["**Stand-in**: recorded from a simulated laboratory, not from a real robot.", ""]
    lines += [
        f"- task: {info.task or 'none'}",
        f"- condition: {condition_word(info.condition)}",
        f"- outcome: {'not labelled' if outcome is None else outcome_word(recorded)}",
        f"- sha256: {recording.sha256}",
    ]
    lines += [f"- `/{side.prefix}`: {side.recording.path.name}" for side in sides]
    lines += [f"- {_plan_text(plan)}" for _, plan in recording.plans]
    lines += ["", "## Not shown", "", *(f"- {note}" for note in notes or ["nothing is left out"])]
    return rr.TextDocument("\n".join(lines), media_type=rr.MediaType.MARKDOWN)
