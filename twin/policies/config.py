"""Settings of rollouts; imports nothing heavy."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from bridge.errors import UsageError, refuse_outside
from bridge.terminal import RARE
from bridge.wire.config import LOOPBACK


def is_driven(policy: str) -> bool:
    """Whether keys drive the arm."""
    return policy.partition(":")[0] == "keys"


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class RolloutConfig:
    """What ``robot-gst rollout`` lets act, and where."""

    policy: str
    """ws://HOST:PORT of a server that speaks openpi's protocol, module:function, or keys: you drive
    in the browser, or by a file of keys (keys:FILE)."""
    name: Annotated[str, RARE] = ""
    """What the policy is called in recordings and tables; none: how it is opened."""
    map: Path | None = None
    """TOML file: what the policy is sent, and how its answer is read (docs/policies.md)."""
    task: str = ""
    """Only starts of this task."""
    starts: str = "recorded"
    """Those of recorded trials, so many drawn from the task file, or one by its id."""
    times: Annotated[int, RARE] = 1
    """Rollouts from each start; three or more show how much a policy varies by itself."""
    vary: Annotated[tuple[str, ...], RARE] = ()
    """What differs from rollout to rollout, up to so much: light=20%, mass=30%, friction=30%,
    objects.position=10mm, camera.side.position=30mm, camera.side.angle=3deg. Which of them goes
    with failure is told; these rollouts are not compared with the cell."""
    cell: str = ""
    """Act in this cell instead, in every trial of the policy that is started at the recorder
    (robot-gst ctl start --policy NAME), until that trial is ended."""
    connect: Annotated[tuple[str, ...], RARE] = LOOPBACK
    """With --cell: where the recorder listens."""
    check: bool = False
    """Send one recorded start, explain the answer, and move nothing."""
    workers: Annotated[int | None, RARE] = None
    """Processes side by side: one for each core, at most 8, when no number is given."""
    force: Annotated[bool, RARE] = False
    """Redo rollouts that are there already."""
    seed: Annotated[int, RARE] = 0
    """Of drawn starts, and of policies that take one."""
    max_s: Annotated[float, RARE] = 30.0
    """Longest rollout [s]."""
    latency_s: Annotated[float, RARE] = 0.0
    """From a picture to the first action that answers it, as measured in the cell [s]."""
    timeout_s: Annotated[float, RARE] = 30.0
    """Longest wait for an answer [s]."""

    def __post_init__(self) -> None:
        """Refuse numbers with which nothing can be rolled out."""
        refuse_outside(
            self,
            {
                "times": (1, 1000),
                "workers": (1, 4096),
                "max_s": (0.1, 600),
                "latency_s": (0, 10),
                "timeout_s": (0.1, 600),
            },
        )
        if is_driven(self.policy) and (self.map or self.cell or self.check):
            raise UsageError("--policy keys drives the twin: leave out --map, --cell and --check")
