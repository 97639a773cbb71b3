"""Settings of ``robot-gst design``; imports nothing heavy."""

from dataclasses import dataclass
from typing import Annotated

from cyclopts import Parameter

from bridge.errors import refuse_outside
from bridge.terminal import RARE


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class StudyOptions:
    """What is tried; the same options as ``robot-gst trials`` has."""

    task: tuple[str, ...] = ("cube_into_box",)
    """Tasks: names in datasets/tasks or files."""
    any_task: bool = False
    """Accept tasks without a task file, as in a spreadsheet of trials."""
    policies: tuple[str, ...] = ("perturbed",)
    """The first one is tried in --arms, the others in the arm without alone."""
    arms: tuple[str, ...] = ("without", "with")
    """Of the first policy: without, with, control."""
    coin: Annotated[float | None, RARE] = None
    """Arm control: the chance of yes to each plan."""
    rounds: int = 5
    """Plans per trial in the arms with and control."""
    seed: int = 1
    """Draws the laboratory and the starts."""
    study_seed: Annotated[int, RARE] = 0
    """Draws the order of the starts, of the policies and arms on each, and the codes."""
    blind: bool = False
    """Name arms by codes in the operator's list."""

    def __post_init__(self) -> None:
        """Refuse numbers that no study can have."""
        refuse_outside(self, {"coin": (0, 1), "rounds": (1, 1000), "seed": (0, 2**31)})


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class Wanted:
    """What is expected, and what the study is to show; shares from 0 to 1."""

    rate: float | None = None
    """Expected success rate of the arm that is compared with."""
    gain: float | None = None
    """Expected gain over it, which is to be shown: 0.2 is 20 percentage points."""
    correlation: float = 0.0
    """Expected correlation of both outcomes of a start; 0 asks for more starts than more would."""
    power: float = 0.8
    """Chance with which the gain is to be shown."""
    alpha: float = 0.05
    """Chance of a false alarm."""
    starts: int | None = None
    """Starts of each task, whatever would be needed; what they can show is said."""

    def __post_init__(self) -> None:
        """Refuse what is no share."""
        shares = {"rate": (0, 1), "gain": (-1, 1), "correlation": (-1, 1), "power": (0.05, 0.999)}
        refuse_outside(self, shares | {"alpha": (0.0001, 0.5), "starts": (1, 1000)})
