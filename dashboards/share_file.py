"""One file to send: chosen trials with clips and plots; offline, readable unscripted."""

import base64
import difflib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

from jinja2 import ChoiceLoader, Environment, PackageLoader, PrefixLoader

from bridge.episode.run_folder import RunFolder
from bridge.errors import GstError, UsageError
from bridge.media.color import encode_jpeg
from bridge.whole_file import write_whole
from dashboards import wording
from dashboards.clips import SUBSAMPLING, ClipConfig, as_video, can_film, footage
from dashboards.comparison import Judgement, judge
from dashboards.config import SHARE_LIMITS, ShareConfig
from dashboards.episode_page import EpisodePage, build_page
from evaluator.report.figures import DARK, LIGHT
from evaluator.report.page import SHARED, environment, name_shared
from evaluator.report.wording import STAND_IN
from evaluator.review_index import Selection
from evaluator.trial_row import TrialRow

POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:; media-src data:"
"""The file forbids itself to load anything."""
BY_ITSELF = 8
"""Trials that are taken where none is named: the worst disagreements, else the worst failures."""
MOST_TRIALS = 60
PLOTS = 4
"""Of a trial: how far the tool was from the twin's, and what comes after it on its page."""
MB = 1_000_000
PICTURES = "pictures"
_AROUND = ClipConfig(before_s=3.0, after_s=2.0)
LEVELS = {
    "288 lines, 15 Hz": replace(_AROUND, height_px=288, rate_hz=15, crf=24, quality=82),
    "216 lines, 10 Hz": replace(_AROUND, height_px=216, rate_hz=10, crf=28, quality=78),
    "144 lines, 6 Hz": replace(_AROUND, height_px=144, rate_hz=6, crf=32, quality=70),
    PICTURES: replace(_AROUND, height_px=144, rate_hz=6, quality=65),
}
"""How well clips are shown; the next one is smaller, and the last ones are pictures."""


@dataclass(frozen=True, kw_only=True)
class Clip:
    """What the file shows of a trial: a video with its picture, or the picture alone."""

    picture: str
    """JPEG of the moment, as a data address."""
    video: str
    """MP4 as a data address; empty for a picture alone."""
    words: str
    """What is seen, for those who cannot."""
    width: int
    height: int


@dataclass(frozen=True, kw_only=True)
class SharedTrial:
    """One trial of the file."""

    row: TrialRow
    page: EpisodePage | None = None
    """None where nothing was recorded, or it cannot be read."""
    clip: Clip | None = None
    why_no_clip: str = ""


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
        raise GstError(message) from error
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
    judgement = judge(run, reads=False)
    trials = [_trial(run, row) for row in chosen_trials(judgement, config.trials)]
    template = _environment().get_template("pages/share.html")
    size = 0
    for level in LEVELS if can_film() else (PICTURES,):
        shown = [_with_clip(run, trial, level) for trial in trials]
        text = template.render(
            title=f"Trials of {run.path.resolve().name}",
            policy=POLICY,
            light=LIGHT,
            dark=DARK,
            banner=STAND_IN if judgement.about["stand_in"] else None,
            report=report,
            trials=shown,
            plots=PLOTS,
        )
        made = Shared(
            text=text,
            trials=tuple(trial.row.episode for trial in trials),
            clips=level,
            notes=tuple(f"{t.row.episode}: {t.why_no_clip}" for t in shown if t.why_no_clip),
        )
        size = made.size_bytes
        if size <= config.max_mb * MB:
            return made
    raise UsageError(
        f"{len(trials)} trials take {size / MB:.1f} MB even with pictures for clips; the limit is "
        f"{config.max_mb:g} MB. Name fewer with --trials, or raise --max-mb (at most "
        f"{SHARE_LIMITS['max_mb'][1]:g})."
    )


def chosen_trials(judgement: Judgement, names: Sequence[str]) -> list[TrialRow]:
    """Return the trials that were named; without names the worst that have a recording.

    Raises:
        UsageError: For one that is not there, with the nearest name, or where none can be chosen.
    """
    index = judgement.index
    if index is None or judgement.is_old:
        raise UsageError("this run is not evaluated as it is now: run robot-gst evaluate first.")
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


def _trial(run: RunFolder, row: TrialRow) -> SharedTrial:
    """Everything of a trial but its clip."""
    if not row.file:
        return SharedTrial(row=row, why_no_clip="from a table: nothing was recorded")
    try:
        return SharedTrial(row=row, page=build_page(run, row.file.removesuffix(".mcap"), row, None))
    except GstError as error:
        return SharedTrial(row=row, why_no_clip=_without_path(error, run))


def _with_clip(run: RunFolder, trial: SharedTrial, level: str) -> SharedTrial:
    """Add the clip, or say why there is none."""
    if trial.page is None:
        return trial
    config, moment = LEVELS[level], trial.page.divergence
    try:
        found = footage(run, trial.row, config)
        key = encode_jpeg(found.frames[found.key], config.quality, subsampling=SUBSAMPLING)
        is_video = level != PICTURES and len(found.frames) > 1
        video = _data("video/mp4", as_video(found, config)) if is_video else ""
    except GstError as error:
        return replace(trial, why_no_clip=_without_path(error, run))
    height, width = found.frames[0].shape[:2]
    sides = "recorded, and the twin beside it," if found.has_twin else "recorded"
    at = f"around the moment when {moment.text}" if moment else "at the end"
    words = f"{trial.row.episode} {sides} {at}"
    picture = _data("image/jpeg", key)
    clip = Clip(picture=picture, video=video, words=words, width=width, height=height)
    return replace(trial, clip=clip)


def _without_path(error: GstError, run: RunFolder) -> str:
    return str(error).replace(str(run.path), run.path.name)


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
