"""What a session does; imports nothing heavy, so that the command can show its options."""

from dataclasses import dataclass

from bridge.errors import refuse_outside

CONDITIONS = ("without_replanning", "with_replanning")
SEEDS_PER_SESSION = 1000
"""Session 7 starts at start seed 7000; sessions never share a start."""
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
    scan_id: str = ""
    """Name of the scan's episode; empty: scan_ and the run's next number."""
    trials: int = 3
    """Starts to try, each once per condition; 0 records the scan only."""
    conditions: tuple[str, ...] = CONDITIONS
    """without_replanning, with_replanning or both."""
    first_trial: int | None = None
    """Number of the first trial's episode; without it the run's numbering goes on."""
    missing: bool = False
    """Record only the trials of which the recorder has none yet with the same task, start and
    condition: completes a session that was interrupted."""
    probes: int = 0
    """Rounds of probe episodes after the trials, for calibrate RUN --physics: each round pushes,
    slides, squeezes and drops the first object."""
    first_probe: int | None = None
    """Number of the first probe's episode; without it the run's numbering goes on."""
    rounds: int = 5
    """Plans the gate may see per trial."""
    gate_cell: str = ""
    """Cell name the gate was started with; empty: the same."""
    gate_timeout_s: float = 600.0
    """The cell's clock stands still while the gate judges, so a slow machine changes nothing. This
    limit on the wall clock is the last resort against a gate that hangs: the trial is then void,
    and says so."""
    ask_always: bool = False
    """Ask the gate without replanning too; its verdict is recorded and not obeyed, so that the
    gate's refusals meet an outcome as well."""
    execute_unverified: bool = False
    """With replanning, execute also when no verdict comes; the record says so."""
    recorder: str = "main"
    """Name of the recorder to start and stop."""
    rate_hz: float = 5.0
    """Frames per second of each camera during trials."""
    image_scale: float = 1.0
    """Resize the images of the cell file (320 x 240)."""
    real_time: bool = False
    """Keep pace with the wall clock instead of running as fast as possible."""

    def __post_init__(self) -> None:
        """Refuse numbers that no session can have."""
        most = float("inf")
        allowed: dict[str, tuple[int | float, int | float]] = {
            "seed": (0, 2**31),
            "trials": (0, 8_000),
            "first_trial": (0, 9_999),
            "probes": (0, 1_000),
            "first_probe": (1, 9_999),
            "rounds": (1, 1_000),
            "gate_timeout_s": (0.1, most),
            "rate_hz": (0, 60),
            "image_scale": (0.05, 8),
        }
        refuse_outside(self, allowed)
