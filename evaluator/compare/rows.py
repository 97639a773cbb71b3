"""What a comparison is made of: one row per recorded trial, with what the twin said of it."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from fractions import Fraction

from evaluator.compare.motion import MotionSummary
from evaluator.result import Measurement, Results
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
    def gap(self) -> Fraction | None:
        """Sim rate less recorded rate; None where one is not known."""
        known = self.sim_rate is not None and self.recorded_rate is not None
        return self.sim_rate - self.recorded_rate if known else None  # type: ignore[operator]

    @property
    def label(self) -> str:
        """Task and condition in a reader's words."""
        parts = (self.task, self.condition, self.policy)
        return ", ".join(part.replace("_", " ") for part in parts if part)


@dataclass(frozen=True, kw_only=True)
class Comparison(Results):
    """Everything ``compare_run`` found; the reports and the dashboard only show it."""

    rows: tuple[TrialRow, ...] = ()
    groups: tuple[RateGroup, ...] = ()
    motions: tuple[MotionSummary, ...] = ()
    """How far each motion lies from its replays, with its course."""

    @property
    def recorded_word(self) -> str:
        """``stand-in``, ``real``, or ``recorded`` when the input does not say."""
        return RECORDED_WORDS[self.stand_in]

    def results(self) -> Results:
        """Return what goes into ``results.json``."""
        return Results(**{part.name: getattr(self, part.name) for part in fields(Results)})
