"""Settings of replays, of what their samples vary and of comparisons; imports nothing heavy."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated, Literal

from cyclopts import Parameter

from bridge.errors import UsageError, refuse_outside
from bridge.terminal import RARE
from twin.physics.config import RIGID_ONLY, Engine, PhysicsConfig, Unseen, require_engine

FRICTIONS = ("object_friction", "finger_friction", "surface_friction")
"""Fields of ``PhysicsConfig`` that are frictions."""
GRIP_FORCE = "grip_force_N"


@dataclass(frozen=True, kw_only=True)
class PosteriorDraw:
    """One draw of what nobody measured and all trials of a session have in common."""

    finger_pair_friction: float
    """Between the pads and objects, whatever share each has in it."""
    surface_pair_friction: float
    """Between objects and the table."""
    mass_scale: float
    """Times the masses of the task file."""
    grip_scale: float
    """Times the force that the gripper is said to have."""
    bias_m: tuple[float, float]
    """Added to every localised pose along x and y [m]."""
    unseen: tuple[tuple[str, Unseen], ...] = ()
    """Of rigid objects that move; what is not here is drawn anew in each sample."""
    weight: float
    """How much it counts; those of all draws together are 1."""
    wrong_yes: float
    """Chance that a plan fails in this session although the replay with this draw succeeds: from
    something that the twin does not have."""
    wrong_no: float
    """Chance that one succeeds although this replay fails."""


UNKNOWN_POSE_M = 0.005
"""Standard deviation along x and y of an object whose localisation states none [m]."""
UNKNOWN_POSE_RAD = 0.05
"""Standard deviation about the vertical of such an object [rad]."""
UNKNOWN_LOG = 0.4
"""Spread of the logarithm of a friction, a mass or a force that nobody measured: two of three lie
within a factor of 1.5. Nothing narrower is known of an object by its description."""


@dataclass(frozen=True, kw_only=True)
class VariationConfig:
    """What calibration knows better than the priors that samples are drawn from."""

    calibrated: tuple[tuple[str, float], ...] = ()
    """Fields of ``PhysicsConfig`` with the spread of their logarithm that calibration found; they
    replace the priors."""
    masses: tuple[tuple[str, float], ...] = ()
    """Objects that were weighed in the hand, with the spread of the logarithm of their mass."""
    posterior: tuple[PosteriorDraw, ...] = ()
    """What the session's own trials left of wide priors; samples draw frictions, force, masses and
    a common shift of all poses from it instead of from the priors."""

    def draw_at(self, share: float) -> PosteriorDraw | None:
        """The draw at a share of the posterior's weight, 0 to 1; None: there is no posterior."""
        if not self.posterior:
            return None
        below = 0.0
        for draw in self.posterior:
            below += draw.weight
            if share < below:
                return draw
        return self.posterior[-1]

    def physics_spreads(self) -> dict[str, float]:
        """Spread of the logarithm per field of ``PhysicsConfig``, in a fixed order.

        What a calibration finds of fingers and surfaces is found together with the objects: their
        own coefficient is then not varied once more.
        """
        spreads = dict.fromkeys((*FRICTIONS, GRIP_FORCE), UNKNOWN_LOG)
        if self.posterior:
            spreads = dict.fromkeys(spreads, 0.0)
        known = dict(self.calibrated)
        if known.keys() & set(FRICTIONS[1:]):
            spreads[FRICTIONS[0]] = 0.0
        return {**spreads, **{name: known[name] for name in sorted(known)}}

    def mass_spread(self, name: str) -> float:
        """Spread of the logarithm of an object's mass; draws of a posterior have it already."""
        return dict(self.masses).get(name, 0.0 if self.posterior else UNKNOWN_LOG)


Mode = Literal["kinematic", "dynamic"]

START_RAD, START_M = 0.05, 0.01
"""A plan starts no farther than this from where each joint of the robot is, nor its tool."""
MOVED_M = 0.005
"""An object counts as carried or pushed once it is this far from its start [m]."""
STATE_EVERY = 4
"""Steps of physics between two states that are kept: 60 Hz at 240 steps a second."""
PATH_RATE_HZ = 25
PATH_STEP_S = 1 / PATH_RATE_HZ
"""Spacing at which the path between waypoints is checked [s]."""


@dataclass(frozen=True, kw_only=True)
class ReplayConfig:
    """How one trajectory is replayed and when it is accepted."""

    mode: Annotated[Mode, Parameter(parse=False)] = "dynamic"
    """kinematic follows the joints exactly; dynamic lets physics answer. No flag: the commands
    choose it for each trajectory."""
    engine: Annotated[Engine, Parameter(name="--engine", show=True)] = "pybullet"
    """What moves rigid bodies; soft ones are pybullet's alone."""
    eps_col_m: float = 0.002
    """Smallest distance between bodies that may not touch, the paper's epsilon_col [m]."""
    settle_before_s: float = 0.25
    """Objects come to rest for this long before the trajectory starts [s]."""
    settle_after_s: float = 1.0
    """The robot holds still for this long before the terminal predicate is read [s]."""
    seed: int = 0
    """Seed of the samples; nominal replays draw nothing, so it only labels them."""
    grip_delay_s: Annotated[float, Parameter(parse=False)] = 0.0
    """The gripper acts this much later than the arm [s]; planned trajectories only, a recorded one
    has its own times. No flag: samples draw it."""
    samples: Annotated[int, Parameter(parse=False)] = 0
    """Varied replays behind each nominal one. No flag here: the commands have --samples."""
    variation: Annotated[VariationConfig, Parameter(parse=False)] = field(
        default_factory=VariationConfig
    )
    """No flag: read from the scene's calibration."""
    physics: PhysicsConfig = field(default_factory=PhysicsConfig)
    """Nominal physics."""

    def __post_init__(self) -> None:
        """Refuse numbers beyond which no comparison fails, and engines that are not there."""
        durations = ("settle_before_s", "settle_after_s", "grip_delay_s")
        refuse_outside(self, {"eps_col_m": (0, 1), **dict.fromkeys(durations, (0, 60))})
        require_engine(self.engine)

    @property
    def states_hz(self) -> int:
        """States per second that a replay keeps."""
        return self.physics.rate_hz // STATE_EVERY

    def refuse_soft(self, soft_objects: Sequence[str]) -> None:
        """Refuse soft objects in an engine that has none."""
        if soft_objects and self.mode == "dynamic" and self.engine == "mujoco":
            raise UsageError(f"{', '.join(soft_objects)} cannot be replayed: {RIGID_ONLY}")


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class ReplayRunConfig:
    """What ``robot-gst replay`` replays."""

    episode: tuple[str, ...] = ()
    """Ids of the trial episodes to replay; all of them when none is given."""
    workers: int | None = None
    """Processes that replay side by side: one for each core, at most 8, when no number is given."""
    ray: str = ""
    """Replay on a Ray cluster instead: its HOST:PORT; docs/scale.md says how it is kept closed."""
    samples: int = 0
    """Varied replays of each plan; they give the success probability of its verdict. A kinematic
    replay moves no objects and has none."""
    render: bool = False
    """Also draw what the recorded cameras would have seen, with the rebuilt scene's Gaussians."""
    force: bool = False
    """Redo replays that are there already."""
    robot: str = ""
    """Robot file, by name or path, whose description takes the place of the recorded one; none:
    the robot that each episode was recorded with (docs/robots.md)."""
    replay: Annotated[ReplayConfig, Parameter(name="replay"), RARE] = field(
        default_factory=ReplayConfig
    )
    """How each trajectory is replayed."""

    def __post_init__(self) -> None:
        """Refuse numbers with which nothing can be replayed."""
        refuse_outside(self, {"workers": (1, 4096), "samples": (0, 100_000)})
