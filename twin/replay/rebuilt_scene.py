"""What a rebuilt scene adds to a task: shapes of soft bodies, distances, calibrated physics.

Nothing here is needed: for what the scene does not have, and for lattices that cannot be trusted,
the task file stands in, and ``notes`` say so. Distances that are there and cannot be read are an
error: somebody saw what stands in the way, and a yes without it would not be an answer.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from bridge.episode import provenance, streams
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.errors import BridgeError
from bridge.geometry import se3
from bridge.task.task_file import ObjectModel, Task
from twin.calibrate.physics.parameters import BIAS, MASS_SCALE, shifted
from twin.errors import TwinError
from twin.physics.config import PhysicsConfig
from twin.replay.config import RIGID_MASSES, PosteriorDraw, ReplayConfig
from twin.replay.scene import ReplayScene, StartState
from twin.scene.shape.from_training import with_heights
from twin.scene.shape.lattice import Lattice
from twin.scene.shape.static import StaticSdf
from twin.scene.store.calibration import Calibration, read_calibration
from twin.scene.store.folder import read_record
from twin.scene.store.npz import UnreadableArraysError


class UnreadablePosteriorError(TwinError):
    """The posterior of calibration.json is none; make it again: calibrate RUN --posterior."""


OTHER_TASKS = "the posterior has no trials of this task: its samples draw from the priors"
ALL_TASKS = (
    "the posterior was weighed by all tasks of its run together, by an older version; make it "
    "again: calibrate RUN --posterior"
)

INTERVAL_SIGMAS = 2 * 1.96
"""Width of a 95 % interval in standard deviations."""
PLANE = (0, 1, 5)
"""Rows of a pose's covariance that a bias is about: x, y and the turn about the vertical."""


@dataclass(frozen=True, kw_only=True)
class Correction:
    """What was identified of localised poses and of masses; as it stands, nothing."""

    bias: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """To be added to localised poses: x [m], y [m], turn about the object's own vertical [rad]."""
    bias_sigma: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """How sure that is, same units."""
    mass_scale: float = 1.0
    """Times the masses of rigid objects in the task file."""

    def poses(
        self, Ts_base_object: Mapping[str, Float[np.ndarray, "4 4"]]
    ) -> dict[str, Float[np.ndarray, "4 4"]]:
        """Localised poses as the robot would find them."""
        if not any(self.bias):
            return dict(Ts_base_object)
        shift = np.array(self.bias)
        return {name: shifted(T, shift) for name, T in Ts_base_object.items()}

    def as_seen(self, T_base_object: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
        """Where the cameras would have localised an object that is there for the robot."""
        return shifted(T_base_object, -np.array(self.bias)) if any(self.bias) else T_base_object

    def nodes_as_seen(
        self, nodes_m: Float[np.ndarray, "num_nodes 3"], T_base_object: Float[np.ndarray, "4 4"]
    ) -> Float[np.ndarray, "num_nodes 3"]:
        """The same for the nodes of a soft object: moved as its pose is.

        Args:
            nodes_m: Where they are for the robot, base frame.
            T_base_object: Pose of the object there; its bias is about this pose's vertical.
        """
        if not any(self.bias):
            return nodes_m
        T_seen_base = self.as_seen(T_base_object) @ se3.invert(T_base_object)
        return se3.apply(T_seen_base, nodes_m.astype(np.float64))

    def static(self, seen: StaticSdf) -> StaticSdf:
        """Distances to what stands still as the robot would find it.

        It is shifted and not turned: the turn is about each object's own vertical, and of what has
        no name nobody knows where that is.
        """
        x_m, y_m, _ = self.bias
        return seen.shifted(np.array([x_m, y_m, 0.0])) if x_m or y_m else seen

    def state(self, seen: StartState) -> StartState:
        """A localised state as the robot would find it."""
        return replace(seen, Ts_base_object=self.poses(seen.Ts_base_object))

    def covariances(
        self, known: Mapping[str, Float[np.ndarray, "6 6"]]
    ) -> dict[str, Float[np.ndarray, "6 6"]]:
        """What localisation leaves open, and what the calibration does."""
        extra = np.zeros(6)
        extra[list(PLANE)] = np.square(self.bias_sigma)
        return {name: covariance + np.diag(extra) for name, covariance in known.items()}

    def task(self, task: Task) -> Task:
        """The task with the masses that were found."""
        if self.mass_scale == 1.0:
            return task
        objects = {
            name: replace(model, mass_kg=model.mass_kg * self.mass_scale)
            if model.soft is None and not model.fixed
            else model
            for name, model in task.objects.items()
        }
        return replace(task, objects=objects)


def correction_of(calibration: Calibration | None) -> Correction:
    """What a calibration identified of poses and masses; without one nothing is moved."""
    if calibration is None:
        return Correction()
    biases = _part(calibration, "pose_bias")
    masses = _part(calibration, "masses")
    x, y, yaw = (biases.get(name, (0.0, 0.0, 0.0)) for name in BIAS)
    scale = masses.get(MASS_SCALE, (1.0, 1.0, 1.0))[0]
    return Correction(
        bias=(x[0], y[0], yaw[0]),
        bias_sigma=(_sigma(x), _sigma(y), _sigma(yaw)),
        mass_scale=scale if scale > 0 else 1.0,
    )


def calibrated(
    config: ReplayConfig, calibration: Calibration | None, task: Task | None
) -> ReplayConfig:
    """Use calibrated physics, but for the fields that the user set to something of their own.

    Samples then vary what was identified by as much as the calibration leaves open.

    Args:
        calibration: Of the run; None: there is none, and nothing changes.
        task: Its own draws of a posterior are taken; None: a recording without one takes none.
    """
    if calibration is None:
        return config
    wanted, nominal = config.physics, PhysicsConfig()
    known = physics_of(calibration.record)
    free = {
        name: type(getattr(nominal, name))(value)
        for name, value in known.items()
        if getattr(wanted, name) == getattr(nominal, name)
    }
    physics = replace(wanted, **free)
    taken = {name for name, value in known.items() if getattr(physics, name) == value}
    spreads = tuple(
        (name, spread)
        for name, spread in sorted(_identified(calibration.record, "sigma_log").items())
        if name in taken and spread >= 0
    )
    masses = _mass_spread(calibration)
    if masses is not None:
        spreads += ((RIGID_MASSES, masses),)
    draws = () if task is None else posterior_of(calibration, task)
    variation = replace(config.variation, calibrated=spreads, posterior=draws)
    return replace(config, physics=physics, variation=variation)


def posterior_of(calibration: Calibration, task: Task) -> tuple[PosteriorDraw, ...]:
    """The draws that a task's trials left some weight; empty where it has none of its own.

    Of a file that is older than draws of each task, those of all its tasks together.

    Raises:
        UnreadablePosteriorError: When one lacks a number.
    """
    draws = _posterior(calibration, task).get("draws", [])
    try:
        return tuple(PosteriorDraw.from_record(draw) for draw in draws)
    except (KeyError, TypeError, ValueError) as error:
        raise UnreadablePosteriorError(f"the posterior of calibration.json: {error!r}") from error


def _posterior(calibration: Calibration, task: Task) -> Mapping[str, Any]:
    found = _mapping(calibration.record, "posterior")
    return _mapping(_mapping(found, "tasks"), task.name) if "tasks" in found else found


def posterior_notes(calibration: Calibration | None, task: Task) -> tuple[str, ...]:
    """What has to be said where a posterior is not this task's own; nothing where it is."""
    found = {} if calibration is None else _mapping(calibration.record, "posterior")
    if not found or task.name in _mapping(found, "tasks"):
        return ()
    return (OTHER_TASKS if "tasks" in found else ALL_TASKS,)


def for_task(config: ReplayConfig, calibration: Calibration | None, task: Task) -> ReplayConfig:
    """Settings of a task's replays: calibrated, and pressing as hard as its gripper is set.

    A force that holds a wooden cube crushes a toy. What user or calibration said of it counts.

    Args:
        calibration: Of the run; None: there is none.
    """
    known = calibrated(config, calibration, task)
    if task.grip_force_N is None or known.physics.grip_force_N != PhysicsConfig().grip_force_N:
        return known
    return replace(known, physics=replace(known.physics, grip_force_N=task.grip_force_N))


def physics_of(calibration: Mapping[str, Any]) -> dict[str, float]:
    """Fields of ``PhysicsConfig`` that a calibration record says were identified."""
    known = {item.name for item in fields(PhysicsConfig)}
    found = _identified(calibration, "value")
    return {name: value for name, value in found.items() if name in known}


def _identified(record: Mapping[str, Any], key: str) -> dict[str, float]:
    """A number of each identified quantity, where it has one; a plain number is a value."""
    found = {}
    for name, item in _mapping(_mapping(record, "physics"), "identified").items():
        plain = item if key == "value" else None
        value = item.get(key) if isinstance(item, Mapping) else plain
        if isinstance(value, int | float) and np.isfinite(value):
            found[name] = float(value)
    return found


def _mass_spread(calibration: Calibration) -> float | None:
    found = _part(calibration, "masses").get(MASS_SCALE)
    if found is None or min(found) <= 0:
        return None
    return float(np.log(found[2] / found[1])) / INTERVAL_SIGMAS


def _sigma(found: tuple[float, float, float]) -> float:
    return max(0.0, found[2] - found[1]) / INTERVAL_SIGMAS


def _part(calibration: Calibration, name: str) -> dict[str, tuple[float, float, float]]:
    """Value, lower and upper end of what stands in a part of a calibration's physics."""
    found = {}
    for key, item in _mapping(_mapping(calibration.record, "physics"), name).items():
        if not isinstance(item, Mapping):
            continue
        given = (item.get("value"), item.get("low"), item.get("high"))
        numbers = [float(n) for n in given if isinstance(n, int | float) and np.isfinite(n)]
        if len(numbers) == len(given):
            value, low, high = numbers
            found[str(key)] = (value, low, high)
    return found


def _mapping(record: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    part = record.get(name)
    return part if isinstance(part, Mapping) else {}


TASK_SHAPE = "shape of the task file"
MOST_OFF = 0.25
"""A lattice of which an extent differs by more from the task's size is some other body."""
NO_DISTANCES = "the scene has no sdf.npz: only the table and the containers are in the way"


@dataclass(frozen=True, kw_only=True)
class RebuiltScene:
    """The rebuilt scene as far as replays use it."""

    scene_hash: str | None = None
    static_sdf: StaticSdf | None = None
    """Distances to what stands still, where the robot finds it; None: only the table and the
    containers are known."""
    lattices: Mapping[str, Mapping[str, np.ndarray]] = field(default_factory=dict)
    """Soft objects by the arrays of their ``soft.npz``, object frame."""
    shape_sources: Mapping[str, str] = field(default_factory=dict)
    """Per object: where its shape comes from."""
    calibration_id: str | None = None
    correction: Correction = field(default_factory=Correction)
    """What a calibration says of localised poses and of masses; ``static_sdf`` is moved already."""
    rim_heights_m: Mapping[str, float] = field(default_factory=dict)
    """Of containers as the scan shows them; published sizes stand in for others."""
    notes: tuple[str, ...] = ()
    """What the scene does not have, or has in a state in which it is not used."""

    def scene(
        self,
        task: Task,
        urdf: str,
        Ts_base_object: Mapping[str, Float[np.ndarray, "4 4"]],
        *,
        reasons: Mapping[str, str] | None = None,
        covariances: Mapping[str, Float[np.ndarray, "6 6"]] | None = None,
    ) -> ReplayScene:
        """Put objects into the scene: where a replay happens.

        Args:
            Ts_base_object: Where the objects were localised; moved as the calibration says.
            reasons: Why others are not.
        """
        return ReplayScene(
            task=with_heights(self.correction.task(task), self.rim_heights_m),
            urdf=urdf,
            Ts_base_object=self.correction.poses(Ts_base_object),
            reasons=reasons or {},
            covariances=self.correction.covariances(covariances or {}),
            scene_hash=self.scene_hash,
            calibration_id=self.calibration_id,
            static_sdf=self.static_sdf,
            lattices=self.lattices,
            shape_sources=self.shape_sources,
        )


def read_rebuilt_scene(run: RunFolder, task: Task) -> RebuiltScene:
    """Read what the scene folder of a run knows about a task's objects.

    Args:
        run: Whose scene folder is read; without ``scene.json`` only the calibration is.

    Raises:
        UnreadableSceneError: When ``scene.json`` cannot be understood.
        UnreadableCalibrationError: When ``calibration.json`` cannot be understood.
        UnreadableArraysError: When ``sdf.npz`` is there and cannot be read.
    """
    sources = dict.fromkeys(task.objects, TASK_SHAPE)
    calibration = read_calibration(run)
    rebuilt = RebuiltScene(
        shape_sources=sources,
        calibration_id=None if calibration is None else calibration.calibration_id,
        correction=correction_of(calibration),
        notes=posterior_notes(calibration, task),
    )
    record = read_record(run)
    if record is None:
        return rebuilt
    lattices, notes = {}, list(rebuilt.notes)
    for key in task.soft_objects:
        arrays, sources[key] = _lattice(run.scene_dir / "objects" / key, task.objects[key])
        if arrays is None:
            notes.append(f"{key}: {sources[key]}")
        else:
            lattices[key] = arrays
    static = _static(run.scene_dir / "sdf.npz", rebuilt.correction)
    if static is None:
        notes.append(NO_DISTANCES)
    return replace(
        rebuilt,
        scene_hash=str(record["scene_hash"]),
        static_sdf=static,
        lattices=lattices,
        rim_heights_m={
            key: float(height_m)
            for key, height_m in _mapping(_mapping(record, "sdf"), "rim_height_m").items()
            if key in task.objects
        },
        notes=tuple(notes),
    )


def scene_of_other_robot(run: RunFolder, robot: str) -> str:
    """Say which other robot recorded the scene of a run; empty: none that is known.

    A scene stands where the robot that recorded it was calibrated.

    Args:
        run: Its ``scene.json`` names the episodes that the scene was made of.
    """
    sources: list[dict[str, Any]] = (read_record(run) or {}).get("sources") or []
    names = {str(source.get("id", "")) for source in sources}
    for path in run.episodes() if names else ():
        if path.stem not in names:
            continue
        try:
            other = _robot_of_recording(path)
        except BridgeError:
            continue
        if other != robot:
            return f"the scene in {run.scene_dir} was recorded with robot {other} ({path.stem})"
    return ""


@lru_cache(maxsize=64)
def _robot_of_recording(path: Path) -> str:
    """Name of the robot of a finished episode, which does not change; asked for each plan."""
    return streams.recorded_robot(Episode.open(path)).name


def shape_hashes(run: RunFolder) -> dict[str, str]:
    """SHA-256 of the scene's files that a replay reads, by their names in the scene folder."""
    folder = run.scene_dir
    paths = [folder / "sdf.npz", *sorted(folder.glob("objects/*/soft.npz"))]
    return {
        path.relative_to(folder).as_posix(): provenance.hash_file(path)
        for path in paths
        if path.is_file()
    }


def _lattice(folder: Path, model: ObjectModel) -> tuple[Mapping[str, np.ndarray] | None, str]:
    """The scene's lattice of one object, or None; and where its shape comes from, in words."""
    path = folder / "soft.npz"
    if not path.is_file():
        return None, f"{TASK_SHAPE} (the scene has no lattice of it)"
    if not _watertight(folder / "object.json"):
        return None, f"{TASK_SHAPE} (the scene's mesh of it is not watertight)"
    try:
        found = _load_lattice(path, path.stat().st_mtime_ns)
    except UnreadableArraysError as error:
        return None, f"{TASK_SHAPE} ({error})"
    off = float(np.max(np.abs(np.ptp(found.nodes_m, axis=0) / np.array(model.size_m) - 1.0)))
    if off > MOST_OFF:
        return None, f"{TASK_SHAPE} (an extent of the scene's lattice is {off:.0%} off)"
    arrays = {
        "nodes_m": found.nodes_m,
        "tets": found.tets,
        "mass_fraction": found.mass_fraction,
        "spacing_m": np.array(found.spacing_m),
    }
    return arrays, f"lattice of the scene ({len(found.nodes_m)} nodes)"


@lru_cache(maxsize=16)
def _load_lattice(path: Path, mtime_ns: int) -> Lattice:
    return Lattice.load(path)


def _watertight(path: Path) -> bool:
    try:
        about = json.loads(path.read_text())
    except (OSError, ValueError):
        return False
    geometry = about.get("geometry") if isinstance(about, dict) else None
    return isinstance(geometry, dict) and geometry.get("watertight") is True


def _static(path: Path, correction: Correction) -> StaticSdf | None:
    return _load_static(path, path.stat().st_mtime_ns, correction) if path.is_file() else None


@lru_cache(maxsize=2)
def _load_static(path: Path, mtime_ns: int, correction: Correction) -> StaticSdf:
    """One and the same grid each time: what is derived from it is remembered by its identity."""
    return correction.static(StaticSdf.load(path))
