"""What a session does; imports nothing heavy, so that the command can show its options."""

from dataclasses import dataclass
from typing import Annotated

from bridge.episode.metadata import CONDITION_OF, WITH, WITHOUT
from bridge.errors import UsageError, refuse_outside
from bridge.task.protocol import SEEDS_PER_SESSION
from bridge.terminal import RARE

CONDITIONS = (WITHOUT, WITH)
BUILT_IN, WIRE, POLICY = "built_in", "wire", "policy"
PLANNERS = (BUILT_IN, WIRE, POLICY)
INTERRUPTED = "interrupted"
"""What an episode's outcome says that was ended before its time."""


@dataclass(frozen=True, kw_only=True)
class SessionConfig:
    """What the stand-in cell's operator does in one session."""

    cell: str = "standin"
    """Name of the cell in topics."""
    cell_file: str = ""
    """Cell file: a name in datasets/cells or a path; empty: the one the task names."""
    task: str = "cube_into_box"
    """Task file: a name in datasets/tasks (cube_into_box, sloth_into_basket,
    five_ducks_into_basket) or a path."""
    seed: int = 0
    """Draws the hidden laboratory and the starts; same seed, same session."""
    scan: bool = True
    """Record a scan first."""
    trials: int = 3
    """Starts to try, each once per condition; 0 records the scan only."""
    first_start: Annotated[int, RARE] = 0
    """Leave out so many starts of the session: one that is tried alone is the same start."""
    conditions: tuple[str, ...] = CONDITIONS
    """without_replanning, with_replanning or both."""
    first_trial: Annotated[int | None, RARE] = None
    """Number of the first trial's episode; without it the run's numbering goes on."""
    missing: Annotated[bool, RARE] = False
    """Record only the trials of which the recorder has none yet with the same task, start,
    condition and policy: completes a session that was interrupted."""
    planner: str = BUILT_IN
    """Who plans: built_in (scripted, careless), wire (robot-gst plan RUN --live), or policy,
    whose targets are followed instead (robot-gst rollout RUN --cell)."""
    policy: str = ""
    """How it plans; empty: perturbed for the built-in planner, nominal for one on the wire."""
    max_s: Annotated[float, RARE] = 30.0
    """A policy's trial ends after so long."""
    planner_timeout_s: Annotated[float, RARE] = 600.0
    """Last resort on the wall clock against a planner that hangs."""
    study_arms: Annotated[tuple[str, ...], RARE] = ()
    """A study instead of the conditions: without, with, control. Each start once per arm, in an
    order of its own; the gate is asked in every arm and obeyed in one, and what is not executed is
    a failure."""
    study_seed: Annotated[int, RARE] = 0
    """Draws the order of the arms and the coins."""
    coin: Annotated[float | None, RARE] = None
    """In the arm control, the chance of yes to each plan: the gate's share of yes on development
    seeds."""
    rounds: int = 5
    """Plans the gate may see per trial."""
    retry: Annotated[bool, RARE] = False
    """After an execution that failed, put the objects back, look and plan anew: one new start of
    the same trial, in an episode of its own (retry_...), which counts in no rate of trials."""
    gate_timeout_s: Annotated[float, RARE] = 600.0
    """The cell's clock stands still while the gate judges, so a slow machine changes nothing. This
    limit on the wall clock is the last resort against a gate that hangs: the trial is then void,
    and says so."""
    ask_always: Annotated[bool, RARE] = False
    """Ask the gate without replanning too; its verdict is recorded and not obeyed, so that the
    gate's refusals meet an outcome as well."""
    recorder: Annotated[str, RARE] = "main"
    """Name of the recorder to start and stop."""
    rate_hz: float = 5.0
    """Frames per second of each camera during trials."""
    image_scale: Annotated[float, RARE] = 1.0
    """Resize the images of the cell file (320 x 240)."""

    def __post_init__(self) -> None:
        """Refuse numbers and words that no session can have."""
        _refuse_other("--planner", (self.planner,), PLANNERS)
        _refuse_other("--conditions", self.conditions, CONDITIONS)
        _refuse_other("--study-arms", self.study_arms, tuple(CONDITION_OF))
        if "control" in self.study_arms and self.coin is None:
            raise UsageError("the arm control needs --coin, the chance of yes to each plan.")
        if self.planner == POLICY and not self.policy:
            raise UsageError("--planner policy needs --policy NAME, as robot-gst rollout has it.")
        most = float("inf")
        allowed: dict[str, tuple[int | float, int | float]] = {
            "seed": (0, 2**31),
            "trials": (0, 8_000),
            "first_start": (0, SEEDS_PER_SESSION - 1),
            "first_trial": (0, 9_999),
            "rounds": (1, 1_000),
            "planner_timeout_s": (0.1, most),
            "max_s": (0.1, 600),
            "study_seed": (0, 2**31),
            "coin": (0, 1),
            "gate_timeout_s": (0.1, most),
            "rate_hz": (0, 60),
            "image_scale": (0.05, 8),
        }
        refuse_outside(self, allowed)


def _refuse_other(option: str, given: tuple[str, ...], known: tuple[str, ...]) -> None:
    for name in given:
        if name not in known:
            raise UsageError(f"{option} {name!r} is unknown. There are: {', '.join(known)}.")
