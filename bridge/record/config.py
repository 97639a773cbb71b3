"""How the recorder behaves."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from bridge.errors import refuse_outside
from bridge.terminal import RARE

BYTES_PER_MB = 1_000_000
UNBOUNDED = float("inf")
MAX_BACKLOG_BYTES = 16_000_000


@dataclass(frozen=True, kw_only=True)
class QueueConfig:
    """How much may wait in memory, and what is too much to take."""

    camera_queue_mb: Annotated[int, RARE] = 256
    """Memory for images not yet written [MB]; when it is full they are dropped and counted."""
    small_queue_mb: Annotated[int, RARE] = 16
    """Memory for everything else [MB]; its own, so that images never evict joints."""
    max_message_mb: Annotated[float, RARE] = 64.0
    """Larger messages are dropped and counted [MB]."""
    max_rate_hz: Annotated[int, RARE] = 20_000
    """Messages of one topic beyond this many in a second are dropped and counted [1/s]."""
    max_topics: Annotated[int, RARE] = 4096
    """Messages of further topics in one episode are dropped and counted."""

    def __post_init__(self) -> None:
        """Refuse numbers with which nothing could be recorded."""
        names = ("camera_queue_mb", "small_queue_mb", "max_rate_hz", "max_topics")
        refuse_outside(self, dict.fromkeys(names, (1, UNBOUNDED)))
        refuse_outside(self, {"max_message_mb": (0.001, UNBOUNDED)})

    @property
    def max_message_bytes(self) -> int:
        """The limit for one message in bytes."""
        return round(self.max_message_mb * BYTES_PER_MB)


@dataclass(frozen=True, kw_only=True)
class DiskConfig:
    """How episodes lie on the disk, and how much of it is left alone."""

    min_free_mb: Annotated[int, RARE] = 500
    """No episode starts with less free space than this, and an open one is finished at it [MB]."""
    footer_mb: Annotated[int, RARE] = 64
    """Space held back so that an episode can be finished on a full disk [MB]; 0 holds none."""
    flush_s: Annotated[float, RARE] = 0.25
    """What a crash of the recorder may cost, at most [s]."""
    sync_s: Annotated[float, RARE] = 2.0
    """What a power cut may cost, at most [s]."""

    def __post_init__(self) -> None:
        """Refuse negative sizes and times."""
        sizes = ("min_free_mb", "footer_mb")
        refuse_outside(self, dict.fromkeys(sizes, (0, UNBOUNDED)))
        refuse_outside(self, dict.fromkeys(("flush_s", "sync_s"), (0.01, UNBOUNDED)))

    @property
    def reserve_mb(self) -> int:
        """What is held back: at most a half of what must be left, so that an end comes first."""
        return min(self.footer_mb, self.min_free_mb // 2 or self.footer_mb)

    @property
    def backlog_bytes(self) -> int:
        """What may wait for a slow disk; the reserve must take it when the disk is full."""
        held = self.reserve_mb * BYTES_PER_MB // 4
        return min(MAX_BACKLOG_BYTES, held) if held else MAX_BACKLOG_BYTES


@dataclass(frozen=True, kw_only=True)
class RecorderConfig:
    """Settings of one recorder; stored in every episode it writes."""

    recorder: Annotated[str, RARE] = "main"
    """Name of this recorder in its control keys ``rec/NAME/ctl/...``."""
    topics: tuple[str, ...] = ("**",)
    """Zenoh key expressions to record; ``**`` is everything."""
    shares_folder: Annotated[bool, RARE] = False
    """Let other recorders that have this option, too, record into the run folder at the same time;
    whoever starts episodes gives each an id of its own."""
    contract: str | None = None
    """What the cell must publish: a TOML file, or a template by name. Without it the run folder's
    ``cell.toml`` holds, if there is one."""
    color: Literal["jpeg", "as_is"] = "jpeg"
    """Raw colour images: compress as JPEG, or keep every byte."""
    jpeg_quality: Annotated[int, RARE] = 90
    """Of colour that is compressed here, 1 to 100."""
    depth: Literal["raw", "compact"] = "raw"
    """Raw depth images: keep them (every viewer reads those), or compress without loss (RVL)."""
    msg_folder: Annotated[Path | None, RARE] = None
    """Where the .msg files of your own ROS 2 types lie, as PACKAGE/msg/NAME.msg at any depth."""
    preview_hz: Annotated[float, RARE] = 5.0
    """At most this many small pictures a second for whoever watches; 0 makes none [1/s]."""
    command_timeout_s: Annotated[float, RARE] = 60.0
    """A start or stop that the disk has not carried out after this long is reported [s]."""
    queues: Annotated[QueueConfig, Parameter(name="*")] = QueueConfig()
    """Memory and limits."""
    disk: Annotated[DiskConfig, Parameter(name="*")] = DiskConfig()
    """Files and free space."""

    def __post_init__(self) -> None:
        """Refuse numbers with which nothing could be recorded."""
        refuse_outside(self, {"jpeg_quality": (1, 100), "command_timeout_s": (0.1, UNBOUNDED)})
        refuse_outside(self, {"preview_hz": (0, 1000)})


@dataclass(frozen=True, kw_only=True)
class EpisodeAbout:
    """What is being recorded; stored in the episode."""

    kind: str = "trial"
    """scan, trial, retry, probe or imported."""
    task: str = ""
    """Task: its file (my_task.toml), or a name of the run's tasks/ or of datasets/tasks."""
    instruction: Annotated[str, RARE] = ""
    """What the robot was told, in words."""
    condition: str = ""
    """without_replanning or with_replanning."""
    policy: str = ""
    """Name of the planner or policy."""
    start_id: Annotated[str | None, RARE] = None
    """Declared start; trials with the same one are compared."""
    operator: Annotated[str, RARE] = ""
    """Who is there."""
    robot: str = ""
    """Which robot."""
    cell: str = ""
    """Name of the cell, as in its topics."""
    tags: Annotated[tuple[str, ...], RARE] = ()
    """Words to find it by."""
