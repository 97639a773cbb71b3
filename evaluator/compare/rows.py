"""What a comparison is made of: one row per recorded trial, with what the twin said of it."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any

from evaluator.compare.motion import MotionSummary
from evaluator.result import Exclusion, Measurement, Results, Table
from evaluator.trial_row import RECORDED_WORDS
from evaluator.trial_row import TrialRow as TrialRow


def stand_in_of(marks: Iterable[bool | None]) -> bool | None:
    """True as soon as one is a stand-in's: mixed results are not called real, nor unmarked ones."""
    found = set(marks)
    if True in found:
        return True
    return False if found == {False} else None


def in_order(rows: Sequence[TrialRow]) -> list[TrialRow]:
    """Sort trials as they were recorded: names need not tell, trial_10 comes before trial_2."""
    known = all(row.began_ns for row in rows)
    return sorted(rows, key=lambda row: row.began_ns) if known else list(rows)


@dataclass(frozen=True, kw_only=True)
class RateGroup:
    """Success rates of one task, condition and policy, recorded and in the twin."""

    task: str
    condition: str
    policy: str
    unit: str
    recorded: Measurement
    """Over all trials with a known outcome."""
    sim: Measurement
    """Over all trials whose planned replay was decided."""
    recorded_rate: Fraction | None
    """Over the trials where both sides are known; these two enter r."""
    sim_rate: Fraction | None
    episodes: tuple[str, ...] = ()
    recorded_common: Measurement | None = None
    """Over the trials where both sides are known, with its interval; the scatter draws these two,
    so that a point never compares different trials. None for a rates CSV."""
    sim_common: Measurement | None = None

    trial_table: tuple[int, int, int, int] | None = None
    """Trials in which both succeed, only sim, only recorded, neither; None where not paired."""
    executed: Measurement | None = None
    """Rate of what was executed in the twin, of a group in which nobody published a plan."""

    @property
    def shown_sim(self) -> Measurement:
        """What tables and figures show as the twin's rate; ``executed`` enters no statistic."""
        return self.sim if self.executed is None else self.executed

    @property
    def pair(self) -> tuple[Measurement, Measurement]:
        """Sim and recorded rate over the same trials, or as given where trials are not known."""
        return self.sim_common or self.sim, self.recorded_common or self.recorded

    @property
    def label(self) -> str:
        """Task and condition in a reader's words."""
        parts = (self.task, self.condition, self.policy)
        return ", ".join(part.replace("_", " ") for part in parts if part)


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """Everything ``compare_run`` found; the reports and the dashboard only show it."""

    run: str
    source: str
    """run, trials, rates or images."""
    stand_in: bool | None
    rows: tuple[TrialRow, ...] = ()
    groups: tuple[RateGroup, ...] = ()
    measurements: tuple[Measurement, ...] = ()
    tables: tuple[Table, ...] = ()
    exclusions: tuple[Exclusion, ...] = ()
    missing: tuple[str, ...] = ()
    motions: tuple[MotionSummary, ...] = ()
    """How far each motion lies from its replays, with its course."""
    provenance: dict[str, Any] = field(default_factory=dict)
    """Software, settings, and the content hash of every input file."""

    @property
    def recorded_word(self) -> str:
        """``stand-in``, ``real``, or ``recorded`` when the input does not say."""
        return RECORDED_WORDS[self.stand_in]

    def results(self) -> Results:
        """Return what goes into ``results.json``."""
        return Results(
            run=self.run,
            source=self.source,
            stand_in=self.stand_in,
            measurements=self.measurements,
            tables=self.tables,
            exclusions=self.exclusions,
            missing=self.missing,
            provenance=self.provenance,
        )
