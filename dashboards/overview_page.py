"""What the first page shows: whether to trust the twin, the worst it did, and the trials.

Measurements are chosen by id; nothing is computed.
"""

import shlex
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from bridge.episode import streams
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.errors import GstError
from bridge.task.scripted_motion import RECORD_NAME
from dashboards.comparison import Judgement
from dashboards.moments import Cause, cause_of
from dashboards.twin_page import any_recorded, has_depth
from evaluator.quantity import unslug
from evaluator.report.wording import SIM_SIDE, agreeing_side
from evaluator.result import Measurement
from evaluator.review_index import FACETS, RESULTS, IndexedFile, ReviewIndex, Selection, stamp_of
from evaluator.trial_row import TrialRow
from twin.scene.store.library import not_scanned_in

PAGE = 50
"""Trials on one screen."""
MOST_TASKS = 60
MOST_VALUES = 300
MOST_FILES = 100
COLUMNS = (
    ("name", "Episode"),
    ("task", "Task and condition"),
    ("start", "Start"),
    ("recorded", "Recorded"),
    ("planned", "Twin, planned"),
    ("executed", "Twin, executed"),
    ("gate", "Gate"),
    ("distance", "Tool path, lag"),
    ("cause", "Cause in the twin"),
)
NUMBERS = {
    f"agreement.{SIM_SIDE}.rate": "Twin predicts the outcome",
    "agreement.bias_pp": "Success rates, twin minus recorded",
    "agreement.pearson_r": "Success rates, correlation r",
    "views.all.psnr_db": "PSNR of held-out views, raw",
}
"""The numbers to read first, by id, with their titles; three, without r where it may be none."""
Facets = tuple[tuple[str, tuple[tuple[str, str, int], ...]], ...]
"""What to filter by, each with slugs, names and numbers of trials."""


@dataclass(frozen=True, kw_only=True)
class Disagreement:
    """The worst trial in which twin and recorded outcome differ."""

    row: TrialRow
    cause: Cause | None
    has_picture: bool


@dataclass(frozen=True, kw_only=True)
class Screen:
    """One screen of a selection of trials."""

    selected: int = 0
    """How many the selection holds."""
    of: int = 0
    """How many the run holds."""
    page: int = 1
    pages: int = 1
    facets: Facets = ()


@dataclass(frozen=True, kw_only=True)
class TrialList(Screen):
    """The trials themselves."""

    trials: tuple[TrialRow, ...] = ()

    @property
    def columns(self) -> tuple[tuple[str, str], ...]:
        """Order and title of the columns in which any trial of the screen has something."""
        shown = {
            "start": any(t.start_id for t in self.trials),
            "planned": any(t.planned_replay or t.sim_planned is not None for t in self.trials),
            "executed": any(t.executed_replay or t.sim_executed is not None for t in self.trials),
            "gate": any(t.verdict is not None for t in self.trials),
            "distance": any(t.distance_m is not None for t in self.trials),
            "cause": any(t.first_failing for t in self.trials),
        }
        return tuple((name, title) for name, title in COLUMNS if shown.get(name, True))


@dataclass(frozen=True, kw_only=True)
class Overview:
    """Everything the first page needs."""

    selection: Selection
    tasks: tuple[Mapping[str, str], ...]
    """Task, its slug, answer and sentence."""
    more_tasks: int
    numbers: tuple[tuple[str, Measurement], ...]
    """The numbers to read first, those that are there, with their titles."""
    disagreement: Disagreement | None
    worst_view: Mapping[str, Any] | None
    """The held-out view that is drawn worst, where its file is still there."""
    not_scanned: tuple[str, ...]
    """Objects of the trials that no scan saw."""
    list: TrialList
    others: tuple[IndexedFile, ...]
    num_others: int
    broken: tuple[IndexedFile, ...]
    num_broken: int
    notices: tuple[str, ...]
    outdated: str | None
    """A message that the stored results are older than the run, naming the first that differs."""
    next_command: str | None


def build_overview(run: RunFolder, judgement: Judgement, selection: Selection) -> Overview:
    """Gather the first page of one run.

    Args:
        selection: Which trials are listed; the numbers are of all.
    """
    index = judgement.index
    nothing: tuple[tuple[IndexedFile, ...], int] = ((), 0)
    others, num_others = index.files(broken=False, limit=MOST_FILES) if index else nothing
    broken, num_broken = index.files(broken=True, limit=MOST_FILES) if index else nothing
    tasks = judgement.about["tasks"]
    older, views = judgement.about["outdated"], judgement.about["views"]
    return Overview(
        selection=selection,
        tasks=tuple(tasks[:MOST_TASKS]),
        more_tasks=max(0, len(tasks) - MOST_TASKS),
        numbers=tuple(first_numbers(judgement))[:3],
        disagreement=worst_disagreement(run, judgement),
        worst_view=next((v for v in views if stamp_of(run.derived_dir / v["file"])), None),
        not_scanned=tuple(not_scanned(run, judgement)),
        list=trial_list(judgement, selection),
        others=others,
        num_others=num_others,
        broken=broken,
        num_broken=num_broken,
        notices=tuple(_notices(run, judgement)),
        outdated=older and f"The stored results and the report are older than the run: {older}.",
        next_command=_next_command(run, judgement),
    )


def first_numbers(judgement: Judgement) -> Iterator[tuple[str, Measurement]]:
    """Choose the numbers to read first: of plans, else of motions, else what was recorded."""
    by_id = {each.id: each for each in judgement.measurements}
    side = agreeing_side(by_id)
    rates: list[Measurement] = []
    if all(each.value is None for name, each in by_id.items() if name.startswith("agreement.")):
        recorded = [each for name, each in by_id.items() if name.startswith("rate.recorded.")]
        rates = [each for each in recorded if each.value is not None][: len(NUMBERS)]
        for each in rates:
            parts = [unslug(part) for part in each.id.split(".")[2:] if part != "-"]
            yield f"Recorded success, {' · '.join(parts)}", each
    for name, title in NUMBERS.items():
        found = by_id.get(name.replace(SIM_SIDE, side))
        interval = None if found is None else found.interval
        may_be_none = not interval or interval.low <= 0 <= interval.high
        if found is None or (rates and found.value is None):  # a run without a twin
            continue
        if not (name.endswith("_r") and may_be_none):
            yield (title if found.id == name else "Executed in the twin, as recorded"), found


def worst_disagreement(run: RunFolder, judgement: Judgement) -> Disagreement | None:
    """Find the first trial of the list that disagrees and can be looked at."""
    index = judgement.index
    trials = () if index is None else index.trials(Selection(show="disagree"))
    row = next((trial for trial in trials if trial.file), None)
    if row is None:
        return None
    return Disagreement(row=row, cause=cause_of(run, row), has_picture=has_picture(run, row))


def has_picture(run: RunFolder, row: TrialRow) -> bool:
    """Whether a trial was recorded by a camera."""
    try:
        path = run.episodes_dir / row.file
        return bool(row.file and streams.camera_ids(Episode.open(path)))
    except GstError:  # its own page says what is wrong
        return False


def not_scanned(run: RunFolder, judgement: Judgement) -> list[str]:
    """Name what no scan saw of the objects of each task, as one trial of it tells them."""
    of_task = {row.task: row for row in judgement.rows if row.file}
    names: dict[str, None] = {}
    for row in [*of_task.values()][:MOST_TASKS]:
        try:
            episode = Episode.open(run.episodes_dir / row.file)
            names |= dict.fromkeys(not_scanned_in(run, episode))
        except GstError:
            continue
    return list(names)


def trial_list(judgement: Judgement, selection: Selection) -> TrialList:
    """Return the screen of trials that a selection asks for; beyond the last it is the last."""
    index = judgement.index
    if index is None:
        return TrialList()
    selected, of = index.count(selection), index.count(Selection())
    pages = max(1, -(-selected // PAGE))
    page = min(selection.page_number, pages)
    return TrialList(
        trials=index.trials(selection, limit=PAGE, offset=PAGE * (page - 1)),
        selected=selected,
        of=of,
        page=page,
        pages=pages,
        facets=group_facets(index),
    )


def group_facets(index: ReviewIndex) -> Facets:
    """Task, condition and policy to choose from, each with how many trials it has."""
    values = ((name, index.values(name)) for name in FACETS)
    return tuple((name, found[:MOST_VALUES]) for name, found in values if len(found) > 1)


def _notices(run: RunFolder, judgement: Judgement) -> Iterator[str]:
    reason = judgement.about["results_reason"]
    if reason is not None and stamp_of(run.path / RESULTS):
        yield f"The results cannot be shown: {reason}"
    if reason := judgement.about["comparison_reason"]:
        yield f"The trials cannot be compared: {reason}"


def _next_command(run: RunFolder, judgement: Judgement) -> str | None:
    path = shlex.quote(str(run.path))
    if judgement.index is None:
        return None if judgement.is_being_updated else f"robot-gst evaluate {path}"
    trials, recorded, replayed = judgement.index.totals()
    if not trials and next(run.episodes_dir.glob("*.mcap"), None) is None:
        return None if judgement.has_results else f"robot-gst record {path}"
    is_due = judgement.about["results_reason"] or judgement.about["outdated"]
    step = _step_to_replays(run) if recorded and not replayed else ""
    if is_due and step in ("", "open"):
        step = "evaluate"
    return f"robot-gst {step} {path}" if step else None


def _step_to_replays(run: RunFolder) -> str:
    """The command that recordings lack; ``open`` says what is missing where there is no depth."""
    if (run.scene_dir / "scene.json").is_file() or any(run.derived_dir.glob("*.mcap")):
        return "replay"
    if any_recorded(run, has_depth):
        return "rebuild"
    return "replay" if any_recorded(run, lambda episode: episode.record(RECORD_NAME)) else "open"
