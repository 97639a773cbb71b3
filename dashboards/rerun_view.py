"""One episode with its replays as a Rerun file (``.rrd``), on the recorded cell's source time.

``/recorded/...`` is the episode, ``/replayed/<planned|executed>/<dynamic|kinematic>/...`` what the
twin made of it, ``/localised/...`` where it found the objects, and the hand carried them,
``/scene/background`` the rebuilt scene, ``/plans/<id>`` what a planner had in mind. Stand-in truth
is never shown.
"""

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from jaxtyping import Int

from bridge.episode import streams
from bridge.episode.catalogue import outcome_of
from bridge.episode.metadata import Outcome, why_not_counted
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.errors import GstError, UsageError
from bridge.geometry.trajectory import PoseTrajectory
from bridge.task.task_file import Task
from bridge.task.verdict import Verdict
from dashboards.recording import PageClock, Recording, read_recording
from dashboards.rerun_entities import log_cameras, log_robot
from dashboards.rerun_file import TIMELINE, RerunFile
from dashboards.rerun_objects import (
    SCENE,
    ShownObjects,
    begun_at,
    gather_objects,
    log_nearest,
    log_recorded,
    log_replayed,
    log_splats,
    soft_nodes,
)
from dashboards.rerun_plan import (
    ARM,
    NOT_IN_A_PATH,
    ROOT,
    ShownPlan,
    counted_plan,
    log_plans,
    shown_plans,
)
from dashboards.wording import condition_word, factor_word, outcome_word, verdict_word

EYE_M, TARGET_M = (1.5, -1.1, 0.9), (0.35, 0.0, 0.15)
"""Looking at the table in front of the robot from its left."""
PLANS_EYE_M, PLANS_TARGET_M = (1.15, -0.45, 0.5), (0.42, 0.02, 0.14)
"""Nearer, for grasps are small."""
GOOD, WARN = "INFO", "WARN"
MIN_CLEARANCE = "clearance_m"
PATH_RADIUS_M, REPLAYED_RADIUS_M, OTHER_RADIUS_M = 0.0025, 0.0015, 0.0006
"""Of ways of the tool; the plan's own is between the first two."""
AXES_M = 0.05
RECORDED_WIDTH, REPLAYED_WIDTH = 3.0, 1.5
"""Points; a replay stays visible on the recorded line."""
JOINT_COLORS = (
    *((31, 119, 180), (255, 127, 14), (44, 160, 44)),
    *((214, 39, 40), (148, 103, 189), (140, 86, 75)),
)
RECORDED = (128, 137, 153)
REPLAYED = {"planned": (29, 100, 216), "executed": (217, 115, 13)}
"""As on the review pages, with a grey that shows on dark and light ground."""


@dataclass(frozen=True, kw_only=True)
class Side:
    """Where one recording goes in the view."""

    prefix: str
    """Its entities start with this: ``recorded``, ``replayed/planned/dynamic``."""
    recording: Recording
    color: tuple[int, int, int]
    place_ns: Callable[[Int[np.ndarray, " num_stamps"]], Int[np.ndarray, " num_stamps"]]
    """Converts its stamps to the recorded cell's source time [ns]."""
    counts: bool = True
    """False for replays of plans that were sent back, and those that never count: their objects
    are outlines from where they begin."""

    @property
    def name(self) -> str:
        """What a legend says: ``recorded``, ``planned dynamic``."""
        return self.prefix.removeprefix("replayed/").replace("/", " ")

    @property
    def has_nearest(self) -> bool:
        """Whether its smallest clearance is shown: of a replay that counts, with physics."""
        derived = self.recording.derived
        is_dynamic = derived is not None and derived.mode == "dynamic"
        return self.counts and is_dynamic and bool(self.recording.verdicts)

    @property
    def path_radius_m(self) -> float:
        """Of its tool's way: recorded, counting and other replays get thinner."""
        if self.recording.derived is None:
            return PATH_RADIUS_M
        return REPLAYED_RADIUS_M if self.counts else OTHER_RADIUS_M

    @property
    def width(self) -> float:
        """Width of its lines [points]."""
        return RECORDED_WIDTH if self.recording.derived is None else REPLAYED_WIDTH


def log_side(
    file: RerunFile,
    side: Side,
    task: Task | None,
    shown: ShownObjects,
    first_ns: int,
) -> None:
    """Log everything of one recording that is a number over time, a pose or a line of text.

    Args:
        file: The Rerun file being written; it notes what could not be read.
        side: The recording or a replay, and where it goes.
        task: Knows the shapes of objects; None draws axes instead.
        shown: What objects look like.
        first_ns: From then on the objects of a replay that counts stand where it begins.
    """
    _log_series(file, side)
    _log_tool(file, side)
    tracks = {name: _placed(side, track) for name, track in side.recording.objects.items()}
    if side.counts:
        tracks = {name: begun_at(track, first_ns) for name, track in tracks.items()}
    else:
        shown = replace(shown, clouds={})
    soft = {
        name: replace(nodes, stamps_ns=side.place_ns(nodes.stamps_ns))
        for name, nodes in soft_nodes(file, side.recording, task, shown).items()
    }
    log_replayed(file, side.prefix, tracks, soft, shown, task, color=side.color)
    start_ns = side.recording.first_stamp_ns()
    if side.has_nearest and start_ns is not None:
        placed_ns = int(side.place_ns(np.array([start_ns]))[0])
        log_nearest(file, side.prefix, side.recording.verdicts[-1][1], placed_ns)
    _log_events(file, side)
    for problem in side.recording.problems:
        file.note(f"{side.recording.path.name}: {problem}")


def _log_series(file: RerunFile, side: Side) -> None:
    recording, prefix = side.recording, side.prefix
    if recording.joints is not None:
        stamps = side.place_ns(recording.joints.stamps_ns)
        for index, name in enumerate(recording.joints.names):
            file.scalars(
                f"{prefix}/joints/{name}",
                stamps,
                recording.joints.position[:, index],
                name=f"{name}, {side.name}",
                color=JOINT_COLORS[index % len(JOINT_COLORS)],
                width=side.width,
            )
    for leaf, track in (
        ("gripper_width_m", recording.widths),
        (MIN_CLEARANCE, recording.clearance),
    ):
        if track is not None:
            file.scalars(
                f"{prefix}/{leaf}",
                side.place_ns(track.stamps_ns),
                track.position[:, 0],
                name=side.name,
                color=side.color,
                width=side.width,
            )


def _log_tool(file: RerunFile, side: Side) -> None:
    if side.recording.tcp is None:
        return
    track = _placed(side, side.recording.tcp)
    entity = f"{side.prefix}/tcp"
    file.poses(entity, track)
    file.rows(entity, track.stamps_ns[:1], rr.TransformAxes3D.columns(axis_length=[AXES_M]))
    strip = rr.LineStrips3D([track.p_m], radii=[side.path_radius_m], colors=[side.color])
    file.always(f"{side.prefix}/tcp_path", strip)


def _placed(side: Side, track: PoseTrajectory) -> PoseTrajectory:
    return PoseTrajectory(side.place_ns(track.stamps_ns), track.p_m, track.q_wxyz)


def _log_events(file: RerunFile, side: Side) -> None:
    recording, prefix = side.recording, side.prefix
    events = [(int(event["stamp_ns"]), event_text(event), GOOD) for event in recording.events]
    _log_text(file, side, f"{prefix}/events", events)
    verdicts = [
        (stamp, verdict_text(verdict), GOOD if verdict.accepted else WARN)
        for stamp, verdict in recording.verdicts
    ]
    _log_text(file, side, f"{prefix}/verdicts", verdicts)
    started = [e for e in recording.events if e["type"] == "stage_started" and e.get("stage_id")]
    ended = [e for e in recording.events if e["type"] == "execution_ended"]
    if started:
        changes = sorted([*started, *ended], key=lambda event: event["stamp_ns"])
        stamps = side.place_ns(np.array([e["stamp_ns"] for e in changes], dtype=np.int64))
        names = [e["stage_id"] if e["type"] == "stage_started" else "ended" for e in changes]
        file.rows(f"{prefix}/stage", stamps, rr.StateChange.columns(state=names))


def _log_text(file: RerunFile, side: Side, entity: str, lines: list[tuple[int, str, str]]) -> None:
    if lines:
        stamps_ns, texts, levels = (list(column) for column in zip(*lines, strict=True))
        columns = rr.TextLog.columns(text=texts, level=levels)
        file.rows(entity, side.place_ns(np.array(stamps_ns, dtype=np.int64)), columns)


def event_text(event: dict[str, Any]) -> str:
    """Write an event as one line: what happened, to which stage and plan, and the note."""
    parts = [str(event["type"]).replace("_", " ")]
    parts += [str(event[name]) for name in ("stage_id", "plan_id") if event.get(name)]
    text = ", ".join(parts)
    return f"{text}: {event['text']}" if event.get("text") else text


def verdict_text(verdict: Verdict) -> str:
    """Write a verdict as one line, with the first factor that fails and why."""
    text = f"{verdict_word(verdict.accepted)}: {verdict.plan_id}, {verdict.trajectory}"
    text += f", {verdict.mode}, {verdict.engine}"
    name = verdict.first_failing
    if name is not None:
        factor = verdict.factors()[name]
        why = factor.detail or factor.cause
        text += f"; {name} {factor_word(factor)}" + (f" ({why})" if why else "")
    elif verdict.accepted is None and verdict.reason:
        text += f"; {verdict.reason}"
    return text


@dataclass(frozen=True, kw_only=True)
class Shown:
    """What a file holds, as far as the layout depends on it."""

    name: str
    sides: tuple[str, ...]
    camera_entities: tuple[str, ...]
    robot: bool
    splats: bool
    clearance: bool
    stages: bool
    plans: bool
    planned_path: str | None
    """Entity of the way of the plan that counts."""
    plans_first: bool
    """Whether the view begins with them."""


def layout(shown: Shown) -> rrb.Blueprint:
    """Place 3D view and cameras on the left, series and text on the right."""
    left: list[rrb.View | rrb.Container] = [_space(shown)]
    if shown.plans:
        left = [rrb.Tabs(left[0], _plans(shown), active_tab=int(shown.plans_first))]
    if shown.camera_entities:
        left.append(rrb.Grid(*(_image(entity) for entity in shown.camera_entities)))
    right: list[rrb.View | rrb.Container] = [
        _series("joints [rad]", [f"{side}/joints/**" for side in shown.sides], legend=False),
        _series("gripper width [m]", [f"{side}/gripper_width_m" for side in shown.sides]),
    ]
    if shown.clearance:
        right.append(_series("clearance [m]", [f"{side}/{MIN_CLEARANCE}" for side in shown.sides]))
    if shown.stages:
        contents = [f"+ /{side}/stage" for side in shown.sides]
        right.append(rrb.StateTimelineView(origin="/", contents=contents, name="stages"))
    texts = [f"+ /{side}/{leaf}" for side in shown.sides for leaf in ("events", "verdicts")]
    right.append(
        rrb.Tabs(
            rrb.TextLogView(origin="/", contents=texts, name="events and verdicts"),
            rrb.TextDocumentView(origin="/about", name="about"),
        )
    )
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(*left, row_shares=[3, 2][: len(left)]),
            rrb.Vertical(*right, row_shares=[*([2] * (len(right) - 1)), 3]),
            column_shares=[3, 2],
        ),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline=TIMELINE),
        auto_views=False,
    )


def _space(shown: Shown) -> rrb.Spatial3DView:
    """Show all poses; depth as points only where there are no splats, which show the same."""
    contents = ["+ /**", f"- /{ROOT}/**", f"- /{ARM}/**"]
    contents += [] if shown.planned_path is None else [f"+ /{shown.planned_path}"]
    if shown.splats:
        contents += [
            f"- /{entity}/**" for entity in shown.camera_entities if entity.endswith("/depth")
        ]
    eye = rrb.EyeControls3D(position=EYE_M, look_target=TARGET_M, eye_up=(0.0, 0.0, 1.0))
    return rrb.Spatial3DView(
        origin="/", contents=contents, name=shown.name, eye_controls=eye if shown.robot else None
    )


def _plans(shown: Shown) -> rrb.Spatial3DView:
    """Plans among the scene's objects, and where the twin's replays of them took the tool."""
    contents = [f"+ /{ROOT}/**", f"+ /{ARM}/**", "+ /scene/**", "+ /localised/**"]
    for side in shown.sides:
        contents += [f"+ /{side}/objects/**"]
        contents += [f"+ /{side}/tcp_path"] if side.startswith("replayed/planned") else []
    eye = rrb.EyeControls3D(
        position=PLANS_EYE_M, look_target=PLANS_TARGET_M, eye_up=(0.0, 0.0, 1.0)
    )
    return rrb.Spatial3DView(origin="/", contents=contents, name="plans", eye_controls=eye)


def _image(entity: str) -> rrb.Spatial2DView:
    camera_id, kind = entity.split("/")[-2:]
    return rrb.Spatial2DView(origin=f"/{entity}", name=f"{camera_id} {kind}")


def _series(name: str, entities: Sequence[str], *, legend: bool = True) -> rrb.TimeSeriesView:
    contents = [f"+ /{entity}" for entity in entities]
    return rrb.TimeSeriesView(
        origin="/", contents=contents, name=name, plot_legend=rrb.PlotLegend(visible=legend)
    )


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

    Args:
        episode_path: A recorded episode, or one replay.
        out: The ``.rrd`` file to write; an older one is replaced.
        run: Where to look for replays and the rebuilt scene; see ``run_of``.

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
        clock = PageClock.of(recording)
        sides = [_main_side(recording), *_replays(file, recording, clock, run)]
        main = sides[0]
        task = _task(file, recording)
        cameras = log_cameras(file, episode, main.prefix, clock.zero_ns)
        urdf = streams.robot_description(episode)
        robot = log_robot(
            file,
            urdf,
            main.prefix,
            joints=recording.joints,
            widths=recording.widths,
        )
        splats = run is not None and log_splats(file, run.scene_dir)
        if run is None:
            file.note("no replays and no rebuilt scene: the episode is not in a run folder")
        shown = gather_objects(file, run, recording)
        if splats:
            file.place(SCENE, shown.T_base_root)
        for side in sides:
            log_side(file, side, task, shown, clock.zero_ns)
        log_recorded(file, shown, task)
        plans = shown_plans(file, recording, clock, run)
        log_plans(file, plans, task, urdf)
        outcome = _outcome(file, episode, run)
        file.always("about", _about(recording, outcome, sides, plans, file.notes))
        file.stream.send_blueprint(
            layout(
                Shown(
                    name=name,
                    sides=tuple(side.prefix for side in sides),
                    camera_entities=tuple(_camera_entities(episode, main.prefix, cameras)),
                    robot=robot,
                    splats=splats,
                    clearance=any(side.recording.clearance is not None for side in sides),
                    stages=any(side.recording.events for side in sides),
                    plans=bool(plans),
                    planned_path=counted_plan(plans).tool_path if plans else None,
                    plans_first=run is not None and run.holds_plan(episode_path),
                )
            )
        )
    return Exported(
        path=out,
        episode=recording.info.id,
        sides=tuple(side.prefix for side in sides),
        cameras=tuple(cameras),
        notes=tuple(file.notes),
        size_bytes=out.stat().st_size,
    )


def run_of(episode_path: Path) -> RunFolder | None:
    """Return the run an episode lies in, or None for a file elsewhere."""
    parent = episode_path.resolve().parent
    return RunFolder(parent.parent) if parent.name in ("episodes", "derived", "plans") else None


def _main_side(recording: Recording) -> Side:
    derived = recording.derived
    if derived is not None and derived.kind == "replay":
        prefix, color = f"replayed/{derived.trajectory}/{derived.mode}", _color(derived.trajectory)
    else:
        prefix, color = "recorded" if derived is None else derived.kind, RECORDED
    return Side(prefix=prefix, recording=recording, color=color, place_ns=np.asarray)


def _color(trajectory: str | None) -> tuple[int, int, int]:
    return REPLAYED.get(trajectory or "", RECORDED)


def _replays(
    file: RerunFile, recording: Recording, clock: PageClock, run: RunFolder | None
) -> Iterator[Side]:
    """Yield the replays of a recorded episode; of two that differ in the scene only, the newest."""
    if run is None or recording.derived is not None:
        return
    paths = run.derived(f"{recording.info.id}.replay.*")
    last_plan = next(reversed(clock.starts_ns), None)
    taken: set[str] = set()
    for path in sorted(paths, key=lambda path: path.stat().st_mtime_ns, reverse=True):
        try:
            replay = read_recording(path)
        except GstError as error:
            file.note(f"a replay is not shown: {error}")
            continue
        derived = replay.derived
        if derived is None or replay.first_stamp_ns() is None:
            file.note(f"{path.name} is not shown: it is not a replay")
            continue
        prefix = f"replayed/{derived.trajectory}/{derived.mode}"
        if derived.plan_id != last_plan:
            prefix += f"_of_{re.sub(NOT_IN_A_PATH, '_', str(derived.plan_id))}"
        if why_not_counted(derived, stand_in=recording.info.stand_in):
            prefix += f"_in_{re.sub(NOT_IN_A_PATH, '_', str(derived.engine))}"
        place = _placer(clock, replay)
        if prefix in taken:
            file.note(f"{path.name} is not shown: there is a newer one")
        elif place is None:
            file.note(f"{path.name} is not shown: its plan was never executed")
        else:
            taken.add(prefix)
            color = _color(derived.trajectory)
            counts = prefix == f"replayed/{derived.trajectory}/{derived.mode}"
            yield Side(prefix=prefix, recording=replay, color=color, place_ns=place, counts=counts)


def _placer(
    clock: PageClock, replay: Recording
) -> Callable[[Int[np.ndarray, " num_stamps"]], Int[np.ndarray, " num_stamps"]] | None:
    """Return what converts a replay's stamps to the recorded source time."""
    first = replay.first_stamp_ns()
    moved = None if first is None else clock.replay_seconds(replay, np.array([first]))
    if first is None or moved is None:
        return None
    shift_ns = clock.stamp_ns(float(moved[0])) - first
    return lambda stamps_ns: np.asarray(stamps_ns) + shift_ns


def _task(file: RerunFile, recording: Recording) -> Task | None:
    if not recording.info.task:
        return None
    try:
        return streams.task_file(Episode.open(recording.path)).task()
    except GstError as error:
        file.note(f"objects are shown as axes, not boxes: {error}")
        return None


def _camera_entities(episode: Episode, prefix: str, cameras: list[str]) -> Iterator[str]:
    for kind in ("color", "depth"):
        for camera_id in cameras:
            if streams.find_camera_topic(episode, camera_id, f"{kind}/image") is not None:
                yield f"{prefix}/cameras/{camera_id}/{kind}"


def _outcome(file: RerunFile, episode: Episode, run: RunFolder | None) -> Outcome | None:
    """Return how the episode ended; a label given after the fact counts."""
    if run is None or episode.derived is not None:
        return episode.outcome
    try:
        return outcome_of(run, episode)
    except GstError as error:
        file.note(f"its label is not shown: {error}")
        return episode.outcome


def _about(
    recording: Recording,
    outcome: Outcome | None,
    sides: list[Side],
    plans: list[ShownPlan],
    notes: list[str],
) -> rr.TextDocument:
    info = recording.info
    lines = [f"# {recording.path.stem}", ""]
    if info.stand_in:
        lines += ["**Stand-in**: recorded from a simulated laboratory, not from a real robot.", ""]
    recorded = {"success": True, "failure": False}.get(outcome.result) if outcome else None
    facts = {
        "task": info.task or "none",
        "condition": condition_word(info.condition),
        "outcome": "not labelled" if outcome is None else outcome_word(recorded),
        "cell": info.cell or "unknown",
        "sha256": recording.sha256,
    }
    lines += [f"- {name}: {value}" for name, value in facts.items()]
    shown = [f"- `/{side.prefix}`: {side.recording.path.name}" for side in sides]
    lines += ["", "## Shown", "", *shown]
    if plans:
        lines += ["", "## Plans", "", *(f"- {each.line()}" for each in plans)]
    lines += ["", "## Not shown", "", *(f"- {note}" for note in notes or ["nothing is left out"])]
    return rr.TextDocument("\n".join(lines), media_type=rr.MediaType.MARKDOWN)
