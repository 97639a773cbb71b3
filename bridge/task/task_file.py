"""A task as data: objects, stages, start distribution and success predicate."""

import hashlib
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from jaxtyping import Float

from bridge.data_files import dataset_file
from bridge.errors import InvalidRecordError, UsageError
from bridge.geometry import se3
from bridge.task.check import TaskFileError, task_problems

DESTINATIONS = {
    "inside": "container",
    "on": "support",
    "beside": "reference",
    "between": "first",
}
"""Predicates that say where an object belongs, and which of their keys names what is there."""
BASKET = "basket"
SCANNED = "scanned"
MAX_BYTES = 64 * 1024
"""Of a task file; one travels in every episode."""


@dataclass(frozen=True, kw_only=True)
class SoftMaterial:
    """What a soft object is made of; nominal values."""

    young_pa: float
    """Young's modulus of the whole body [Pa]."""
    poisson: float
    """Poisson's ratio, 0 to below 0.5."""
    damping_s: float
    """Rayleigh damping: the stiffness times this resists the speed of deformation [s]."""
    cell_m: float
    """Edge of the cells its inside is divided into [m]."""


@dataclass(frozen=True, kw_only=True)
class ObjectModel:
    """Shape and nominal properties of one object."""

    id: str
    shape: str
    """box, mesh, scanned (origin at the centre), open_box, mesh "basket" (origin under the floor).
    Of a scanned object only size and colour are known; its shape comes from a scan."""
    size_m: tuple[float, float, float]
    """Outer extents; of a scanned object roughly."""
    color_srgb: tuple[int, int, int]
    wall_m: float = 0.0
    mass_kg: float = 0.1
    fixed: bool = False
    symmetry: str = "none"
    mesh: str | None = None
    """Which mesh of ``bridge.task.meshes`` it is; None for boxes."""
    soft: SoftMaterial | None = None
    """None: rigid."""
    grasp_m: tuple[float, float, float] = (0.0, 0.0, 0.004)
    """Where a gripper takes it, in the object frame, closing along its y axis."""

    @property
    def inner_m(self) -> tuple[float, float, float]:
        """Extents of the cavity of an open box or a basket."""
        x, y, z = self.size_m
        return x - 2 * self.wall_m, y - 2 * self.wall_m, z - self.wall_m

    @property
    def origin_at_centre(self) -> bool:
        """Whether the origin is the middle of the outer extents; else it is under the floor."""
        return self.shape in ("box", SCANNED) or (self.shape == "mesh" and self.mesh != BASKET)

    @property
    def rest_height_m(self) -> float:
        """Height of the origin above what the object stands on [m]."""
        return self.size_m[2] / 2 if self.origin_at_centre else 0.0

    @property
    def grasp_turn_rad(self) -> float:
        """Turn about the vertical after which a gripper can take it in the same way."""
        return np.pi / 2 if self.symmetry == "cube" else np.pi

    def panels(self) -> list[tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]]:
        """Solid boxes the object is made of: (centre, extents) in the object frame [m].

        A mesh is stood in for: a toy by the box around it, a basket by floor and straight walls.
        So is a scanned object: by the box around it.
        """
        size = np.array(self.size_m)
        if self.origin_at_centre:
            return [(np.zeros(3), size)]
        x, y, z = size
        wall = self.wall_m
        height, middle = z - wall, (z + wall) / 2  # walls stand on the floor
        along_x, along_y = np.array([x - 2 * wall, wall, height]), np.array([wall, y, height])
        return [
            (np.array([0, 0, wall / 2]), np.array([x, y, wall])),
            *((np.array([s * (x - wall) / 2, 0, middle]), along_y) for s in (1, -1)),
            *((np.array([0, s * (y - wall) / 2, middle]), along_x) for s in (1, -1)),
        ]


@dataclass(frozen=True, kw_only=True)
class StartRange:
    """Uniform ranges an object's start pose is drawn from."""

    x_m: tuple[float, float]
    y_m: tuple[float, float]
    yaw_rad: tuple[float, float]


@dataclass(frozen=True, kw_only=True)
class Task:
    """One task file."""

    name: str
    instruction: str
    objects: dict[str, ObjectModel]
    manipulated: tuple[str, ...]
    containers: tuple[str, ...] = ()
    start: dict[str, StartRange]
    stages: tuple[dict[str, Any], ...]
    success: tuple[dict[str, Any], ...]
    cell: str = "standin"
    derived: Mapping[str, Any] | None = None
    """Who made the file of which tasks' objects, by which version of its rules; None: a person."""
    grip_force_N: float | None = None
    """How hard each finger presses, as the gripper is set for this task; None: not known."""

    def draw_start(self, rng: np.random.Generator) -> dict[str, Float[np.ndarray, "4 4"]]:
        """Draw ``T_base_object`` for every object, resting on the table top z = 0."""
        poses = {}
        for object_id, limits in self.start.items():
            yaw = rng.uniform(*limits.yaw_rad)
            height = self.objects[object_id].rest_height_m
            p = np.array([rng.uniform(*limits.x_m), rng.uniform(*limits.y_m), height])
            q = np.array([np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)])
            poses[object_id] = se3.transform_from(q, p)
        return poses

    def goal_of(self, object_id: str) -> tuple[str, str] | None:
        """Where an object belongs: in which relation to which other; None: nowhere said.

        The first success predicate that says so counts: ``inside`` a container, ``on`` a support
        (an object or the table), ``beside`` or ``between`` others; ``outside`` only where none of
        those is asked for.
        """
        named = [spec for spec in self.success if spec.get("object") == object_id]
        for kinds in (DESTINATIONS, {"outside": "container"}):
            for spec in named:
                if spec["kind"] in kinds:
                    return spec["kind"], spec[kinds[spec["kind"]]]
        return None

    def mark_of(self, object_id: str) -> tuple[float, float] | None:
        """Where an object is to be pushed on the table, seen from above [m]; None: nowhere said.

        The first success predicate ``moved`` with a target counts.
        """
        for spec in self.success:
            if spec.get("object") == object_id and "target_m" in spec:
                x, y, *_ = spec["target_m"]
                return float(x), float(y)
        return None

    @property
    def soft_objects(self) -> tuple[str, ...]:
        """Objects that deform."""
        return tuple(key for key, model in self.objects.items() if model.soft is not None)


@dataclass(frozen=True)
class TaskFile:
    """The text of a task file, and where it was found."""

    data: bytes
    origin: str
    """A path, or which attachment of which episode."""

    @staticmethod
    def read(path: Path) -> "TaskFile":
        """Read a file."""
        try:
            with path.open("rb") as stream:
                return TaskFile(stream.read(MAX_BYTES + 1), str(path))
        except OSError as error:
            raise UsageError(f"{path} cannot be read: {error.strerror}.") from error

    @property
    def sha256(self) -> str:
        """Of the text as it is: comments count."""
        return hashlib.sha256(self.data).hexdigest()

    def task(self) -> Task:
        """Parse and check the file; each text once."""
        found = _parsed(self.data)
        if isinstance(found, Task):
            return found
        raise TaskFileError(origin=self.origin, problems=found)


def load_task(name: str) -> Task:
    """Load ``datasets/tasks/<name>.toml`` or a TOML file by path."""
    return TaskFile.read(dataset_file("tasks", name)).task()


@lru_cache(maxsize=64)
def _parsed(data: bytes) -> Task | tuple[str, ...]:
    """Return the task of a file, or what is wrong with it: every replay job asks for its task."""
    if len(data) > MAX_BYTES:
        return (f"longer than {MAX_BYTES // 1024} KiB",)
    try:
        table = tomllib.loads(data.decode())
    except (ValueError, RecursionError) as error:  # not TOML, not text
        return (f"cannot be read as TOML: {error}",)
    try:
        problems = tuple(task_problems(table))
    except (RecursionError, InvalidRecordError):
        return ("nested too deeply",)
    if problems:
        return problems
    objects = {key: {"id": key, **_sized(about)} for key, about in table["objects"].items()}
    return msgspec.convert({**table, "objects": objects}, Task)


def _sized(about: dict[str, Any]) -> dict[str, Any]:
    """Add the outer extents of what is given by its cavity; no other shape has walls."""
    if about["shape"] != "open_box" and about.get("mesh") != BASKET:
        return {**about, "wall_m": 0.0}
    (x, y, z), wall = about["inner_m"], float(about["wall_m"])
    return {**about, "size_m": (x + 2 * wall, y + 2 * wall, z + wall)}
