"""How the recorder behaves."""

from dataclasses import dataclass

from bridge.errors import refuse_outside

BYTES_PER_MB = 1_000_000


@dataclass(frozen=True, kw_only=True)
class RecorderConfig:
    """Settings of one recorder; stored in every episode it writes."""

    recorder: str = "main"
    """Name of this recorder in its control keys ``rec/<name>/ctl/...``."""
    topics: tuple[str, ...] = ("**",)
    """Zenoh key expressions to record; ``**`` is everything."""
    queue_mb: int = 256
    """Memory for messages not yet written [MB]; what comes on top is dropped and counted."""
    small_reserve_mb: int = 16
    """Part of it that only messages under 64 kB may use, so that images never evict joints [MB]."""
    max_topics: int = 4096
    """Messages of further topics in one episode are dropped and counted."""
    command_timeout_s: float = 60.0
    """A start or stop that the disk has not carried out after this long is reported [s]."""

    def __post_init__(self) -> None:
        """Refuse numbers with which nothing could be recorded."""
        most = float("inf")
        refuse_outside(self, {"queue_mb": (1, most), "max_topics": (1, most)})
        refuse_outside(self, {"small_reserve_mb": (0, self.queue_mb)})
        refuse_outside(self, {"command_timeout_s": (0.1, most)})


@dataclass(frozen=True, kw_only=True)
class EpisodeAbout:
    """What is being recorded; stored in the episode."""

    kind: str = "trial"
    """scan, trial, probe or imported."""
    task: str = ""
    """Id of the task file."""
    instruction: str = ""
    """What the robot was told, in words."""
    condition: str = ""
    """without_replanning or with_replanning."""
    policy: str = ""
    """Name of the planner or policy."""
    start_id: str | None = None
    """Declared start; trials with the same one are compared."""
    operator: str = ""
    """Who is there."""
    robot: str = ""
    """Which robot."""
    cell: str = ""
    """Name of the cell, as in its topics."""
