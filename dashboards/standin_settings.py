"""Settings of what runs the stand-in cell from end to end; imports nothing heavy."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from bridge.errors import UsageError, refuse_outside
from bridge.task.model_policy import MODEL_POLICY
from bridge.task.protocol import SEEDS_PER_SESSION
from bridge.terminal import RARE
from dashboards.config import PORTS

BUILT_IN_POLICY = "perturbed"
"""Of the cell's own planner; the others are asked on the wire."""


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class TrialsConfig:
    """A study of replanning in the stand-in cell."""

    task: tuple[str, ...] = ("cube_into_box",)
    """Tasks: names in datasets/tasks, files, or all, which is every one that ships."""
    policies: tuple[str, ...] = ("perturbed",)
    """How plans are made: perturbed, the cell's own planner, or a policy of robot-gst plan --live,
    of which model needs --model and --model-name; or one that acts: NAME=ws://HOST:PORT or
    NAME=module:function, as robot-gst rollout has it, which is rolled out in the twin afterwards.
    The first one is tried in --arms, the others, and who acts, in the arm without alone."""
    map: Annotated[Path | None, RARE] = None
    """Mapping of the policies that act."""
    trials: int = 5
    """Starts of each task; each is tried once in each arm of each policy."""
    first_start: int = 0
    """Number of the first of them in the session; runs of other starts share none with this one."""
    model: str = ""
    """Policy model: address of an OpenAI-compatible server whose model adds constraints to its
    stages; the key comes from GST_MODEL_KEY. Only the planners ask it, and no image is sent."""
    model_name: str = ""
    """The server's name for that model."""
    calibration: Path | None = None
    """A run of the same session and of other starts, after calibrate --posterior: gate and replays
    use what was learned there of each task."""
    arms: tuple[str, ...] = ("without", "with")
    """Of the first policy: without, with, control."""
    coin: float | None = None
    """Arm control: the chance of yes to each plan; or --development."""
    development: Path | None = None
    """Arm control: a run whose gate's share of yes, by task, is that chance; its seeds are no part
    of the study."""
    rounds: int = 5
    """Plans per trial in the arms with and control."""
    retry: bool = False
    """After each failed execution, reset, localise and plan anew, once. Counted and shown apart."""
    seed: int = 1
    """Draws the laboratory and the starts."""
    study_seed: Annotated[int, RARE] = 0
    """Draws the order of the arms on each start, of the starts, and the coins."""
    workers: int = 0
    """Cells at work at once, each with its recorder, gate and planner; 0: one per core."""
    samples: int = 0
    """Varied replays behind each verdict of the replay afterwards."""

    def __post_init__(self) -> None:
        """Refuse numbers that no study can have."""
        refuse_outside(
            self,
            {
                "trials": (1, SEEDS_PER_SESSION),
                "first_start": (0, SEEDS_PER_SESSION - self.trials),
                "coin": (0, 1),
                "rounds": (1, 1000),
                "workers": (0, 256),
                "samples": (0, 100_000),
            },
        )
        named = {bool(self.model), bool(self.model_name), MODEL_POLICY in self.policies}
        acting = self.acting()
        if len(acting) < sum("=" in each for each in self.policies):
            raise UsageError(f"--policies: two that act have the same name: {self.policies}.")
        if len(named) > 1:
            message = (
                "policy model and the model it asks go together: --policies model --model URL "
                "--model-name NAME."
            )
            raise UsageError(message)

    def acting(self) -> dict[str, str]:
        """How each policy that acts is opened, by its name."""
        return dict(each.split("=", 1) for each in self.policies if "=" in each)


DEMO_TASKS = ("cube_into_box", "cube_on_block")
"""Two, so that the correlation over groups is defined."""


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class DemoConfig:
    """What the demo does."""

    quick: bool = False
    """Two trials per condition and a short fit."""
    full: bool = False
    """Ten trials per condition, the number the paper used, and a longer fit."""
    seed: int = 1
    """Start positions and grasp errors of the trials; the cell's hidden parameters too."""
    task: tuple[str, ...] = ()
    """Tasks of the trials, names or files: without and with replanning by the cell's own planner.
    The first one is scanned. Default: cube_into_box and cube_on_block; with --quick the first."""
    policies: tuple[str, ...] = ()
    """Policies that try every task too, without replanning, as in robot-gst plan --live, such as
    nominal. Default: nominal; with --quick, or with the cell's own policy alone, none."""
    serve: bool | None = None
    """Keep the dashboard running until Ctrl-C. Default: only on a terminal."""
    port: int = 0
    """Port of the dashboard; 0 takes a free one."""

    def __post_init__(self) -> None:
        """Refuse now what would end the demo after minutes."""
        refuse_outside(self, PORTS)
        if MODEL_POLICY in self.policies:
            message = (
                "the demo asks no model: robot-gst trials RUN --policies model --model URL "
                "--model-name NAME."
            )
            raise UsageError(message)

    @property
    def tasks(self) -> tuple[str, ...]:
        """Tasks of the trials."""
        return self.task or (DEMO_TASKS[:1] if self.quick else DEMO_TASKS)

    @property
    def other_policies(self) -> tuple[str, ...]:
        """Policies that are not the cell's own planner's."""
        chosen = self.policies or (() if self.quick else ("nominal",))
        return tuple(each for each in chosen if each != BUILT_IN_POLICY)

    @property
    def trials(self) -> int:
        """Trials per condition."""
        return 10 if self.full else 2 if self.quick else 3

    @property
    def iterations(self) -> int:
        """Images that the scene is fitted to: 15, 40 and 90 s on two idle cores."""
        return 7000 if self.full else 1000 if self.quick else 1800

    @property
    def limit(self) -> str:
        """Time after which the fit ends all the same, and is reported as underfitted."""
        return "60min" if self.full else "15min" if self.quick else "30min"

    @property
    def samples(self) -> int:
        """Varied replays behind each verdict; toys take seconds for each, and have none."""
        from bridge.task.find import chosen_task_file  # noqa: PLC0415  # not for --help

        soft = any(chosen_task_file(each).task().soft_objects for each in self.tasks)
        return 0 if self.quick or soft else 8
