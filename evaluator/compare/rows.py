"""What a comparison is made of: one row per recorded trial, with what the twin said of it."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from bridge.episode.executions import NO_PLAN
from evaluator.compare.motion import MotionSummary
from evaluator.result import Exclusion, Measurement, Results, Table
from evaluator.run_reader.episodes import FirstDivergence

RECORDED_WORDS = {True: "stand-in", False: "real", None: "recorded"}
"""What the recorded side is called."""


def stand_in_of(marks: Iterable[bool | None]) -> bool | None:
    """True as soon as one is a stand-in's: mixed results are not called real, nor unmarked ones."""
    found = set(marks)
    if True in found:
        return True
    return False if found == {False} else None


@dataclass(frozen=True, kw_only=True)
class TcpErrorSeries:
    """Distance between the recorded and a replayed tool centre point over time."""

    against: str
    """``planned`` or ``executed``: which replay."""
    t_s: Float[np.ndarray, " num_samples"]
    """Time from the start of the execution [s]."""
    position_m: Float[np.ndarray, " num_samples"]
    rotation_rad: Float[np.ndarray, " num_samples"]


@dataclass(frozen=True, kw_only=True)
class TrialRow:
    """One recorded trial beside its replays. None means unknown, undecided or not there."""

    episode: str
    """Id of the recorded episode, or the trial id of a trials CSV."""
    task: str
    condition: str
    policy: str
    start_id: str | None
    cell: str
    stand_in: bool | None
    """Whether a simulated laboratory recorded it; None where a table does not say."""
    recorded: bool | None
    """Task-level outcome as the operator labelled it."""
    unit: str = "trial"
    k: int | None = None
    """Recorded successes in ``unit`` (1 of 1 for a trial; ducks in the basket for an object)."""
    n: int | None = None
    plan_id: str | None = None
    """The plan actually sent: the last one whose execution started; ``NO_PLAN``: there was none."""
    num_plans: int = 0
    num_plans_sent: int = 0
    nothing_executed: bool = False
    """No plan was sent, though plans were published or the label says so."""
    sim_planned: bool | None = None
    """Headline sim: the sent plan, planned trajectory, dynamic, in the twin."""
    sim_executed: bool | None = None
    """Diagnosis only: the executed joints replayed dynamically. Never enters r."""
    verdict: bool | None = None
    """The gate's verdict on the sent plan, made before its execution started."""
    p_success: float | None = None
    """Chance of success as stated: of the planned replay, else of the gate."""
    first_failing: str | None = None
    """ik, clearance or terminal of the planned replay, or of the verdict where there is none."""
    failing_detail: str | None = None
    planned_replay: str | None = None
    """File name of the derived episode ``sim_planned`` comes from."""
    executed_replay: str | None = None
    failing_cause: str | None = None
    """The cause alone, to be counted: ``collision``, ``unreachable`` ..."""
    divergence: FirstDivergence | None = None
    """Where planned, executed and recorded part first, of the executed replay."""
    failing_bodies: tuple[str, ...] = ()
    """What touched, came too close or was lost then."""
    failing_stage: str = ""
    """The stage of the plan in which it failed, where the verdict gives an instant."""
    study_arm: str = ""
    """without, with or control; empty outside a study."""
    why_unknown: str = ""
    """What was said of an outcome that is not known."""
    stages: tuple[tuple[str, bool | None], ...] = ()
    """How each stage ended as labelled, in order; empty where nobody said."""
    baselines: tuple[tuple[str, bool], ...] = ()
    """What forecasts without a twin say of the plan sent, by name; unknown ones are left out."""
    began_ns: int = 0
    """When its recording began; 0 where nobody knows, as in a table, whose rows are in order."""
    path: Path | None = None
    start_positions_m: dict[str, tuple[float, float, float]] = field(default_factory=dict)
    """Where the objects were localised at the start, to judge pairs of starts."""

    @property
    def twin(self) -> bool | None:
        """What the twin says of the trial: as planned; without a plan, as executed."""
        return self.sim_executed if self.plan_id == NO_PLAN else self.sim_planned

    @property
    def recorded_word(self) -> str:
        """``stand-in``, ``real`` or ``recorded``: what the recorded side of this row is."""
        return RECORDED_WORDS[self.stand_in]


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
