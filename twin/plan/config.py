"""Settings of the planner; imports nothing heavy."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from bridge.errors import UsageError, refuse_outside
from bridge.task.model_policy import server_of
from bridge.wire.config import LOOPBACK


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class LivePlanConfig:
    """Whom a live planner answers."""

    connect: tuple[str, ...] = LOOPBACK
    """Endpoints of the recorder."""
    zenoh_config: Annotated[Path | None, Parameter(name="--config")] = None
    """zenoh configuration (JSON5), for example with certificates."""
    cell: str = "standin"
    """Whose requests are answered: the service is below this name."""
    robot: str = ""
    """Robot file, by name or path, whose description takes the place of the published one; none:
    the robot that the cell describes (docs/robots.md)."""


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class PlanConfig:
    """How an instruction is planned."""

    rounds: int = 5
    """Candidates that the twin may judge; each is steered by what it said of the one before."""
    seed: int = 0
    """Of everything that is drawn."""
    episode: str = ""
    """Whose start is planned from; none: the newest that shows all objects."""
    model: str = ""
    """Address of an OpenAI-compatible server whose model reads the instruction, such as
    http://127.0.0.1:8000/v1; its key comes from GST_MODEL_KEY. None: fixed rules read it. With
    --live it is asked for requests of policy model alone."""
    model_name: str = ""
    """The server's name for that model."""
    yes: bool = False
    """Plan what the model understood without asking whether that was meant."""

    def __post_init__(self) -> None:
        """Refuse numbers that plan nothing, and half of what a model needs."""
        refuse_outside(self, {"rounds": (1, 1000), "seed": (0, 2**63 - 1)})
        if bool(self.model) != bool(self.model_name):
            message = "a model is asked by its address and its name: --model URL --model-name NAME."
            raise UsageError(message)
        if self.model:
            server_of(self.model)
