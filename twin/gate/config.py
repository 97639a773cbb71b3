"""Settings of the gate; imports nothing heavy."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from bridge.errors import UsageError, refuse_outside
from bridge.terminal import RARE
from bridge.wire.config import LOOPBACK
from twin.replay.config import ReplayConfig
from twin.scene.settings import convert_duration


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class GateConfig:
    """What the gate judges, and how long it may take."""

    connect: tuple[str, ...] = LOOPBACK
    """Endpoints of the recorder."""
    zenoh_config: Annotated[Path | None, Parameter(name="--config")] = None
    """zenoh configuration (JSON5), for example with certificates."""
    cell: str = "standin"
    """Whose plans are judged: topics and the service are below this name."""
    task: str = ""
    """The only task that is judged: a name of the run's tasks/ or of datasets/tasks, or a file;
    empty: whichever of those a plan names with the hash of its file (task, task_sha256)."""
    robot: str = ""
    """Robot file, by name or path, whose description takes the place of the published one; none:
    the robot that the cell describes (docs/robots.md)."""
    max_steps: int = 100_000
    """Simulated steps behind one verdict, the varied replays' among them: the deadline that gives
    the same verdict on every machine. A plan that alone needs more gets no verdict."""
    deadline_s: Annotated[float, Parameter(name="--deadline", converter=convert_duration)] = 300.0
    """Last resort against what hangs: without an answer after this long on the wall clock (20s,
    5min or plain seconds) there is no verdict, and its reason names this limit."""
    waiting: int = 4
    """Plans that may wait while one is judged; more are turned away at once."""
    samples: int = 32
    """Varied replays behind each verdict, for its success probability: as many of them as fit into
    --max-steps, and none once they decide about --min-p-success (0: whether half succeed)."""
    min_p_success: float = 0.0
    """Refuse a plan that the nominal replay accepts when its p_success is less: without trials of
    the cell that is 0.65 at most. 0 leaves the nominal replay alone to decide."""
    frame_wait_s: Annotated[float, RARE] = 10.0
    """Wait this long for fresh frames before giving up."""
    replay: Annotated[ReplayConfig, Parameter(name="replay"), RARE] = field(
        default_factory=ReplayConfig
    )
    """How each plan is replayed."""

    def __post_init__(self) -> None:
        """Refuse numbers with which no gate can work."""
        refuse_outside(
            self,
            {
                "max_steps": (1, 10**9),
                "deadline_s": (0, 86_400),
                "waiting": (0, 1000),
                "samples": (0, 100_000),
                "min_p_success": (0, 1),
                "frame_wait_s": (0, 86_400),
            },
        )
        if self.min_p_success > 0 and self.samples == 0:
            raise UsageError("--min-p-success needs samples to count: leave --samples 0 out.")
