"""Which of the evaluator's numbers go where on the overview. Chooses by id; computes nothing.

Rates are ``rate.<side>.<cell>`` with side ``recorded`` or one of the twin's, and the cell
``<task>.<condition>`` or ``<task>.<condition>.<policy>``.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass

from dashboards import wording
from dashboards.comparison import Judgement
from dashboards.scatter import Cell
from evaluator.compare import TrialRow
from evaluator.result import Measurement

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
    ("Twin foretells the outcome", r"agreement\.sim_planned\.rate", ()),
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
    """One cell of the rate table: what was measured on each side."""

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
    """Success rates: a row per cell, a column per side."""

    sides: tuple[str, ...]
    rows: tuple[RateRow, ...]
    methods: str


def cards(judgement: Judgement) -> tuple[Card, ...]:
    """Choose the headline numbers; one that is not there says missing."""
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
    """Map cell to side to measurement, in file order."""
    rates: dict[str, dict[str, Measurement]] = {}
    for measurement in measurements:
        parts = measurement.id.split(".", 2)
        if len(parts) == 3 and parts[0] == start:
            rates.setdefault(parts[2], {})[parts[1]] = measurement
    return rates


def _cell_parts(cell: str) -> tuple[str, str, str]:
    parts = [*cell.split(".", 2), "", ""]
    task, condition, policy = ("" if part == NO_NAME else part for part in parts[:3])
    return task, condition, policy


def rate_table(measurements: Sequence[Measurement]) -> RateTable | None:
    """Arrange all rates by cell and side; None when there are none."""
    rates = _rates(measurements)
    if not rates:
        return None
    present = list(dict.fromkeys(side for sides in rates.values() for side in sides))
    known = [side for side in SIDE_WORDS if side in present]
    sides = [*known, *(side for side in present if side not in known)]
    rows = []
    for cell, by_side in rates.items():
        task, condition, policy = _cell_parts(cell)
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


def cells(measurements: Sequence[Measurement], rows: Sequence[TrialRow]) -> list[Cell]:
    """Collect the cells that have both rates; over the same trials where trials are known."""
    found = []
    over_same_trials = _rates(measurements, "rate_common")
    for cell, by_side in (over_same_trials or _rates(measurements)).items():
        if "recorded" not in by_side or SIM_SIDE not in by_side:
            continue
        task, condition, policy = _cell_parts(cell)
        found.append(
            Cell(
                label=", ".join(p.replace("_", " ") for p in (task, condition, policy) if p),
                group=" ".join(p.replace("_", " ") for p in (task, policy) if p),
                task=task,
                condition=condition,
                policy=policy,
                filled=condition.startswith("with_"),
                replayed=by_side[SIM_SIDE],
                recorded=by_side["recorded"],
            )
        )
    return found


def gains(measurements: Sequence[Measurement]) -> tuple[GainRow, ...]:
    """Arrange every gain with replanning by cell and side, points beside relative."""
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
    """Name the interval methods of the measurements whose id starts so."""
    named = [
        wording.method(m.interval)
        for m in measurements
        if m.id.startswith(start) and m.interval is not None
    ]
    return "; ".join(dict.fromkeys(named))


def rest(measurements: Sequence[Measurement], shown: Sequence[Card]) -> tuple[Measurement, ...]:
    """Whatever is in the results and not already on the page."""
    ids = {name for card in shown for name in card.ids}
    return tuple(
        m
        for m in measurements
        if m.id not in ids and not m.id.startswith(("rate.", "rate_common.", "gain"))
    )
