"""Blind labelling: which trials a rater sees in which order, and what they see of them."""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

from bridge.episode.run_folder import RunFolder
from bridge.errors import UsageError
from bridge.exchange.reviews import (
    OPERATOR,
    UNRATED,
    Review,
    SavedReview,
    save_review,
    saved_review,
)
from dashboards.comparison import Judgement
from dashboards.episode_page import CameraView, camera_view
from dashboards.frames import RENDERED, main_camera
from dashboards.library import episode_path
from dashboards.recording import PageClock, read_recording

CAUSES = (
    "missed the object",
    "dropped it",
    "collision",
    "put in the wrong place",
    "wrong object",
    "stopped early",
    "too slow",
    "equipment fault",
    "other",
)
"""What the digits 1 to 9 stand for."""
STRIP = 6
"""Pictures that sum a recording up, from first to last."""
MAX_LENGTH = {"rater": 80, "cause": 200, "note": 4000}


@dataclass(frozen=True, kw_only=True)
class Progress:
    """How far one rater came."""

    rater: str
    done: int
    left: int


@dataclass(frozen=True, kw_only=True)
class LabelPage:
    """What a rater sees of one trial: nothing that twin, gate or another rater said."""

    rater: str
    trial_id: str
    number: int
    total: int
    done: int
    task: str
    instruction: str
    cameras: tuple[CameraView, ...]
    main: str
    """The camera of the strip."""
    strip_s: tuple[float, ...]
    end_s: float
    saved: SavedReview
    before: str | None
    after: str | None


def rater_name(text: str) -> str:
    """Return a rater's name without needless blanks.

    Raises:
        UsageError: When it cannot be one.
    """
    name = " ".join(text.split())
    if not name or not name.isprintable() or len(name) > MAX_LENGTH["rater"]:
        message = f"a rater's name has 1 to {MAX_LENGTH['rater']} printable characters."
        raise UsageError(message)
    if name == OPERATOR:
        message = f"{OPERATOR!r} is what the label of the recording is called; take another name."
        raise UsageError(message)
    return name


def trials_to_label(judgement: Judgement, rater: str) -> list[str]:
    """Return the trials that have a recording, in the order of one rater.

    It is each rater's own and by chance, so that a trial's place says nothing of twin or operator.
    """
    ids = [row.episode for row in judgement.rows if row.file]
    salted = {name: f"{rater}\0{name}".encode(errors="replace") for name in ids}
    return sorted(ids, key=lambda name: hashlib.sha256(salted[name]).digest())


def next_trial(
    order: Sequence[str], reviews: Sequence[Review], rater: str, after: str | None = None
) -> str | None:
    """Return the next trial that nobody labelled, else the next that this rater did not.

    Next is behind another one, or else from the first on.
    """
    mine = rated_by(reviews, rater)
    anybody = {review.trial_id for review in reviews if _is_label(review)}
    start = order.index(after) + 1 if after in order else 0
    left = [name for name in [*order[start:], *order[:start]] if name not in mine]
    return next((name for name in left if name not in anybody), next(iter(left), None))


def rated_by(reviews: Sequence[Review], rater: str) -> set[str]:
    """Return the trials that a rater gave an answer to."""
    return {r.trial_id for r in reviews if r.rater == rater and _is_label(r)}


def _is_label(review: Review) -> bool:
    """Whether a review holds an answer, if only that it cannot be told."""
    return review.result in ("success", "failure", "unknown")


def progress_of(judgement: Judgement, reviews: Sequence[Review]) -> list[Progress]:
    """How far each rater is."""
    ids = set(trials_to_label(judgement, ""))
    done = {r.rater: len(rated_by(reviews, r.rater) & ids) for r in reviews}
    return [Progress(rater=name, done=n, left=len(ids) - n) for name, n in sorted(done.items())]


def build_label_page(
    run: RunFolder, order: Sequence[str], reviews: Sequence[Review], *, rater: str, trial_id: str
) -> LabelPage:
    """Gather what one rater sees of one trial.

    Raises:
        NotHereError: When the run has no such trial.
        GstError: When it cannot be read.
    """
    path = episode_path(run, trial_id)
    recording = read_recording(path)
    clock = PageClock.of(recording)
    tracks = [t for t in recording.cameras.values() if not t.camera_id.startswith(RENDERED)]
    saved = saved_review(run.path, trial_id, rater)
    if saved.review is None:  # a table may hold this rater's label
        own = (r for r in reviews if (r.trial_id, r.rater) == (trial_id, rater))
        saved = SavedReview(review=next(own, None))
    at = order.index(trial_id) if trial_id in order else None
    end = clock.end_s
    return LabelPage(
        rater=rater,
        trial_id=trial_id,
        number=0 if at is None else at + 1,
        total=len(order),
        done=len(rated_by(reviews, rater) & set(order)),
        task=recording.info.task or "",
        instruction=recording.info.instruction or "",
        cameras=tuple(camera_view(track, clock, end) for track in tracks),
        main=main_camera(path).camera_id if tracks else "",
        strip_s=tuple(end * index / (STRIP - 1) for index in range(STRIP)) if tracks else (),
        end_s=end,
        saved=saved,
        before=order[at - 1] if at else None,
        after=order[at + 1] if at is not None and at + 1 < len(order) else None,
    )


def save_label(run: RunFolder, record: Mapping[str, Any], *, rater: str) -> SavedReview:
    """Keep what a rater's page sent; it is on disk when this returns.

    Args:
        record: trial_id, seen (the version before the rater), and result, cause, note, flag; a
            result of None takes the label away.

    Raises:
        UsageError: When a part is missing or is something else than it should be.
        NotHereError: When the run has no such trial.
        ReviewConflictError: When another tab changed the label meanwhile.
    """
    trial_id, seen = (_text_of(record, name, 1000) for name in ("trial_id", "seen"))
    episode_path(run, trial_id)
    result = record.get("result", "")
    flag = record.get("flag", False)
    if result is None:
        return save_review(run.path, trial_id, rater, None, seen=seen)
    if result not in ("success", "failure", "unknown", UNRATED) or not isinstance(flag, bool):
        message = "result is success, failure, unknown, unrated or null, and flag true or false."
        raise UsageError(message)
    review = Review(
        trial_id=trial_id,
        rater=rater,
        time=datetime.now(UTC).isoformat(timespec="microseconds").replace("+00:00", "Z"),
        result=result,
        cause=_text_of(record, "cause", MAX_LENGTH["cause"]) if result == "failure" else "",
        note=_text_of(record, "note", MAX_LENGTH["note"]),
        flag=flag,
    )
    return save_review(run.path, trial_id, rater, review, seen=seen)


def _text_of(record: Mapping[str, Any], name: str, longest: int) -> str:
    """Read a text that a page sent; empty where it sent none.

    Raises:
        UsageError: When it is something else, or longer.
    """
    text = record.get(name, "")
    if not isinstance(text, str) or len(text) > longest:
        message = f"{name} is a text of at most {longest} characters."
        raise UsageError(message)
    try:
        text.encode()
    except UnicodeEncodeError as error:
        message = f"{name} holds characters that no file can hold."
        raise UsageError(message) from error
    return text
