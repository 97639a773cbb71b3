"""One file to send: chosen trials with clips, figures and tables; offline, readable unscripted."""

import base64
import difflib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

from jinja2 import ChoiceLoader, Environment, PackageLoader, PrefixLoader

from bridge.episode.run_folder import RunFolder
from bridge.errors import GstError, UsageError
from bridge.media.color import encode_jpeg
from bridge.whole_file import write_whole
from dashboards import wording
from dashboards.clips import (
    SUBSAMPLING,
    ClipConfig,
    Footage,
    as_video,
    can_film,
    contact_sheet,
    footage,
)
from dashboards.comparison import Judgement, judge
from dashboards.config import SHARE_LIMITS, ShareConfig
from dashboards.episode_page import build_page
from dashboards.figures import TimePlot
from dashboards.library import episode_path
from evaluator.compare.rows import Comparison
from evaluator.report.figures import DARK, LIGHT, Drawing, drawings_of
from evaluator.report.front import FIGURES, front
from evaluator.report.page import SHARED, environment, name_shared
from evaluator.report.wording import stand_in_sentence
from evaluator.result import Table
from evaluator.review_index import Selection
from evaluator.trial_row import TrialRow

POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:; media-src data:"
"""The file forbids itself to load anything."""
BY_ITSELF = 8
"""Trials that are taken where none is named: the worst disagreements, else the worst failures."""
MOST_TRIALS = 60
PLOTS = 4
"""Of a trial: how far the tool was from the twin's, and what comes after it on its page."""
STRIP_FRAMES = 6
MB = 1_000_000


STRIPS = "strips"
LEVELS = {
    "288 lines, 15 Hz": ClipConfig(height_px=288, rate_hz=15, crf=24, quality=82),
    "216 lines, 10 Hz": ClipConfig(height_px=216, rate_hz=10, crf=28, quality=78),
    "144 lines, 6 Hz": ClipConfig(height_px=144, rate_hz=6, crf=32, quality=70),
    STRIPS: ClipConfig(height_px=120, rate_hz=3, quality=65),
}
"""How well clips are shown; the next one is smaller, and the last ones are pictures."""


@dataclass(frozen=True, kw_only=True)
class Clip:
    """What the file shows of a trial: a video with its picture, or a strip of pictures."""

    picture: str
    """JPEG as a data address: of the moment, or the strip."""
    video: str
    """MP4 as a data address; empty for a strip."""
    words: str
    """What is seen, for those who cannot."""
    width: int
    height: int


@dataclass(frozen=True, kw_only=True)
class SharedTrial:
    """One trial of the file."""

    row: TrialRow
    clip: Clip | None
    why_no_clip: str
    plots: tuple[TimePlot, ...]
    not_scanned: tuple[str, ...]
    """Objects that the twin draws from the task's shape."""
    t_s: float
    """Where the plots have their mark: the moment, in seconds since the first sample."""
    moment_text: str


@dataclass(frozen=True, kw_only=True)
class Shared:
    """A file that was made."""

    text: str
    trials: tuple[str, ...]
    clips: str
    """How well clips are shown: one of ``LEVELS``."""
    notes: tuple[str, ...]

    @property
    def size_bytes(self) -> int:
        """Of the file."""
        return len(self.text.encode())


def share(run: RunFolder, config: ShareConfig) -> tuple[Path, Shared]:
    """Write chosen trials into one file, and let the report name it.

    Raises:
        UsageError: When a trial is not there, none can be chosen, or they do not fit.
    """
    out = config.out or run.results_dir / SHARED / "trials.html"
    is_beside = out.resolve().parent == (run.results_dir / SHARED).resolve()
    report = "../report.html" if is_beside and (run.results_dir / "report.html").is_file() else ""
    made = build_share(run, config, report=report)
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        write_whole(out, made.text.encode())
    except OSError as error:
        message = f"cannot write {out}: {error.strerror}. Choose another file with --out."
        raise UsageError(message) from error
    if is_beside:
        name_shared(run.results_dir / "report.html")
    return out, made


def build_share(run: RunFolder, config: ShareConfig, *, report: str = "") -> Shared:
    """Make the file, as well as it fits.

    Args:
        report: Where the report lies from the file; empty leaves the link out.

    Raises:
        UsageError: When a trial is not there, none can be chosen, or they do not fit.
    """
    judgement = judge(run)
    rows = chosen_trials(judgement, config.trials)
    shared = _shared_parts(run, judgement, report)
    trials = [_trial(run, row) for row in rows]
    levels = LEVELS if can_film() else (STRIPS,)
    limit = round(config.max_mb * MB)
    least = 0
    for level in levels:
        shown, notes = _with_clips(run, trials, level, config, limit)
        if shown is None:
            continue
        text = _environment().get_template("pages/share.html").render(**shared, trials=shown)
        named = tuple(row.episode for row in rows)
        made = Shared(text=text, trials=named, clips=level, notes=notes)
        least = made.size_bytes
        if least <= limit:
            return made
    size = f"take {least / MB:.1f} MB" if least else f"take more than {config.max_mb:g} MB"
    message = (
        f"{len(rows)} trials {size} even as strips of pictures; the limit is "
        f"{config.max_mb:g} MB. Name fewer with --trials, or raise --max-mb (at most "
        f"{SHARE_LIMITS['max_mb'][1]:g})."
    )
    raise UsageError(message)


def chosen_trials(judgement: Judgement, names: Sequence[str]) -> list[TrialRow]:
    """Return the trials that were named; without names the worst that have a recording.

    Raises:
        UsageError: For one that is not there, with the nearest name, or where none can be chosen.
    """
    index = judgement.index
    if index is None:
        raise UsageError("this run was not evaluated yet: run robot-gst evaluate first.")
    if len(names) > MOST_TRIALS:
        message = f"{len(names)} trials are too many for one file; name at most {MOST_TRIALS}."
        raise UsageError(message)
    found = []
    for name in dict.fromkeys(names):
        row = index.trial(name)
        if row is None:
            known = [trial.episode for trial in index.trials(Selection())]
            near = difflib.get_close_matches(name, known, n=1)
            meant = f"; did you mean {near[0]}?" if near else "."
            message = f"no trial {name!r} in this run{meant} robot-gst ls lists them."
            raise UsageError(message)
        found.append(row)
    for show in () if names else ("disagree", "failure"):
        found = [row for row in index.trials(Selection(show=show)) if row.file][:BY_ITSELF]
        if found:
            break
    if not found:
        message = "no trial disagrees or failed; name those to share with --trials."
        raise UsageError(message)
    return found


def _shared_parts(run: RunFolder, judgement: Judgement, report: str) -> dict[str, Any]:
    """What the file says of the whole run."""
    results = judgement.results
    success = None if results is None else _table(results.tables, "success")
    drawing = _figure(judgement.comparison)
    return {
        "name": run.path.resolve().name,
        "title": f"Trials of {run.path.resolve().name}",
        "policy": POLICY,
        "light": LIGHT,
        "dark": DARK,
        "banner": None if results is None else stand_in_sentence(results),
        "first": None if results is None else front(results),
        "success": success,
        "drawing": drawing,
        "report": report,
    }


def _table(tables: Sequence[Table], name: str) -> Table | None:
    return next((table for table in tables if table.id == name and table.rows), None)


def _figure(comparison: Comparison | None) -> Drawing | None:
    """Draw the report's first figure; none without groups."""
    drawn = [] if comparison is None else drawings_of(comparison)
    return next((each for name in FIGURES for each in drawn if each.id == name), None)


def _trial(run: RunFolder, row: TrialRow) -> SharedTrial:
    """Everything of a trial but its clip."""
    plots: tuple[TimePlot, ...] = ()
    not_scanned: tuple[str, ...] = ()
    t_s, text, why = 0.0, "", ""
    if row.file:
        try:
            page = build_page(run, row.file.removesuffix(".mcap"), row, None)
            plots, t_s, not_scanned = page.plots[:PLOTS], page.t_s, page.not_scanned
            text = "" if page.divergence is None else page.divergence.text
        except GstError as error:
            why = str(error).replace(str(run.path), run.path.name)
    else:
        why = "from a table: nothing was recorded"
    return SharedTrial(
        row=row,
        clip=None,
        why_no_clip=why,
        plots=plots,
        not_scanned=not_scanned,
        t_s=t_s,
        moment_text=text,
    )


def _with_clips(
    run: RunFolder,
    trials: Sequence[SharedTrial],
    level: str,
    config: ShareConfig,
    limit: int,
) -> tuple[list[SharedTrial] | None, tuple[str, ...]]:
    """Add clips of one quality; None as soon as they alone are too large."""
    shown, notes, size = list[SharedTrial](), list[str](), 0
    clip_config = replace(LEVELS[level], before_s=config.before_s, after_s=config.after_s)
    for trial in trials:
        if trial.why_no_clip:
            shown.append(trial)
            notes.append(f"{trial.row.episode}: {trial.why_no_clip}")
            continue
        try:
            episode_path(run, trial.row.file.removesuffix(".mcap"))
            found = footage(run, trial.row, clip_config)
            clip = _clip(found, clip_config, trial, is_video=level != STRIPS)
        except GstError as error:
            why = str(error).replace(str(run.path), run.path.name)
            shown.append(replace(trial, why_no_clip=why))
            notes.append(f"{trial.row.episode}: {why}")
            continue
        size += len(clip.picture) + len(clip.video)
        if size > limit:
            return None, ()
        shown.append(replace(trial, clip=clip))
    return shown, tuple(notes)


def _clip(found: Footage, config: ClipConfig, trial: SharedTrial, *, is_video: bool) -> Clip:
    height, width = found.frames[0].shape[:2]
    sides = "recorded, and the twin beside it," if found.has_twin else "recorded"
    at = f"around the moment when {trial.moment_text}" if trial.moment_text else "at the end"
    words = f"{trial.row.episode} {sides} {at}"
    if is_video and len(found.frames) > 1:
        key = encode_jpeg(found.frames[found.key], config.quality, subsampling=SUBSAMPLING)
        return Clip(
            picture=_data("image/jpeg", key),
            video=_data("video/mp4", as_video(found, config)),
            words=words,
            width=width,
            height=height,
        )
    last = len(found.frames) - 1
    num = min(STRIP_FRAMES, len(found.frames))
    places = sorted({round(last * step / max(1, num - 1)) for step in range(num)} | {found.key})
    frames = [found.frames[place] for place in places]
    picture = contact_sheet(frames, columns=2 if found.has_twin else 3)
    return Clip(
        picture=_data("image/jpeg", encode_jpeg(picture, config.quality, subsampling=SUBSAMPLING)),
        video="",
        words=f"{words}, {len(frames)} pictures in reading order",
        width=picture.shape[1],
        height=picture.shape[0],
    )


def _data(media_type: str, data: bytes) -> str:
    return f"data:{media_type};base64,{base64.b64encode(data).decode()}"


@cache
def _environment() -> Environment:
    """The report's templates and words, and beside them those of the pages."""
    words = (wording.outcome_word, wording.verdict_word, wording.condition_word, wording.tone)
    report, pages = environment(), PrefixLoader({"pages": PackageLoader("dashboards")})
    made = report.overlay(loader=ChoiceLoader([PackageLoader("evaluator.report"), pages]))
    made.filters = report.filters | {
        function.__name__: function for function in (*words, wording.length_text)
    }
    return made
