"""What the first page shows: whether to trust the twin, where it fails, and the trials.

Measurements are chosen by id; nothing is computed. Rates are ``rate.<side>.<group>`` with side
``recorded`` or one of the twin's, and group ``<task>.<condition>`` or
``<task>.<condition>.<policy>``.
"""

import re
import shlex
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from bridge.episode.run_folder import RunFolder
from dashboards import wording
from dashboards.comparison import Judgement
from evaluator.compare.rows import RateGroup
from evaluator.report.figures import Drawing, scatter
from evaluator.report.views import shown_word
from evaluator.report.wording import SIM_SIDE, agreeing_side, method_text
from evaluator.result import Measurement
from evaluator.review_index import (
    FACETS,
    NO_RESULTS,
    IndexedFile,
    ReviewIndex,
    Selection,
)
from evaluator.trial_row import RECORDED_WORDS, TrialRow

PAGE = 50
"""Trials on one screen."""
MOST_GROUPS = 60
"""Groups that are drawn and stand in the tables; a selection shows others."""
MOST_TASKS = 60
MOST_VALUES = 300
MOST_FAILURES = 8
MOST_FILES = 100
COLUMNS = (
    ("name", "Episode"),
    ("task", "Task and condition"),
    ("start", "Start"),
    ("recorded", "Recorded"),
    ("planned", "Twin, planned"),
    ("executed", "Twin, executed"),
    ("gate", "Gate"),
    ("agreement", "Agreement"),
    ("distance", "Tool path, lag"),
    ("cause", "Cause in the twin"),
)
LONGEST = 60
"""Characters of a name in a list to choose from."""

NO_NAME = "-"
"""Stands in an id for an empty name."""
SIDE_WORDS = {
    "recorded": "recorded",
    "sim_planned": "twin, planned",
    "sim_executed": "twin, executed",
    "verdict": "gate accepted",
}
CARDS: tuple[tuple[str, str, tuple[str, ...]], ...] = (
    ("Twin predicts the outcome", r"agreement\.sim_planned\.rate", ()),
    ("Success rates, correlation r", r"agreement\.pearson_r", (r"agreement\.bias_pp",)),
    (
        "Gain with replanning, recorded",
        r"comparison\.pp\.[^.]*with_replanning\.against\.[^.]*without_replanning",
        (),
    ),
    ("Held-out views, PSNR", r"views\..*\.psnr_db", (r"views\..*\.ssim",)),
)
"""Title, pattern of the id (the first that matches), and patterns of what is printed below."""
SMALL_NAMES = {"agreement.bias_pp": "bias", "ssim": "SSIM"}


@dataclass(frozen=True, kw_only=True)
class Card:
    """One headline number."""

    title: str
    value: str
    detail: str
    state: str
    """defined, undefined or missing."""
    definition: str = ""
    more: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class RateRow:
    """One group of the table of rates: what was measured on each side."""

    task: str
    condition: str
    policy: str
    rates: tuple[Measurement | None, ...]


@dataclass(frozen=True, kw_only=True)
class RateTable:
    """Success rates: a row per group, a column per side."""

    sides: tuple[str, ...]
    rows: tuple[RateRow, ...]
    more_rows: int
    methods: str


def headline_cards(judgement: Judgement) -> tuple[Card, ...]:
    """Choose the headline numbers; without results all are marked missing, and say why."""
    side = agreeing_side({each.id: each for each in judgement.measurements})
    cards = [
        _card(
            title if side == SIM_SIDE else title.replace("predicts", "executed agrees with"),
            pattern.replace(SIM_SIDE, side),
            below,
            judgement,
        )
        for title, pattern, below in CARDS
    ]
    found = tuple(card for card in cards if card.state != "missing")
    return found if judgement.has_results else tuple(cards)


def _card(title: str, pattern: str, below: Sequence[str], judgement: Judgement) -> Card:
    found = _find(pattern, judgement.measurements)
    if found is None:
        return Card(title=title, value="missing", detail=NO_RESULTS, state="missing")
    more = [_find(other, judgement.measurements) for other in below]
    is_counted = found.value is not None and found.k is not None  # a share hides how few there are
    rests_on = wording.evidence(found)
    return Card(
        title=title,
        value=f"{found.k} of {found.n}" if is_counted else wording.measured(found),
        detail=f"{wording.measured(found)}, {rests_on}" if is_counted else rests_on,
        definition=found.definition,
        state="undefined" if found.value is None else "defined",
        more=tuple(_small(m) for m in more if m is not None),
    )


def _find(pattern: str, measurements: Sequence[Measurement]) -> Measurement | None:
    """Return the first match of the leftmost alternative that has one."""
    for choice in pattern.split("|"):
        for measurement in measurements:
            if re.fullmatch(choice, measurement.id):
                return measurement
    return None


def _small(measurement: Measurement) -> str:
    name = next((word for part, word in SMALL_NAMES.items() if part in measurement.id), "")
    why = wording.short_evidence(measurement)
    text = f"{name} {wording.measured(measurement)}".strip()
    return f"{text} ({why})" if why else text


def _rates(
    measurements: Sequence[Measurement], start: str = "rate"
) -> dict[str, dict[str, Measurement]]:
    """Map group to side to measurement, in file order."""
    rates: dict[str, dict[str, Measurement]] = {}
    for measurement in measurements:
        parts = measurement.id.split(".", 2)
        if len(parts) == 3 and parts[0] == start:
            rates.setdefault(parts[2], {})[parts[1]] = measurement
    return rates


def _names_of(group: str) -> tuple[str, str, str]:
    parts = [*group.split(".", 2), "", ""]
    task, condition, policy = ("" if part == NO_NAME else part for part in parts[:3])
    return task, condition, policy


def rate_table(measurements: Sequence[Measurement], selection: Selection) -> RateTable | None:
    """Arrange rates by group and side; None when there are none.

    A side without a rate in any group is left out; the page lists what is undefined, and why.
    """
    rates = _rates(measurements)
    if not rates:
        return None
    by_id = {each.id: each for each in measurements}
    present = list(
        dict.fromkeys(
            side
            for sides in rates.values()
            for side, rate in sides.items()
            if rate.value is not None or side in ("recorded", agreeing_side(by_id))
        )
    )
    known = [side for side in SIDE_WORDS if side in present]
    sides = [*known, *(side for side in present if side not in known)]
    rows = []
    names = {group: _names_of(group) for group in rates}
    if len(rates) > MOST_GROUPS:
        names = dict(sorted(names.items(), key=lambda item: not selection.takes_group(*item[1])))
    for group in list(names)[:MOST_GROUPS]:
        by_side = rates[group]
        task, condition, policy = names[group]
        rows.append(
            RateRow(
                task=task,
                condition=condition,
                policy=policy,
                rates=tuple(by_side.get(side) for side in sides),
            )
        )
    return RateTable(
        sides=tuple(SIDE_WORDS.get(side, side.replace("_", " ")) for side in sides),
        rows=tuple(rows),
        more_rows=len(rates) - len(rows),
        methods="; ".join(
            dict.fromkeys(
                method_text(m) for m in measurements if m.id.startswith("rate.") and m.interval
            )
        ),
    )


def rate_groups(measurements: Sequence[Measurement]) -> list[RateGroup]:
    """Collect the groups that have both rates; over the same trials where trials are known."""
    found = []
    over_same_trials = _rates(measurements, "rate_common")
    for group, rates in (over_same_trials or _rates(measurements)).items():
        if "recorded" in rates and SIM_SIDE in rates:
            task, condition, policy = _names_of(group)
            found.append(
                RateGroup(
                    task=task,
                    condition=condition,
                    policy=policy,
                    unit="",
                    recorded=rates["recorded"],
                    sim=rates[SIM_SIDE],
                    recorded_rate=None,
                    sim_rate=None,
                )
            )
    return found


@dataclass(frozen=True, kw_only=True)
class Facet:
    """One thing to filter by, with its values."""

    name: str
    values: tuple[tuple[str, str], ...]
    """Value and label."""


@dataclass(frozen=True, kw_only=True)
class TrialList:
    """One screen of the trials of a selection."""

    trials: tuple[TrialRow, ...]
    selected: int
    """How many the selection holds."""
    of: int
    """How many the run holds."""
    page: int
    pages: int
    facets: tuple[Facet, ...]

    @property
    def columns(self) -> tuple[tuple[str, str], ...]:
        """Order and title of the columns in which any trial of the screen has something."""
        shown = {
            "planned": any(t.planned_replay or t.sim_planned is not None for t in self.trials),
            "executed": any(t.executed_replay or t.sim_executed is not None for t in self.trials),
            "gate": any(t.verdict is not None for t in self.trials),
            "distance": any(t.distance_m is not None for t in self.trials),
            "cause": any(t.first_failing for t in self.trials),
        }
        shown["agreement"] = any(t.twin is not None for t in self.trials)
        return tuple((name, title) for name, title in COLUMNS if shown.get(name, True))


@dataclass(frozen=True, kw_only=True)
class Failure:
    """One way to fail: how often, and which selection lists its trials."""

    words: str
    count: int
    share: float
    """Of the most frequent one on its side, for a bar."""
    query: Mapping[str, str]


@dataclass(frozen=True, kw_only=True)
class Undefined:
    """Why numbers have no value, and which."""

    reason: str
    ids: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class Overview:
    """Everything the first page needs."""

    selection: Selection
    tasks: tuple[Mapping[str, str], ...]
    """Task, its slug, answer and sentence."""
    more_tasks: int
    cards: tuple[Card, ...]
    has_headline: bool
    """Whether at least one card has a value or a reason."""
    scatter: Drawing | None
    more_groups: int
    """Groups that are not drawn."""
    rates: RateTable | None
    twin_failures: tuple[Failure, ...]
    recorded_failures: tuple[Failure, ...]
    list: TrialList
    others: tuple[IndexedFile, ...]
    num_others: int
    kinds: tuple[tuple[str, int], ...]
    broken: tuple[IndexedFile, ...]
    num_broken: int
    undefined: tuple[Undefined, ...]
    num_undefined: int
    notices: tuple[str, ...]
    outdated: str | None
    """A message that the numbers are older than the run, naming the first that differs."""
    next_command: str | None


def build_overview(run: RunFolder, judgement: Judgement, selection: Selection) -> Overview:
    """Gather the first page of one run.

    Args:
        selection: Which trials are listed; the numbers are of all.
    """
    about = judgement.about
    numbers = judgement.measurements
    cards = headline_cards(judgement)
    groups = [
        g for g in rate_groups(numbers) if selection.takes_group(g.task, g.condition, g.policy)
    ]
    drawn, word = groups[:MOST_GROUPS], shown_word(RECORDED_WORDS[judgement.stand_in])
    others, num_others, kinds = _others(judgement)
    broken, num_broken = _broken(judgement)
    tasks = about["tasks"]
    failures = about["failures"]
    return Overview(
        selection=selection,
        tasks=tuple(tasks[:MOST_TASKS]),
        more_tasks=max(0, len(tasks) - MOST_TASKS),
        cards=cards,
        has_headline=any(card.state != "missing" for card in cards),
        scatter=scatter(drawn, word),
        more_groups=len(groups) - len(drawn),
        rates=rate_table(numbers, selection),
        twin_failures=_failures(failures, twin=True),
        recorded_failures=_failures(failures, twin=False),
        list=trial_list(judgement, selection),
        others=others,
        num_others=num_others,
        kinds=kinds,
        broken=broken,
        num_broken=num_broken,
        undefined=undefined(numbers),
        num_undefined=sum(number.value is None for number in numbers),
        notices=_notices(judgement),
        outdated=_outdated(judgement),
        next_command=_next_command(run, judgement),
    )


def _failures(table: Sequence[Sequence[Any]], *, twin: bool) -> tuple[Failure, ...]:
    """Lay out one side of the evaluator's table of what failed first."""
    lines = [line for line in table if (line[0] == "sim planned") == twin][:MOST_FAILURES]
    most = max((int(line[3]) for line in lines), default=1)
    return tuple(
        Failure(
            words=": ".join(str(word).replace("_", " ") for word in (where, cause) if word),
            count=int(count),
            share=int(count) / most,
            query={"clause": str(where), "cause": str(cause)} if twin else {"stage": str(where)},
        )
        for _, where, cause, count in lines
    )


def trial_list(judgement: Judgement, selection: Selection) -> TrialList:
    """Return the screen of trials that a selection asks for; beyond the last it is the last."""
    index = judgement.index
    if index is None:
        return TrialList(trials=(), selected=0, of=0, page=1, pages=1, facets=())
    selected, of = index.count(selection), index.count(Selection())
    pages = max(1, -(-selected // PAGE))
    page = min(selection.page_number, pages)
    return TrialList(
        trials=index.trials(selection, limit=PAGE, offset=PAGE * (page - 1)),
        selected=selected,
        of=of,
        page=page,
        pages=pages,
        facets=tuple(group_facets(index, counted=True)) if of else (),
    )


def group_facets(index: ReviewIndex, *, counted: bool) -> Iterator[Facet]:
    """Task, condition and policy to choose from; ``counted`` says how many trials each has."""
    for name in FACETS:
        found = index.values(name)
        if len(found) > 1:
            counts = [f" ({count})" if counted else "" for _, _, count in found]
            labelled = [(v[0], _words(v[1]) + n) for v, n in zip(found, counts, strict=True)]
            yield Facet(name=name, values=(("", "all"), *labelled[:MOST_VALUES]))


def _words(label: str) -> str:
    text = label.replace("_", " ")
    return text if len(text) <= LONGEST else text[: LONGEST - 1] + "…"


def undefined(measurements: Sequence[Measurement]) -> tuple[Undefined, ...]:
    """Group the numbers without a value by their reason, the commonest first."""
    found: dict[str, list[str]] = {}
    for measurement in measurements:
        if measurement.reason_if_undefined:
            found.setdefault(measurement.reason_if_undefined, []).append(measurement.id)
    ordered = sorted(found.items(), key=lambda item: -len(item[1]))
    return tuple(Undefined(reason=reason, ids=tuple(ids)) for reason, ids in ordered)


def _others(
    judgement: Judgement,
) -> tuple[tuple[IndexedFile, ...], int, tuple[tuple[str, int], ...]]:
    if judgement.index is None:
        return (), 0, ()
    files, number = judgement.index.files(broken=False)
    kinds = Counter(" · ".join(filter(None, (f.kind, f.task, f.source))) for f in files)
    return files[:MOST_FILES], number, tuple(kinds.most_common(MOST_FAILURES))


def _broken(judgement: Judgement) -> tuple[tuple[IndexedFile, ...], int]:
    if judgement.index is None:
        return (), 0
    return judgement.index.files(broken=True, limit=MOST_FILES)


def _notices(judgement: Judgement) -> tuple[str, ...]:
    notices = []
    about = judgement.about
    if about.get("results_reason") not in (None, NO_RESULTS):
        notices.append(f"The results cannot be shown: {about['results_reason']}")
    if judgement.comparison_reason is not None:
        notices.append(f"The trials cannot be compared: {judgement.comparison_reason}")
    return tuple(notices)


def _outdated(judgement: Judgement) -> str | None:
    found = judgement.outdated()
    return found and f"The numbers on this page are older than the run: {found}."


def _next_command(run: RunFolder, judgement: Judgement) -> str | None:
    path = shlex.quote(str(run.path))
    if judgement.index is None:
        return f"robot-gst evaluate {path}"
    trials, recorded, replayed = judgement.index.totals()
    if not trials and next(run.episodes_dir.glob("*.mcap"), None) is None:
        return None if judgement.has_results else f"robot-gst record {path}"
    if recorded and not replayed:
        has_scene = (run.scene_dir / "scene.json").is_file() or any(run.derived_dir.glob("*.mcap"))
        return f"robot-gst {'replay' if has_scene else 'rebuild'} {path}"
    is_due = not judgement.has_results or judgement.outdated() is not None
    return f"robot-gst evaluate {path}" if is_due else None
