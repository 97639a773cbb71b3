"""What the overview shows: headline numbers, rates per cell, and every trial."""

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from bridge.episode.metadata import EpisodeInfo
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.errors import GstError
from dashboards import headline, wording
from dashboards.comparison import Judgement, agrees
from dashboards.headline import Card, GainRow, RateTable
from dashboards.scatter import Scatter, scatter
from evaluator.compare import TrialRow
from evaluator.compare.measure import slug
from evaluator.result import Exclusion, Measurement

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

    def takes_cell(self, task: str, condition: str, policy: str) -> bool:
        """Say whether a cell is selected."""
        return (
            self.task in ("", slug(task))
            and self.condition in ("", slug(condition))
            and self.policy in ("", slug(policy))
        )

    def takes(self, row: TrialRow) -> bool:
        """Say whether a trial is selected."""
        if not self.takes_cell(row.task, row.condition, row.policy):
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
class Trial:
    """One line of the episode list."""

    row: TrialRow
    agrees: bool | None


@dataclass(frozen=True, kw_only=True)
class OtherFile:
    """A recording that is no trial: a scan, a probe, an import."""

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
    """At least one card has something to say."""
    scatter: Scatter | None
    rates: RateTable | None
    gains: tuple[GainRow, ...]
    gain_methods: str
    trials: tuple[Trial, ...]
    num_trials: int
    facets: tuple[Facet, ...]
    others: tuple[OtherFile, ...]
    broken: tuple[BrokenFile, ...]
    rest: tuple[Measurement, ...]
    exclusions: tuple[Exclusion, ...]
    missing: tuple[str, ...]
    notices: tuple[str, ...]
    outdated: str | None
    """That the numbers are older than the run, and which of them shows it."""
    next_command: str | None


def ordered(rows: Sequence[TrialRow]) -> list[TrialRow]:
    """Put disagreements first, then what is undecided, then the rest, each by name."""
    rank = {False: 0, None: 1, True: 2}
    return sorted(rows, key=lambda row: (rank[agrees(row)], row.episode))


def neighbours(
    judgement: Judgement, selection: Selection, episode_id: str
) -> tuple[str | None, str | None]:
    """Return the trials before and after one in the filtered list."""
    ids = [row.episode for row in ordered(judgement.rows) if selection.takes(row)]
    if episode_id not in ids:
        return None, None
    at = ids.index(episode_id)
    return (ids[at - 1] if at else None), (ids[at + 1] if at + 1 < len(ids) else None)


def build_overview(run: RunFolder, judgement: Judgement, selection: Selection) -> Overview:
    """Gather the overview of one run."""
    rows = ordered(judgement.rows)
    cells = headline.cells(judgement.measurements, rows)
    others, broken = _files(run, {row.episode for row in rows})
    cards = headline.cards(judgement)
    gains = headline.gains(judgement.measurements)
    return Overview(
        selection=selection,
        stand_in=judgement.stand_in,
        cards=cards,
        has_headline=any(card.state != "missing" for card in cards),
        scatter=scatter(cells),
        rates=headline.rate_table(judgement.measurements),
        gains=gains,
        gain_methods=headline.methods(judgement.measurements, "gain."),
        trials=tuple(Trial(row=row, agrees=agrees(row)) for row in rows if selection.takes(row)),
        num_trials=len(rows),
        facets=_facets(rows),
        others=others,
        broken=broken,
        rest=headline.rest(judgement.measurements, cards),
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
    said, now = found
    name = next(side.id for side in found if side is not None)
    was, would_be = (wording.headline(m) if m else "not measured" for m in (said, now))
    return (
        f"The numbers on this page are older than the run: {name} was {was} and is {would_be} by "
        "the recordings, labels and replays that lie there now."
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
            broken.append(BrokenFile(name=_name(run, path), reason=str(error)))
    for folder in (run.episodes_dir, run.derived_dir):
        for path in sorted(folder.glob("*.mcap.part")):
            reason = "not finished: still being written, or its writer was stopped"
            broken.append(BrokenFile(name=_name(run, path), reason=reason))
    return tuple(others), tuple(broken)


def _name(run: RunFolder, path: Path) -> str:
    return str(path.relative_to(run.path))
