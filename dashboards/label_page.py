"""Blind labelling: which trials a rater sees in which order, what they see, and what was said."""

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
from dashboards.frames import RENDERED
from dashboards.library import episode_path
from dashboards.queue_page import is_label, main_camera, recorded_trials
from dashboards.recording import PageClock, read_recording
from evaluator.compare.raters import with_reviews
from evaluator.result import Table

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
WORST = 50
"""Trials of the set ``worst`` that head the queue; as many others are mixed with them."""
SETS = {
    "": "all trials",
    "worst": f"the {WORST} worst, mixed with {WORST} others",
}
STRIP = 6
"""Pictures that sum a recording up, from first to last."""
MAX_LENGTH = {"rater": 80, "cause": 200, "note": 4000}


@dataclass(frozen=True, kw_only=True)
class Progress:
    """How far one rater came in a set of trials."""

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


@dataclass(frozen=True, kw_only=True)
class Summary:
    """What the raters said, for after the labelling."""

    progress: tuple[Progress, ...]
    held_back: tuple[str, ...]
    """Who is still labelling; while there is anybody, no agreement is shown."""
    tables: tuple[Table, ...]
    missing: tuple[str, ...]
    notes: tuple[Review, ...]
    problems: tuple[str, ...]


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


def _shuffled(ids: Sequence[str], salt: str) -> list[str]:
    """Order ids by a hash: the same each time, whatever their order was."""
    return sorted(
        ids, key=lambda name: hashlib.sha256(f"{salt}\0{name}".encode(errors="replace")).digest()
    )


def trials_to_label(judgement: Judgement, chosen: str, rater: str) -> list[str]:
    """Return the trials of a set in the order of one rater.

    The set is the same for all raters. The order is each rater's own and by chance, so that a
    trial's place says nothing of twin or operator.

    Args:
        chosen: One of ``SETS``.
    """
    ids = [row.episode for row in recorded_trials(judgement)]
    if chosen == "worst":
        ids = [*ids[:WORST], *_shuffled(ids[WORST:], "others")[:WORST]]
    return _shuffled(ids, rater)


def next_unrated(order: Sequence[str], rated: set[str], after: str | None) -> str | None:
    """Return the first trial without a label behind another one, else the first of all."""
    start = order.index(after) + 1 if after in order else 0
    return next((name for name in [*order[start:], *order[:start]] if name not in rated), None)


def rated_by(reviews: Sequence[Review], rater: str) -> set[str]:
    """Return the trials that a rater gave an answer to."""
    return {r.trial_id for r in reviews if r.rater == rater and is_label(r)}


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
    trial_id, seen = (text_of(record, name, 1000) for name in ("trial_id", "seen"))
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
        cause=text_of(record, "cause", MAX_LENGTH["cause"]) if result == "failure" else "",
        note=text_of(record, "note", MAX_LENGTH["note"]),
        flag=flag,
    )
    return save_review(run.path, trial_id, rater, review, seen=seen)


def text_of(record: Mapping[str, Any], name: str, longest: int) -> str:
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


def summarise(
    judgement: Judgement,
    reviews: tuple[Sequence[Review], Sequence[str]],
    *,
    chosen: str,
    show: bool,
) -> Summary:
    """Gather how far the raters are and, when nobody is labelling any more, how far they agree.

    Args:
        reviews: The labels in the run, and what is wrong with files that hold none.
        chosen: The set of trials, one of ``SETS``.
    """
    found, problems = reviews
    ids = set(trials_to_label(judgement, chosen, ""))
    progress = []
    for rater in sorted({review.rater for review in found}):
        done = len(rated_by(found, rater) & ids)
        progress.append(Progress(rater=rater, done=done, left=len(ids) - done))
    working = () if show else tuple(p.rater for p in progress if p.left)
    released = bool(progress) and not working and judgement.comparison is not None
    tables: tuple[Table, ...] = ()
    missing: tuple[str, ...] = ()
    if released and judgement.comparison is not None:
        before = judgement.comparison
        after = with_reviews(before, found)
        tables = tuple(table for table in after.tables if table.id == "raters")
        missing = tuple(text for text in after.missing if text not in before.missing)
    elif progress and judgement.comparison_reason is not None:
        missing = (f"The trials cannot be compared: {judgement.comparison_reason}",)
    return Summary(
        progress=tuple(progress),
        held_back=working,
        tables=tables,
        missing=missing,
        notes=tuple(r for r in found if r.note or r.flag) if released else (),
        problems=tuple(problems),
    )
