"""The cell file: what the laboratory publishes of itself, and the ranges of what it hides."""

import tomllib
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from jaxtyping import Float

from bridge.data_files import dataset_file
from bridge.errors import UsageError
from bridge.geometry import se3
from bridge.geometry.camera import Camera
from bridge.robots.default import ARM_JOINTS
from bridge.sources.standin.clutter import CLUTTER
from bridge.sources.standin.deviations import RANGES, Deviations, draw_deviations
from bridge.task.task_file import Task

SCHEMA_VERSION = 1
PERCEPTIONS = ("noise", "gate")
Ranges = dict[str, tuple[float, float]]


@dataclass(frozen=True, kw_only=True)
class CameraMount:
    """One camera as the laboratory believes it to be."""

    camera: Camera
    parent: str
    """``tool0`` for the wrist camera, ``base_link`` for a fixed one."""
    T_parent_camera: Float[np.ndarray, "4 4"]

    @property
    def moving(self) -> bool:
        """Whether the robot carries it."""
        return self.parent != "base_link"


@dataclass(frozen=True, kw_only=True)
class SensorModel:
    """Noise of cameras and encoders; see the cell file for sources and units."""

    depth_noise_per_m: float
    """Standard deviation at 1 m [m]; grows with the square of the distance."""
    depth_min_m: float
    depth_max_m: float
    grazing_cosine: float
    """No depth where the ray meets the surface at a flatter angle."""
    image_noise: float
    """Standard deviation in grey levels of 255."""
    encoder_noise_rad: float


@dataclass(frozen=True, kw_only=True)
class PlannerNoise:
    """How wrong the scripted planner is, standard deviations."""

    perception_m: float
    perception_rad: float
    grasp_along_m: float
    """Sideways along the pads (tool x), where the fingers can close on nothing."""
    grasp_across_m: float
    """In the closing direction (tool y), where a finger can land on the object."""
    grasp_yaw_rad: float
    grasp_height_m: float
    release_m: float
    reset_m: float
    """The operator's, when objects are put back to the declared start."""
    reset_rad: float
    perception: str = "noise"
    """Where the planner has the objects' poses from: ``noise``, the true ones with seeded errors,
    or ``gate``, what the gate localises in the cell's own images."""


@dataclass(frozen=True, kw_only=True)
class Clutter:
    """Something on the table that no task is about: a box, or a mesh by its name."""

    shape: str
    size_m: tuple[float, float, float]
    T_base_clutter: Float[np.ndarray, "4 4"]
    """Origin in the middle."""
    color_srgb: tuple[int, int, int]


@dataclass(frozen=True, kw_only=True)
class CellFile:
    """One ``datasets/cells/*.toml``."""

    name: str
    home_m: tuple[float, float, float]
    max_joint_speed_rad_s: float
    cameras: dict[str, CameraMount]
    uniform: Ranges
    normal: dict[str, float]
    sensors: SensorModel
    planner: PlannerNoise
    test_seeds: tuple[int, int]
    development_seeds: tuple[int, int]
    clutter: tuple[Clutter, ...] = ()
    planner_of: dict[str, PlannerNoise] = field(default_factory=dict)
    """Tasks the planner is differently wrong at."""
    deviations: Ranges = field(default_factory=dict)
    """Ranges of what else differs from what is published; empty: nothing does."""
    ranges_of: dict[str, Ranges] = field(default_factory=dict)
    """Per task: ranges, of ``uniform`` or ``deviations``, that are its own."""
    each_start: Ranges = field(default_factory=dict)
    """Factors on ``uniform`` for each start's own objects; empty: a session has the same ones."""

    def noise_for(self, task_name: str) -> PlannerNoise:
        """Return how wrong the scripted planner is at a task."""
        return self.planner_of.get(task_name, self.planner)


def load_cell(name: str) -> CellFile:
    """Load ``datasets/cells/<name>.toml`` or a TOML file by path.

    A file that says ``like = "other"`` holds what differs from that cell.
    """
    path = dataset_file("cells", name)
    table = read_tables(path)
    try:
        return _cell_from(_whole(table))
    except (KeyError, TypeError, ValueError, AttributeError, RecursionError) as error:
        message = (
            f"{path} is not a cell file: {type(error).__name__} {error}. "
            "Compare it with datasets/cells/standin.toml."
        )
        raise UsageError(message) from error


def _whole(table: dict[str, Any]) -> dict[str, Any]:
    if "like" not in table:
        return table
    return _laid_over(_whole(read_tables(dataset_file("cells", table["like"]))), table)


def _laid_over(base: dict[str, Any], table: dict[str, Any]) -> dict[str, Any]:
    """Lay what a table names over another; tables inside of it likewise."""
    merged = dict(base)
    for key, value in table.items():
        nested = isinstance(value, dict) and isinstance(base.get(key), dict)
        merged[key] = _laid_over(base[key], value) if nested else value
    return merged


def _cell_from(table: dict[str, Any]) -> CellFile:
    if table["schema_version"] > SCHEMA_VERSION:
        message = f"schema_version {table['schema_version']} is newer than {SCHEMA_VERSION}"
        raise ValueError(message)
    planner, planner_of = _planners(table["planner"])
    hidden, seeds = table["hidden"], msgspec.convert(table["seeds"], dict[str, tuple[int, int]])
    return CellFile(
        name=table["name"],
        home_m=msgspec.convert(table["robot"]["home_m"], tuple[float, float, float]),
        max_joint_speed_rad_s=table["robot"]["max_joint_speed_rad_s"],
        cameras={key: _mount_from(value) for key, value in table["cameras"].items()},
        uniform=msgspec.convert(hidden["uniform"], Ranges),
        normal=dict(hidden["normal"]),
        sensors=SensorModel(**table["sensors"]),
        planner=planner,
        test_seeds=seeds["test"],
        development_seeds=seeds["development"],
        clutter=tuple(_clutter_from(item) for item in table.get("clutter", [])),
        planner_of=planner_of,
        deviations=_deviations(hidden.get("deviations", {})),
        ranges_of=msgspec.convert(hidden.get("tasks", {}), dict[str, Ranges]),
        each_start=msgspec.convert(hidden.get("each_start", {}), Ranges),
    )


def _deviations(table: dict[str, Any]) -> Ranges:
    """Read the ranges; a cell has all of them or none."""
    if table and set(table) != set(RANGES):
        wrong = sorted(set(table) ^ set(RANGES))
        message = f"hidden.deviations: {', '.join(wrong)}: missing or unknown"
        raise ValueError(message)
    return msgspec.convert(table, Ranges)


def _planners(table: dict[str, Any]) -> tuple[PlannerNoise, dict[str, PlannerNoise]]:
    """Read the common table, and for each task named in it what differs there."""
    common = {key: value for key, value in table.items() if not isinstance(value, dict)}
    noise = PlannerNoise(**common)
    if noise.perception not in PERCEPTIONS:
        message = f"planner.perception {noise.perception!r}; known: {', '.join(PERCEPTIONS)}"
        raise ValueError(message)
    differing = {key: value for key, value in table.items() if isinstance(value, dict)}
    return noise, {key: replace(noise, **value) for key, value in differing.items()}


def _clutter_from(table: dict[str, Any]) -> Clutter:
    shape = table["shape"]
    if shape != "box" and shape not in CLUTTER:
        message = f"clutter shape {shape!r}; known: box, {', '.join(sorted(CLUTTER))}"
        raise ValueError(message)
    return Clutter(
        shape=shape,
        size_m=tuple(table["size_m"]),
        T_base_clutter=se3.small_motion(np.array([0.0, 0.0, table["yaw_rad"], *table["p_m"]])),
        color_srgb=tuple(table.get("color_srgb", (128, 128, 128))),
    )


def _mount_from(table: dict[str, Any]) -> CameraMount:
    width, height = table["width"], table["height"]
    camera = Camera(
        width=width,
        height=height,
        fx=table["fx"],
        fy=table["fy"],
        cx=table.get("cx", width / 2),
        cy=table.get("cy", height / 2),
    )
    return CameraMount(camera=camera, parent=table["parent"], T_parent_camera=_mount_pose(table))


def _mount_pose(table: dict[str, Any]) -> Float[np.ndarray, "4 4"]:
    if "eye_m" in table:
        up = np.array([0.0, 0.0, 1.0])
        return se3.look_at(np.array(table["eye_m"]), np.array(table["target_m"]), up)
    tilt = se3.rotation_from_vector(np.array([table["tilt_rad"], 0.0, 0.0]))
    return se3.from_rotation(np.array(table["R_columns"]).T @ tilt, table["p_m"])


HIDDEN_STREAM = 101
"""Keeps the draw of the hidden parameters apart from every other draw of the same seed."""


@dataclass(frozen=True, kw_only=True)
class HiddenParameters:
    """The true laboratory, as far as it differs from what it publishes of itself."""

    finger_friction: float
    object_friction: float
    mass_scale: float
    grip_N: float
    latency_s: float
    depth_scale: float
    depth_offset_m: float
    image_gain: float
    joint_offset_rad: Float[np.ndarray, "6"]
    """Encoder reading minus true angle."""
    camera_errors: dict[str, Float[np.ndarray, "4 4"]]
    """Per camera ``T_nominal_true``: the true camera seen from where it is believed to be."""
    stiffness_scale: float | None = None
    """Times the nominal stiffness of soft objects; None in a cell that has none."""
    deviations: Deviations | None = None
    """What else is not as published; None in a cell that hides nothing else."""

    def to_record(self) -> dict[str, Any]:
        """Return plain numbers for the truth topic."""
        record = {key: value for key, value in asdict(self).items() if value is not None}
        record["joint_offset_rad"] = self.joint_offset_rad.tolist()
        record["camera_errors"] = {
            key: T.round(9).tolist() for key, T in self.camera_errors.items()
        }
        return record


def draw_hidden(
    cell: CellFile, seed: int, task: Task | None = None, start_seed: int | None = None
) -> HiddenParameters:
    """Draw one laboratory, the same for one cell file and seed; as it is at a start, if any."""
    rng = np.random.default_rng([HIDDEN_STREAM, seed])
    own = {} if task is None else cell.ranges_of.get(task.name, {})
    ranges = cell.uniform | {key: own[key] for key in own if key in cell.uniform}
    uniform = {key: float(rng.uniform(*ranges[key])) for key in sorted(ranges)}
    if start_seed is not None:
        own_rng = np.random.default_rng([HIDDEN_STREAM, seed, start_seed])
        for key in sorted(cell.each_start):
            uniform[key] *= float(own_rng.uniform(*cell.each_start[key]))
    errors = {}
    for camera_id in sorted(cell.cameras):
        shift = rng.normal(0.0, cell.normal[f"{camera_id}_camera_m"], 3)
        turn = rng.normal(0.0, cell.normal[f"{camera_id}_camera_rad"], 3)
        errors[camera_id] = se3.small_motion(np.concatenate([turn, shift]))
    offset = rng.normal(0.0, cell.normal["joint_offset_rad"], len(ARM_JOINTS))
    deviations = None
    if cell.deviations:
        deviations = draw_deviations(
            cell.deviations | {key: own[key] for key in own if key in cell.deviations},
            seed,
            cameras=sorted(cell.cameras),
            objects={} if task is None else task.objects,
            start_seed=start_seed,
        )
        offset = offset + np.array(deviations.joint_zero_rad)
    return HiddenParameters(
        joint_offset_rad=offset, camera_errors=errors, deviations=deviations, **uniform
    )


def read_tables(path: Path) -> dict[str, Any]:
    """Parse a TOML file, with one clear sentence when it is broken."""
    try:
        return tomllib.loads(path.read_text())
    except (ValueError, OSError) as error:  # not TOML, not text, not readable
        raise UsageError(f"{path} cannot be read as TOML: {error}.") from error
