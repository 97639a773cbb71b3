"""What the overview shows: headline numbers, success rates of each group, and every trial.

Measurements are chosen by id; nothing is computed. Rates are ``rate.<side>.<group>`` with side
``recorded`` or one of the twin's, and group ``<task>.<condition>`` or
``<task>.<condition>.<policy>``.
"""

import re
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from bridge.episode.metadata import EpisodeInfo
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.errors import GstError
from dashboards import wording
from dashboards.comparison import Judgement, agrees
from dashboards.figures import RateGroup, Scatter, scatter
from evaluator.compare import TrialRow
from evaluator.measurements import slug
from evaluator.result import Exclusion, Measurement

NO_NAME = "-"
"""Stands in an id for an empty name."""
SIM_SIDE = "sim_planned"
"""The headline twin: planned trajectory, dynamic, of the plan actually sent."""
SIDE_WORDS = {
    "recorded": "recorded",
    "sim_planned": "twin, planned",
    "sim_executed": "twin, executed",
    "sim_varied": "twin, varied",
    "verdict": "gate accepted",
}
CARDS: tuple[tuple[str, str, tuple[str, ...]], ...] = (
    ("Twin predicts the outcome", r"agreement\.sim_planned\.rate", ()),
    ("Success rates, correlation r", r"agreement\.pearson_r", (r"agreement\.bias_pp",)),
    (
        "Gain with replanning, recorded",
        r"gain\.pp\.recorded\.average|gain\.pp\.recorded\..*",
        (r"gain\.relative\.recorded\.average|gain\.relative\.recorded\..*",),
    ),
    ("Held-out views, PSNR", r"views\..*\.psnr_db", (r"views\..*\.ssim",)),
)
"""Title, pattern of the id (the first that matches), and patterns of what is printed below."""
SMALL_NAMES = {"agreement.bias_pp": "bias", "gain.relative": "relative", "ssim": "SSIM"}


@dataclass(frozen=True, kw_only=True)
class Card:
    """One headline number."""

    title: str
    value: str
    detail: str
    state: str
    """defined, undefined or missing."""
    definition: str = ""
    ids: tuple[str, ...] = ()
    more: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class RateRow:
    """One group of the table of rates: what was measured on each side."""

    task: str
    condition: str
    policy: str
    rates: tuple[Measurement | None, ...]


@dataclass(frozen=True, kw_only=True)
class GainRow:
    """The gain with replanning of one task on one side."""

    task: str
    policy: str
    side: str
    points: Measurement | None
    relative: Measurement | None


@dataclass(frozen=True, kw_only=True)
class RateTable:
    """Success rates: a row per group, a column per side."""

    sides: tuple[str, ...]
    rows: tuple[RateRow, ...]
    methods: str


def headline_cards(judgement: Judgement) -> tuple[Card, ...]:
    """Choose the headline numbers; one that is not in the results is marked missing."""
    return tuple(_card(title, pattern, below, judgement) for title, pattern, below in CARDS)


def _card(title: str, pattern: str, below: Sequence[str], judgement: Judgement) -> Card:
    found = _find(pattern, judgement.measurements)
    if found is None:
        why = "not in results.json" if judgement.results else "no results yet"
        return Card(title=title, value="missing", detail=why, state="missing")
    more = [_find(other, judgement.measurements) for other in below]
    return Card(
        title=title,
        value=wording.headline(found),
        detail=wording.headline_evidence(found),
        definition=found.definition,
        ids=tuple(m.id for m in (found, *more) if m is not None),
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


def rate_table(measurements: Sequence[Measurement]) -> RateTable | None:
    """Arrange all rates by group and side; None when there are none."""
    rates = _rates(measurements)
    if not rates:
        return None
    present = list(dict.fromkeys(side for sides in rates.values() for side in sides))
    known = [side for side in SIDE_WORDS if side in present]
    sides = [*known, *(side for side in present if side not in known)]
    rows = []
    for group, by_side in rates.items():
        task, condition, policy = _names_of(group)
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
        methods=methods(measurements, "rate."),
    )


def rate_groups(measurements: Sequence[Measurement]) -> list[RateGroup]:
    """Collect the groups that have both rates; over the same trials where trials are known."""
    found = []
    over_same_trials = _rates(measurements, "rate_common")
    for group, by_side in (over_same_trials or _rates(measurements)).items():
        if "recorded" not in by_side or SIM_SIDE not in by_side:
            continue
        task, condition, policy = _names_of(group)
        found.append(
            RateGroup(
                label=", ".join(p.replace("_", " ") for p in (task, condition, policy) if p),
                series=" ".join(p.replace("_", " ") for p in (task, policy) if p),
                task=task,
                condition=condition,
                policy=policy,
                filled=condition.startswith("with_"),
                replayed=by_side[SIM_SIDE],
                recorded=by_side["recorded"],
            )
        )
    return found


def gain_rows(measurements: Sequence[Measurement]) -> tuple[GainRow, ...]:
    """Arrange every gain with replanning by group and side, points beside relative."""
    found: dict[tuple[str, str], dict[str, Measurement]] = {}
    for measurement in measurements:
        parts = measurement.id.split(".", 3)
        if len(parts) == 4 and parts[0] == "gain":
            found.setdefault((parts[3], parts[2]), {})[parts[1]] = measurement
    rows = []
    for (name, side), kinds in found.items():
        task, _, policy = name.partition(".")
        rows.append(
            GainRow(
                task=task,
                policy="" if policy == NO_NAME else policy,
                side={"recorded": "recorded", "sim": "twin, planned"}.get(side, side),
                points=kinds.get("pp"),
                relative=kinds.get("relative"),
            )
        )
    return tuple(rows)


def methods(measurements: Sequence[Measurement], start: str) -> str:
    """Name the interval methods of the measurements whose id starts so.

    Args:
        measurements: Everything that was measured.
        start: What the id begins with, for example ``gain.``.
    """
    named = [
        wording.method(m.interval)
        for m in measurements
        if m.id.startswith(start) and m.interval is not None
    ]
    return "; ".join(dict.fromkeys(named))


def other_measurements(
    measurements: Sequence[Measurement], shown: Sequence[Card]
) -> tuple[Measurement, ...]:
    """Whatever is in the results and not already on the page.

    Args:
        measurements: Everything that was measured.
        shown: Headline numbers of the page; what they stand for is left out.
    """
    ids = {name for card in shown for name in card.ids}
    return tuple(
        m
        for m in measurements
        if m.id not in ids and not m.id.startswith(("rate.", "rate_common.", "gain"))
    )


SHOW = {"": "all", "disagree": "disagreements", "failure": "recorded failures"}


@dataclass(frozen=True, kw_only=True)
class Selection:
    """What the address asks to look at; empty means all."""

    task: str = ""
    condition: str = ""
    policy: str = ""
    show: str = ""

    @staticmethod
    def of(query: Mapping[str, str]) -> "Selection":
        """Read the query of an address; unknown values simply select nothing."""
        return Selection(**{name: query.get(name, "") for name in Selection.__dataclass_fields__})

    def query(self, **changes: str) -> dict[str, str]:
        """Return this selection as a query, with some fields changed."""
        names = Selection.__dataclass_fields__
        return {name: changes.get(name, getattr(self, name)) for name in names}

    def takes_group(self, task: str, condition: str, policy: str) -> bool:
        """Say whether a group is selected.

        Args:
            task: Task of the group, as recorded; all three are compared as slugs.
            condition: Its condition.
            policy: Its policy.
        """
        return (
            self.task in ("", slug(task))
            and self.condition in ("", slug(condition))
            and self.policy in ("", slug(policy))
        )

    def takes(self, row: TrialRow) -> bool:
        """Say whether a trial is selected."""
        if not self.takes_group(row.task, row.condition, row.policy):
            return False
        if self.show == "disagree":
            return agrees(row) is False
        return self.show != "failure" or row.recorded is False


@dataclass(frozen=True, kw_only=True)
class Facet:
    """One thing to filter by, with its values."""

    name: str
    values: tuple[tuple[str, str], ...]
    """Value and label."""


@dataclass(frozen=True, kw_only=True)
class OtherFile:
    """A recording that is not a trial: a scan, a probe, an import."""

    id: str
    info: EpisodeInfo
    duration_s: float


@dataclass(frozen=True, kw_only=True)
class BrokenFile:
    """A file that cannot be read, and why."""

    name: str
    reason: str


@dataclass(frozen=True, kw_only=True)
class Overview:
    """Everything the overview template needs."""

    selection: Selection
    stand_in: bool | None
    cards: tuple[Card, ...]
    has_headline: bool
    """Whether at least one card has a value or a reason."""
    scatter: Scatter | None
    rates: RateTable | None
    gains: tuple[GainRow, ...]
    gain_methods: str
    trials: tuple[TrialRow, ...]
    num_trials: int
    facets: tuple[Facet, ...]
    others: tuple[OtherFile, ...]
    broken: tuple[BrokenFile, ...]
    rest: tuple[Measurement, ...]
    exclusions: tuple[Exclusion, ...]
    missing: tuple[str, ...]
    notices: tuple[str, ...]
    outdated: str | None
    """A message that the numbers are older than the run, naming the first that differs."""
    next_command: str | None


def ordered(rows: Sequence[TrialRow]) -> list[TrialRow]:
    """Put disagreements first, then what is undecided, then the rest, each by name."""
    rank = {False: 0, None: 1, True: 2}
    return sorted(rows, key=lambda row: (rank[agrees(row)], row.episode))


def neighbours(
    judgement: Judgement, selection: Selection, episode_id: str
) -> tuple[str | None, str | None]:
    """Return the trials before and after one in the filtered list.

    Args:
        judgement: Numbers and trials of the run.
        selection: Which trials the list holds.
        episode_id: The trial in question; outside the list it has no neighbours.
    """
    ids = [row.episode for row in ordered(judgement.rows) if selection.takes(row)]
    if episode_id not in ids:
        return None, None
    at = ids.index(episode_id)
    return (ids[at - 1] if at else None), (ids[at + 1] if at + 1 < len(ids) else None)


def build_overview(run: RunFolder, judgement: Judgement, selection: Selection) -> Overview:
    """Gather the overview of one run.

    Args:
        run: The run folder.
        judgement: Its numbers and trials.
        selection: Which trials are listed; the numbers are of all.
    """
    rows = ordered(judgement.rows)
    others, broken = _files(run, {row.episode for row in rows})
    cards = headline_cards(judgement)
    gains = gain_rows(judgement.measurements)
    return Overview(
        selection=selection,
        stand_in=judgement.stand_in,
        cards=cards,
        has_headline=any(card.state != "missing" for card in cards),
        scatter=scatter(rate_groups(judgement.measurements)),
        rates=rate_table(judgement.measurements),
        gains=gains,
        gain_methods=methods(judgement.measurements, "gain."),
        trials=tuple(row for row in rows if selection.takes(row)),
        num_trials=len(rows),
        facets=_facets(rows),
        others=others,
        broken=broken,
        rest=other_measurements(judgement.measurements, cards),
        exclusions=judgement.results.exclusions if judgement.results else (),
        missing=judgement.results.missing if judgement.results else (),
        notices=_notices(judgement),
        outdated=_outdated(judgement),
        next_command=_next_command(run, judgement),
    )


def _notices(judgement: Judgement) -> tuple[str, ...]:
    notices = []
    if judgement.results is None and judgement.results_reason != "no results yet":
        notices.append(f"The results cannot be shown: {judgement.results_reason}")
    if judgement.comparison_reason is not None:
        notices.append(f"The trials cannot be compared: {judgement.comparison_reason}")
    return tuple(notices)


def _outdated(judgement: Judgement) -> str | None:
    found = judgement.outdated()
    if found is None:
        return None
    name = next(side.id for side in found if side is not None)
    was, now = (wording.headline(m) if m else "not measured" for m in found)
    return (
        f"The numbers on this page are older than the run: {name} was {was} and is now {now}, "
        "computed from the present recordings, labels and replays."
    )


def _next_command(run: RunFolder, judgement: Judgement) -> str | None:
    path = shlex.quote(str(run.path))
    if not run.episodes():
        return f"robot-gst record {path}"
    if not (run.scene_dir / "scene.json").is_file() and not run.derived():
        return f"robot-gst rebuild {path}"
    if not run.derived("*.replay.*"):
        return f"robot-gst replay {path}"
    is_due = judgement.results is None or judgement.outdated() is not None
    return f"robot-gst evaluate {path}" if is_due else None


def _facets(rows: Sequence[TrialRow]) -> tuple[Facet, ...]:
    facets = []
    for name in ("task", "condition", "policy"):
        values = sorted({getattr(row, name) for row in rows} - {""})
        if len(values) > 1:
            labelled = tuple((slug(value), value.replace("_", " ")) for value in values)
            facets.append(Facet(name=name, values=(("", "all"), *labelled)))
    if rows:
        facets.append(Facet(name="show", values=tuple(SHOW.items())))
    return tuple(facets)


def _files(run: RunFolder, known: set[str]) -> tuple[tuple[OtherFile, ...], tuple[BrokenFile, ...]]:
    others, broken = [], []
    for path in [*run.episodes(), *run.derived()]:
        try:
            episode = Episode.open(path)
            if path.parent == run.episodes_dir and path.stem not in known:
                others.append(
                    OtherFile(id=path.stem, info=episode.info, duration_s=episode.duration_s)
                )
        except GstError as error:
            broken.append(BrokenFile(name=str(path.relative_to(run.path)), reason=str(error)))
    reason = "not finished: still being recorded, or its recorder was stopped"
    for folder in (run.episodes_dir, run.derived_dir):
        parts = sorted(folder.glob("*.mcap.part"))
        broken += [BrokenFile(name=str(p.relative_to(run.path)), reason=reason) for p in parts]
    return tuple(others), tuple(broken)
