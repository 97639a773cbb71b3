"""The queue: which trial to look at first, why, and a picture of the moment it went wrong."""

import hashlib
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from bridge.clock import NS_PER_S
from bridge.episode import schema, streams
from bridge.episode.executions import executed_events
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.errors import GstError
from bridge.exchange.reviews import Review
from bridge.media.color import encode_jpeg, open_image
from bridge.task.record import parse_record
from bridge.whole_file import write_whole
from dashboards.comparison import Judgement
from dashboards.errors import NotHereError
from dashboards.frames import RENDERED, CameraTrack, camera_tracks, read_frame
from dashboards.library import episode_path
from evaluator.review_index import severity, stamp_of
from evaluator.trial_row import TrialRow

PER_PAGE = 24
SHOW = {
    "": "all",
    "wrong_yes": "wrong yes",
    "disagree": "disagreements",
    "diverged": "largest divergence",
    "flagged": "flagged",
}
REASONS = (
    "wrong yes: the twin succeeds, the trial failed",
    "wrong no: the twin fails, the trial succeeded",
    "undecided: a side is unknown",
    "agree",
)
"""Why a trial is where it is in the queue, worst first. A wrong yes sends a bad plan to a robot."""
THUMBNAILS = "thumbnails"
"""Folder in the run's ``results/``."""
THUMBNAIL_PX = 360
"""Width of a thumbnail: twice what a card shows, for dense screens."""
THUMBNAIL_QUALITY = 78
SUBSAMPLING = "420"
"""Of small pictures: colour half as fine as brightness, as in the videos."""
_DRAWING = threading.Lock()


@dataclass(frozen=True, kw_only=True)
class Moment:
    """When recording and twin first differ, as the replays of the plan sent tell it."""

    plan_id: str
    t_ns: int
    """Since the start of the plan."""
    text: str
    """What differs then."""

    @property
    def t_s(self) -> float:
        """Seconds into the plan."""
        return self.t_ns / NS_PER_S


@dataclass(frozen=True, kw_only=True)
class QueueItem:
    """One trial of the queue."""

    row: TrialRow
    reason: str
    moment: Moment | None
    moment_t_s: float | None
    """When that is on the trial's own page; None where its plan was never executed."""
    num_labels: int
    """How many raters labelled it; what they said is not shown here."""
    flagged: bool


@dataclass(frozen=True, kw_only=True)
class QueuePage:
    """Everything the queue's template needs."""

    items: tuple[QueueItem, ...]
    show: str
    counts: Mapping[str, int]
    """How many trials each choice of ``SHOW`` holds."""
    page: int
    num_pages: int
    only_from_table: bool
    """Whether all trials of the run come from a table: there is nothing to look at."""
    problems: tuple[str, ...]


def recorded_trials(judgement: Judgement) -> list[TrialRow]:
    """Return the trials that have a recording to look at: wrong yes, wrong no, undecided, the rest.

    Within each the one whose tool went farthest from its planned replay comes first.
    """
    return [row for row in judgement.rows if row.file]


def build_queue(
    run: RunFolder,
    judgement: Judgement,
    reviews: tuple[Sequence[Review], Sequence[str]],
    *,
    show: str,
    page: int,
) -> QueuePage:
    """Gather one page of the queue.

    Args:
        reviews: The labels in the run, and what is wrong with files that hold none.
        show: One of ``SHOW``; anything else shows all.
        page: Which page, from 1; one that is not there shows the nearest.
    """
    found, problems = reviews
    flagged = {review.trial_id for review in found if review.flag}
    rows = recorded_trials(judgement)
    chosen = {
        "": rows,
        "wrong_yes": [row for row in rows if severity(row)[0] == 0],
        "disagree": [row for row in rows if row.agrees is False],
        "diverged": sorted(
            (row for row in rows if row.distance_m is not None),
            key=lambda row: -(row.distance_m or 0.0),
        ),
        "flagged": [row for row in rows if row.episode in flagged],
    }
    show = show if show in chosen else ""
    rows = chosen[show]
    num_pages = max(1, -(-len(rows) // PER_PAGE))
    page = min(max(page, 1), num_pages)
    labels: dict[str, int] = {}
    for review in found:
        if is_label(review):
            labels[review.trial_id] = labels.get(review.trial_id, 0) + 1
    return QueuePage(
        items=tuple(
            QueueItem(
                row=row,
                reason=REASONS[severity(row)[0]],
                moment=(moment := moment_of(run, row)),
                moment_t_s=None if moment is None else _page_t_s(run, row, moment),
                num_labels=labels.get(row.episode, 0),
                flagged=row.episode in flagged,
            )
            for row in rows[(page - 1) * PER_PAGE : page * PER_PAGE]
        ),
        show=show,
        counts={name: len(rows) for name, rows in chosen.items()},
        page=page,
        num_pages=num_pages,
        only_from_table=not chosen[""] and (bool(judgement.rows) or judgement.only_a_table),
        problems=tuple(problems),
    )


def is_label(review: Review) -> bool:
    """Whether a review holds an answer, if only that it cannot be told."""
    return review.result in ("success", "failure", "unknown")


def moment_of(run: RunFolder, row: TrialRow) -> Moment | None:
    """Find the first divergence that the replays of a trial tell, or the first failing factor."""
    for name in (row.executed_replay, row.planned_replay):
        path = run.derived_dir / name if name else None
        if path is None or not path.is_file():
            continue
        status = path.stat()
        moment = _moment(path, status.st_mtime_ns, status.st_size)
        if moment is not None:
            return moment
    return None


def _page_t_s(run: RunFolder, row: TrialRow, moment: Moment) -> float | None:
    """Seconds since the recording's first sample, from where its page counts."""
    try:
        path = episode_path(run, row.episode)
        status = path.stat()
        starts_s = _starts_s(path, status.st_mtime_ns, status.st_size)
    except (GstError, OSError):
        return None
    start_s = starts_s.get(moment.plan_id)
    return None if start_s is None else start_s + moment.t_s


@lru_cache(maxsize=4096)
def _starts_s(path: Path, _mtime_ns: int, _size: int) -> dict[str, float]:
    """When each executed plan started on the page's clock."""
    episode = Episode.open(path)
    events = executed_events(episode)
    zero_ns = streams.first_stamp_ns(episode) or 0
    plan_ids = {str(event.get("plan_id")) for event in events}
    starts_ns = {plan_id: streams.execution_ns(events, plan_id)[0] for plan_id in plan_ids}
    return {
        plan_id: (start_ns - zero_ns) / NS_PER_S
        for plan_id, start_ns in starts_ns.items()
        if start_ns is not None
    }


@lru_cache(maxsize=4096)
def _moment(path: Path, _mtime_ns: int, _size: int) -> Moment | None:
    try:
        episode = Episode.open(path)
        messages = episode.messages(episode.topics_of_type(schema.DIVERGENCE))
        for message in messages:
            record = parse_record(message.data, name="divergence")
            if first := record["first"]:
                return Moment(
                    plan_id=record["plan_id"], t_ns=first["first_t_ns"], text=first["detail"]
                )
        for _, verdict in streams.verdicts(episode):
            name = verdict.first_failing
            factor = verdict.factors()[name] if name else None
            if factor is not None and factor.first_t_ns is not None:
                text = factor.detail or factor.cause or f"{name} fails in the twin"
                return Moment(plan_id=verdict.plan_id, t_ns=factor.first_t_ns, text=text)
    except GstError:
        return None  # the trial's own page says what is wrong with the file
    return None


def thumbnail(run: RunFolder, row: TrialRow) -> bytes:
    """Draw a trial at the moment of its divergence, as JPEG; drawn once, and kept in the run.

    Without such a moment it shows the last picture.

    Raises:
        NotHereError: When the recording has no picture.
        GstError: When it cannot be read.
    """
    path = episode_path(run, row.episode)
    moment = moment_of(run, row)
    what = (stamp_of(path), moment, THUMBNAIL_PX)
    place = run.results_dir / THUMBNAILS
    return drawn_once(place, row.episode, what, lambda: _drawn(path, moment))


def drawn_once(
    folder: Path, episode: str, what: object, draw: Callable[[], bytes], ending: str = "jpg"
) -> bytes:
    """Return a picture of a trial that is drawn once and kept; one of something else goes.

    Args:
        what: Everything that it depends on; equal text stands for an equal picture.
    """
    name = hashlib.sha256(episode.encode("utf-8", "surrogatepass")).hexdigest()[:16]
    key = hashlib.sha256(repr(what).encode("utf-8", "surrogatepass")).hexdigest()[:16]
    kept = folder / f"{name}-{key}.{ending}"
    with _DRAWING:
        if kept.is_file():
            return kept.read_bytes()
        data = draw()
        try:
            folder.mkdir(parents=True, exist_ok=True)
            for old in folder.glob(f"{name}-*.{ending}"):
                old.unlink()
            write_whole(kept, data)
        except OSError:  # a run that only can be read is drawn anew each time
            pass
    return data


def _drawn(path: Path, moment: Moment | None) -> bytes:
    track = main_camera(path)
    at_ns = None if moment is None else recorded_ns(path, moment)
    data, _ = read_frame(path, track.camera_id, track.stamps_ns[-1] if at_ns is None else at_ns)
    with open_image(data) as image:
        small = image.convert("RGB")
        small.thumbnail((THUMBNAIL_PX, THUMBNAIL_PX))
        return encode_jpeg(np.asarray(small), THUMBNAIL_QUALITY, subsampling=SUBSAMPLING)


def recorded_ns(path: Path, moment: Moment) -> int | None:
    """Return when a moment is on the recording's clock; None where its plan was not executed."""
    start_ns, _ = streams.execution_ns(executed_events(Episode.open(path)), moment.plan_id)
    return None if start_ns is None else start_ns + moment.t_ns


def main_camera(path: Path) -> CameraTrack:
    """Return the recorded camera that shows most: the first that is not on the wrist.

    Raises:
        NotHereError: When the recording has no picture.
    """
    tracks = camera_tracks(path)
    names = sorted(name for name in tracks if not name.startswith(RENDERED))
    if not names:
        message = f"no camera images in {path.name}."
        raise NotHereError(message)
    return tracks[min(names, key=lambda name: ("wrist" in name or "hand" in name, name))]
