"""Settings of replays, of what their samples vary and of comparisons; imports nothing heavy."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Annotated, Any, Literal

from cyclopts import Parameter

from bridge.errors import UsageError, refuse_outside
from twin.physics.config import ENGINES, RIGID_ONLY, Engine, PhysicsConfig, require_engine
from twin.robot.config import IkConfig

FRICTIONS = ("object_friction", "finger_friction", "surface_friction")
"""Fields of ``PhysicsConfig`` that are frictions."""
GRIP_FORCE = "grip_force_N"
RIGID_MASSES = "masses of rigid objects"
"""Beside fields of ``PhysicsConfig`` among what a calibration found."""


@dataclass(frozen=True, kw_only=True)
class BoxDraw:
    """What one draw says of a rigid object that moves, in parts of its size."""

    name: str
    edge_share: float
    """Width of a step along its edges, in half its smallest extent."""
    centre_of_mass: tuple[float, float, float]
    """From its middle, in half extents."""


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
    boxes: tuple[BoxDraw, ...] = ()
    """Of each rigid object that moves; none in files from before, where they were taken as even."""
    weight: float
    """How much it counts; those of all draws together are 1."""
    wrong_yes: float
    """Chance that a plan fails in this session although the replay with this draw succeeds: from
    something that the twin does not have."""
    wrong_no: float
    """Chance that one succeeds although this replay fails."""

    def to_record(self) -> dict[str, Any]:
        """Return plain numbers."""
        boxes = [{**asdict(box), "centre_of_mass": list(box.centre_of_mass)} for box in self.boxes]
        return {**asdict(self), "bias_m": list(self.bias_m), "boxes": boxes}

    @classmethod
    def from_record(cls, record: Mapping[str, Any]) -> "PosteriorDraw":
        """The inverse of ``to_record``.

        Raises:
            KeyError, TypeError, ValueError: When something lacks or is not a number.
        """
        x, y = record["bias_m"]
        boxes = []
        for box in record.get("boxes", ()):
            a, b, c = box["centre_of_mass"]
            centre = (float(a), float(b), float(c))
            boxes.append(BoxDraw(**{**box, "centre_of_mass": centre}))
        return cls(**{**record, "bias_m": (float(x), float(y)), "boxes": tuple(boxes)})


@dataclass(frozen=True, kw_only=True)
class VariationConfig:
    """Priors that samples are drawn from; where calibration knows better, its spread counts.

    Factors are log-normal around the value the nominal replay uses: a spread of 0.2 means that two
    of three samples lie within 20 %.
    """

    pose_scale: float = 1.0
    """Times the standard deviations that localisation states for each object."""
    unknown_pose_m: float = 0.005
    """Standard deviation along x and y of an object whose localisation states none [m]."""
    unknown_pose_rad: float = 0.05
    """Standard deviation about the vertical of such an object [rad]."""
    friction_log: float = 0.2
    """Spread of the logarithm of each friction coefficient."""
    grip_force_log: float = 0.15
    """Spread of the logarithm of the grip force."""
    mass_log: float = 0.2
    """Spread of the logarithm of each movable object's mass."""
    young_log: float = 0.3
    """Spread of the logarithm of each soft object's Young's modulus."""
    grip_delay_s: float = 0.1
    """The gripper lags behind the arm by up to this long, evenly drawn [s]."""
    calibrated: Annotated[tuple[tuple[str, float], ...], Parameter(parse=False)] = ()
    """Fields of ``PhysicsConfig``, and the masses of rigid objects, with the spread of their
    logarithm that calibration found; they replace the priors above. No flag: read from the scene's
    calibration."""
    posterior: Annotated[tuple[PosteriorDraw, ...], Parameter(parse=False)] = ()
    """What the session's own trials left of wide priors; samples draw frictions, force, masses and
    a common shift of all poses from it instead of from the spreads above. No flag: read from the
    scene's calibration."""

    def __post_init__(self) -> None:
        """Refuse spreads that are none."""
        most = 2.0
        refuse_outside(
            self,
            {
                "pose_scale": (0, 100),
                "unknown_pose_m": (0, most),
                "unknown_pose_rad": (0, most),
                "friction_log": (0, most),
                "grip_force_log": (0, most),
                "mass_log": (0, most),
                "young_log": (0, most),
                "grip_delay_s": (0, most),
            },
        )

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
        spreads = dict.fromkeys(FRICTIONS, self.friction_log) | {GRIP_FORCE: self.grip_force_log}
        known = dict(self.calibrated)
        if known.keys() & set(FRICTIONS[1:]):
            spreads[FRICTIONS[0]] = 0.0
        known.pop(RIGID_MASSES, None)
        return {**spreads, **{name: known[name] for name in sorted(known)}}

    def mass_spread(self, *, soft: bool) -> float:
        """Spread of the logarithm of an object's mass; calibration weighs rigid ones only."""
        return self.mass_log if soft else dict(self.calibrated).get(RIGID_MASSES, self.mass_log)


Mode = Literal["kinematic", "dynamic"]

RANGES: Mapping[str, tuple[float, float]] = {
    "start_rad": (0, 10),
    "start_m": (0, 10),
    "start_overlap_m": (0, 1),
    "eps_col_m": (0, 1),
    "max_contact_depth_m": (0, 1),
    "pre_grasp_depth_m": (0, 1),
    "pre_grasp_soft_depth_m": (0, 1),
    "moved_m": (0, 1),
    "path_step_s": (1e-3, 10),
    "max_joint_step_rad": (0, 10),
    "settle_before_s": (0, 60),
    "settle_after_s": (0, 60),
    "squeeze_m": (0, 0.1),
    "grip_delay_s": (0, 60),
    "samples": (0, 100_000),
}
"""Of the numbers of a replay, ends included."""


@dataclass(frozen=True, kw_only=True)
class DivergenceConfig:
    """Limits beyond which planned, executed and recorded are apart."""

    tool_m: float = 0.01
    """Tool position, after the lag between the two is taken out [m]."""
    tool_rad: float = 0.05
    """Tool rotation [rad]."""
    width_m: float = 0.004
    """Width of the gripper [m]."""
    object_m: float = 0.02
    """Position of an object; the recorded one is localised to a few millimetres [m]."""
    contact_s: float = 0.25
    """When fingers begin or cease to touch an object [s]."""

    def __post_init__(self) -> None:
        """Refuse limits that are none."""
        names = ("tool_m", "tool_rad", "width_m", "object_m", "contact_s")
        refuse_outside(self, dict.fromkeys(names, (0, 1000)))


@dataclass(frozen=True, kw_only=True)
class ReplayConfig:
    """How one trajectory is replayed and when it is accepted."""

    mode: Annotated[Mode, Parameter(parse=False)] = "dynamic"
    """kinematic follows the joints exactly; dynamic lets physics answer. No flag: the commands
    choose it for each trajectory."""
    start_rad: float = 0.05
    """A plan starts no farther than this from where each joint of the robot is [rad]."""
    start_m: float = 0.01
    """Nor its tool farther than this [m]."""
    engine: Annotated[Literal["pybullet", "mujoco", "both"], Parameter(name="--engine")] = (
        "pybullet"
    )
    """What moves rigid bodies: pybullet, mujoco, or both, of which pybullet decides and mujoco is
    reported where it says something else. Soft bodies are pybullet's alone."""
    start_overlap_m: float = 0.006
    """Rigid objects that were localised into each other by up to this are moved apart; deeper ones
    are not evaluated [m]."""
    eps_col_m: float = 0.002
    """Smallest distance between bodies that may not touch, the paper's epsilon_col [m]."""
    max_contact_depth_m: float = 0.005
    """Bodies that may touch may not lie deeper in each other than this [m]."""
    pre_grasp_depth_m: float = 0.002
    """Deepest overlap with an object before the first grasp that localisation may explain [m]."""
    pre_grasp_soft_depth_m: float = 0.004
    """The same for soft objects, which give way. A finger is 12 mm thick: what it is pushed into
    lies at most 6 mm deep in it [m]."""
    moved_m: float = 0.005
    """An object counts as carried or pushed once it is this far from its start [m]."""
    path_step_s: float = 0.04
    """Spacing at which the path between waypoints is checked [s]."""
    max_joint_step_rad: float = 0.3
    """Largest change of a joint within one path step; more is a jump [rad]."""
    sample_rate_hz: int = 60
    """States per second that a replay keeps; divides the physics rate."""
    settle_before_s: float = 0.25
    """Objects come to rest for this long before the trajectory starts [s]."""
    settle_after_s: float = 1.0
    """The robot holds still for this long before the terminal predicate is read [s]."""
    squeeze_m: float = 0.01
    """How far below the recorded width an executed grasp is commanded, so that it presses [m]."""
    seed: int = 0
    """Seed of the samples; nominal replays draw nothing, so it only labels them."""
    grip_delay_s: float = 0.0
    """The gripper acts this much later than the arm [s]; planned trajectories only, a recorded one
    has its own times."""
    samples: Annotated[int, Parameter(parse=False)] = 0
    """Varied replays behind each nominal one. No flag here: the commands have --samples."""
    variation: VariationConfig = field(default_factory=VariationConfig)
    """What the samples vary, and how far."""
    divergence: DivergenceConfig = field(default_factory=DivergenceConfig)
    """From which size on planned, executed and recorded are apart."""
    ik: IkConfig = field(default_factory=IkConfig)
    """When a pose counts as reached."""
    physics: PhysicsConfig = field(default_factory=PhysicsConfig)
    """Nominal physics."""

    def __post_init__(self) -> None:
        """Refuse numbers beyond which no comparison would fail, rates and engines that do not fit.

        Raises:
            UsageError: Saying what does not fit.
            MissingDependencyError: When an engine is not installed.
        """
        refuse_outside(self, RANGES)
        for engine in self.engines():
            require_engine(engine)
        if self.sample_rate_hz < 1 or self.physics.rate_hz % self.sample_rate_hz:
            message = (
                f"sample_rate_hz {self.sample_rate_hz} does not divide the physics rate "
                f"{self.physics.rate_hz} Hz. Choose a divisor, for example 60."
            )
            raise UsageError(message)

    def engines(self) -> tuple[Engine, ...]:
        """What replays a trajectory, the one that decides first."""
        return ENGINES if self.engine == "both" else (self.engine,)

    def refuse_soft(self, soft_objects: Sequence[str]) -> None:
        """Refuse soft objects in an engine that has none.

        Raises:
            UsageError: Naming them, and the engine that has them.
        """
        if soft_objects and self.mode == "dynamic" and "mujoco" in self.engines():
            raise UsageError(f"{', '.join(soft_objects)} cannot be replayed: {RIGID_ONLY}")


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class ReplayRunConfig:
    """What ``robot-gst replay`` replays."""

    episode: tuple[str, ...] = ()
    """Ids of the trial episodes to replay; all of them when none is given."""
    workers: int | None = None
    """Processes that replay side by side, or processors of --ray local: one for each core, at most
    8, when no number is given. A cluster that is there uses its own."""
    ray: str = ""
    """Replay on a Ray cluster instead: its HOST:PORT, or local to start one on this machine;
    docs/scale.md says how it is kept closed."""
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
    relocalise: bool = False
    """Redo the localisation of objects that is there already."""
    replay: Annotated[ReplayConfig, Parameter(name="replay")] = field(default_factory=ReplayConfig)
    """How each trajectory is replayed."""

    def __post_init__(self) -> None:
        """Refuse numbers with which nothing can be replayed."""
        refuse_outside(self, {"workers": (1, 4096), "samples": (0, 100_000)})
