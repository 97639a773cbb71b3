"""One episode with its replays as a Rerun file (``.rrd``), on the recorded cell's source time.

``/recorded/...`` is the episode, ``/replayed/<planned|executed>/<dynamic|kinematic>/...`` what the
twin made of it, ``/localised/...`` where it found the objects, ``/scene/background`` the rebuilt
place. Stand-in truth is never shown.
"""

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from jaxtyping import Int

from bridge.episode import streams
from bridge.episode.catalogue import outcome_of
from bridge.episode.metadata import Outcome
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.errors import GstError, UsageError
from bridge.geometry.trajectory import PoseTrajectory
from bridge.task.task_file import Task, load_task
from dashboards.recording import PageClock, Recording, read_recording
from dashboards.rerun_entities import log_cameras, log_object, log_robot, log_splats, model_of
from dashboards.rerun_file import TIMELINE, RerunFile
from dashboards.rerun_side import MIN_CLEARANCE, Side, log_side
from dashboards.wording import condition_word, outcome_word

# --- How the view opens: the place in 3D, the cameras, the series, and what was said.

EYE_M, TARGET_M = (1.5, -1.1, 0.9), (0.35, 0.0, 0.15)
"""Looking at the table in front of the robot from its left."""


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


def layout(shown: Shown) -> rrb.Blueprint:
    """Place 3D view and cameras on the left, series and text on the right."""
    left: list[rrb.View | rrb.Container] = [_space(shown)]
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
    said = [f"+ /{side}/{leaf}" for side in shown.sides for leaf in ("events", "verdicts")]
    right.append(
        rrb.Tabs(
            rrb.TextLogView(origin="/", contents=said, name="events and verdicts"),
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
    contents = ["+ /**"]
    if shown.splats:
        contents += [f"- /{entity}/**" for entity in shown.camera_entities if _is_depth(entity)]
    eye = rrb.EyeControls3D(position=EYE_M, look_target=TARGET_M, eye_up=(0.0, 0.0, 1.0))
    return rrb.Spatial3DView(
        origin="/", contents=contents, name=shown.name, eye_controls=eye if shown.robot else None
    )


def _is_depth(entity: str) -> bool:
    return entity.endswith("/depth")


def _image(entity: str) -> rrb.Spatial2DView:
    camera_id, kind = entity.split("/")[-2:]
    return rrb.Spatial2DView(origin=f"/{entity}", name=f"{camera_id} {kind}")


def _series(name: str, entities: Sequence[str], *, legend: bool = True) -> rrb.TimeSeriesView:
    contents = [f"+ /{entity}" for entity in entities]
    return rrb.TimeSeriesView(
        origin="/", contents=contents, name=name, plot_legend=rrb.PlotLegend(visible=legend)
    )


NOT_IN_A_PATH = r"[^A-Za-z0-9_.-]"
RECORDED = (128, 137, 153)
REPLAYED = {"planned": (29, 100, 216), "executed": (217, 115, 13)}
"""As on the review pages, with a grey that shows on dark and light ground."""


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
        run: Where to look for replays and the rebuilt place; see ``run_of``.

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
        robot = log_robot(
            file,
            streams.robot_description(episode),
            main.prefix,
            joints=recording.joints,
            widths=recording.widths,
        )
        splats = run is not None and log_splats(file, run.scene_dir)
        if run is None:
            file.note("no replays and no rebuilt place: the episode does not lie in a run folder")
        for side in sides:
            log_side(file, side, task)
        _localised(file, recording, task, run)
        file.always("about", _about(recording, _outcome(file, episode, run), sides, file.notes))
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
    return RunFolder(parent.parent) if parent.name in ("episodes", "derived") else None


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
            file.note(f"{path.name} is not shown: it holds no replay")
            continue
        prefix = f"replayed/{derived.trajectory}/{derived.mode}"
        if derived.plan_id != last_plan:
            prefix += f"_of_{re.sub(NOT_IN_A_PATH, '_', str(derived.plan_id))}"
        place = _placer(clock, replay)
        if prefix in taken:
            file.note(f"{path.name} is not shown: there is a newer one")
        elif place is None:
            file.note(f"{path.name} is not shown: its plan was never executed, it has no time here")
        else:
            taken.add(prefix)
            color = _color(derived.trajectory)
            yield Side(prefix=prefix, recording=replay, color=color, place_ns=place)


def _placer(
    clock: PageClock, replay: Recording
) -> Callable[[Int[np.ndarray, " num_stamps"]], Int[np.ndarray, " num_stamps"]] | None:
    """Return what carries a replay's stamps to the recorded source time."""
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
        return load_task(recording.info.task)
    except GstError as error:
        file.note(f"objects are shown as axes, not boxes: {error}")
        return None


def _localised(
    file: RerunFile, recording: Recording, task: Task | None, run: RunFolder | None
) -> None:
    """Log where the twin found the objects, from the moment it looked on."""
    if run is None or recording.derived is not None:
        return
    paths = run.derived(f"{recording.info.id}.localised.*")
    if not paths:
        file.note("objects were not localised")
        return
    newest = max(paths, key=lambda path: path.stat().st_mtime_ns)
    try:
        records = streams.localisations(Episode.open(newest))
    except GstError as error:
        file.note(f"localised objects are not shown: {error}")
        return
    for record in records:
        pose = record.get("T_base_object")
        if not record["found"] or pose is None:
            file.note(f"object {record['object']!r} was not found by the twin")
            continue
        track = PoseTrajectory(
            np.array([record["stamp_ns"]]), np.array([pose["p_m"]]), np.array([pose["q_wxyz"]])
        )
        model = model_of(task, record["object"])
        log_object(file, f"localised/{record['object']}", track, model, solid=False)


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
    recording: Recording, outcome: Outcome | None, sides: list[Side], notes: list[str]
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
    lines += ["", "## Not shown", "", *(f"- {note}" for note in notes or ["nothing is left out"])]
    return rr.TextDocument("\n".join(lines), media_type=rr.MediaType.MARKDOWN)
