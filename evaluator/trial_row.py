"""One recorded trial beside its replays: the row that comparison, report and review pages share."""

from dataclasses import dataclass, field

from bridge.episode.executions import NO_PLAN
from bridge.episode.metadata import ROLLOUT

RECORDED_WORDS = {True: "stand-in", False: "real", None: "recorded"}
"""What the recorded side is called."""


@dataclass(frozen=True, kw_only=True)
class TrialRow:
    """One recorded trial beside its replays. None means unknown, undecided or not there."""

    episode: str
    """Id of the recorded episode, or the trial id of a trials CSV."""
    file: str = ""
    """Name in ``episodes/``; empty for a trial of a table, which has no page."""
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
    divergence: str = ""
    """What parts planned, executed and recorded first (tracking, perception, contact, predicate),
    of the executed replay; empty where nothing does."""
    failing_bodies: tuple[str, ...] = ()
    """What touched, came too close or was lost then."""
    failing_stage: str = ""
    """The stage of the plan in which it failed, where the verdict gives an instant."""
    study_arm: str = ""
    """without, with or control; empty outside a study."""
    why_unknown: str = ""
    """What was said of an outcome that is not known."""
    checkpoint: str = ""
    """Who acted under the policy's name, where somebody says so."""
    progress: float | None = None
    """Part of the task that was done, 0 to 1."""
    time_s: float | None = None
    """How long a success took."""
    stages: tuple[tuple[str, bool | None], ...] = ()
    """How each stage ended as labelled, in order; empty where nobody said."""
    baselines: tuple[tuple[str, bool], ...] = ()
    """What forecasts without a twin say of the plan sent, by name; unknown ones are left out."""
    began_ns: int = 0
    """When its recording began; 0 where nobody knows, as in a table, whose rows are in order."""
    start_positions_m: dict[str, tuple[float, float, float]] = field(default_factory=dict)
    """Where the objects were localised at the start, to judge pairs of starts."""

    # Found for the review pages, where one failure and one start are held against the others.

    distance_m: float | None = None
    """Largest distance of the recorded tool's path from the planned replay's, the lag taken out."""
    lag_s: float | None = None
    """By how much the recorded tool comes later than the planned replay's."""
    failed_stage: str = ""
    """The first stage labelled a failure, of a recorded failure; empty otherwise."""
    fail_cause: str = ""
    """What kind of failure it is (``FailureKind``); empty for one that failed on neither side."""
    fail_stage: str = ""
    fail_bodies: str = ""
    start_region: str = ""
    """Where the object of its task started that is placed most differently."""

    @property
    def had_plan(self) -> bool:
        """Whether what moved the robot had been announced; also where nothing moved it."""
        return self.plan_id != NO_PLAN

    @property
    def is_rolled_out(self) -> bool:
        """Whether a policy's rollout stands where a plan's replay would."""
        return self.plan_id == ROLLOUT

    @property
    def twin(self) -> bool | None:
        """What the twin says of the trial: as planned; without a plan, as executed."""
        return self.sim_planned if self.had_plan else self.sim_executed

    @property
    def twin_replay(self) -> str | None:
        """The file that ``twin`` comes from."""
        return self.planned_replay if self.had_plan else self.executed_replay

    @property
    def agrees(self) -> bool | None:
        """Whether the twin and the outcome agree; None when one of them is unknown."""
        return None if self.twin is None or self.recorded is None else self.twin == self.recorded

    @property
    def recorded_word(self) -> str:
        """``stand-in``, ``real`` or ``recorded``: what the recorded side of this row is."""
        return RECORDED_WORDS[self.stand_in]
