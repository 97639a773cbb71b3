"""What a rebuilt scene adds to a task: shapes of soft bodies, distances, calibrated physics.

Nothing here is needed: for what the scene does not have, and for lattices that cannot be trusted,
the task file stands in, and ``notes`` say so. Distances that are there and cannot be read are an
error: somebody saw what stands in the way, and a yes without it would not be an answer.
"""

import json
from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from bridge.episode import provenance, streams
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.errors import BridgeError
from bridge.task.task_file import ObjectModel, Task
from twin.errors import TwinError
from twin.npz import UnreadableArraysError
from twin.physics.config import PhysicsConfig
from twin.replay.config import PosteriorDraw, ReplayConfig
from twin.replay.scene import ReplayScene
from twin.scene.shape.carve import ShapeError
from twin.scene.shape.from_training import with_heights
from twin.scene.shape.lattice import lattice
from twin.scene.shape.sdf import SdfGrid
from twin.scene.shape.static import StaticSdf
from twin.scene.store.calibration import Calibration, read_calibration
from twin.scene.store.folder import read_record
from twin.scene.store.library import NOT_SCANNED, SDF, Library


class UnreadablePosteriorError(TwinError):
    """The posterior of calibration.json is none; make it again: calibrate RUN --posterior."""


MASSES = "masses"
"""The part of calibration.json that says what objects weighed in the hand."""
OTHER_TASKS = "the posterior has no trials of this task: its samples draw from the priors"


def calibrated(
    config: ReplayConfig, calibration: Calibration | None, task: Task | None
) -> ReplayConfig:
    """Use calibrated physics, but for the fields that the user set to something of their own.

    Samples then vary what was identified as far as it is open; a posterior's draws are the task's.
    """
    if calibration is None:
        return config
    wanted, nominal = config.physics, PhysicsConfig()
    found, sigmas = (_identified(calibration.record, key) for key in ("value", "sigma_log"))
    rubs = {} if task is None else learned(calibration, task, "friction")
    moves = [] if task is None else [item for item in task.objects.values() if not item.fixed]
    for pair, spread in rubs.values() if len(moves) == 1 else ():  # a world has one friction
        found["surface_friction"] = pair / wanted.object_friction
        sigmas["surface_friction"] = spread
    known = {k: v for k, v in found.items() if k in vars(nominal)}
    free = {
        name: type(getattr(nominal, name))(value)
        for name, value in known.items()
        if getattr(wanted, name) == getattr(nominal, name)
    }
    physics = replace(wanted, **free)
    taken = {name for name, value in known.items() if getattr(physics, name) == value}
    spreads = [(name, x) for name, x in sorted(sigmas.items()) if name in taken and x >= 0]
    variation = replace(config.variation, calibrated=tuple(spreads))
    if task is not None:
        masses = tuple((key, spread) for key, (_, spread) in learned(calibration, task).items())
        variation = replace(variation, masses=masses, posterior=posterior_of(calibration, task))
    return replace(config, physics=physics, variation=variation)


def posterior_of(calibration: Calibration, task: Task) -> tuple[PosteriorDraw, ...]:
    """The draws that a task's trials left some weight; empty where it has none of its own."""
    tasks = _mapping(_mapping(calibration.record, "posterior"), "tasks")
    draws = _mapping(tasks, task.name).get("draws", [])
    try:
        return msgspec.convert(draws, tuple[PosteriorDraw, ...])
    except msgspec.ValidationError as error:
        raise UnreadablePosteriorError(f"the posterior of calibration.json: {error}") from error


def learned(
    calibration: Calibration | None, task: Task, number: str = "mass"
) -> dict[str, tuple[float, float]]:
    """Masses [kg] or frictions of a task's objects, and the spread of each logarithm."""
    record = {} if calibration is None else calibration.record
    items = _mapping(_mapping(_mapping(record, MASSES), "tasks"), task.name)
    found = {name: x if number == "mass" else _mapping(x, number) for name, x in items.items()}
    return {
        name: (item["value"], item["sigma_log"])
        for name, item in found.items()
        if name in task.objects and "value" in item and not item["why"]
    }


def for_task(config: ReplayConfig, calibration: Calibration | None, task: Task) -> ReplayConfig:
    """Settings of a task's replays: calibrated, and pressing as hard as its gripper is set.

    A force that holds a wooden cube crushes a toy. What user or calibration said of it counts.
    """
    known = calibrated(config, calibration, task)
    if task.grip_force_N is None or known.physics.grip_force_N != PhysicsConfig().grip_force_N:
        return known
    return replace(known, physics=replace(known.physics, grip_force_N=task.grip_force_N))


def _identified(record: Mapping[str, Any], key: str) -> dict[str, float]:
    """A number of each identified quantity, where it has one."""
    found = {}
    for name, item in _mapping(_mapping(record, "physics"), "identified").items():
        value = item.get(key) if isinstance(item, Mapping) else None
        if isinstance(value, int | float) and np.isfinite(value):
            found[name] = float(value)
    return found


def _mapping(record: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    part = record.get(name)
    return part if isinstance(part, Mapping) else {}


TASK_SHAPE = "shape of the task file"
MOST_OFF = 0.25
"""A lattice of which an extent differs by more from the task's size is some other body."""
NO_DISTANCES = "the scene has no sdf.npz: only the table and the containers are in the way"


def read_rebuilt_scene(run: RunFolder, task: Task) -> ReplayScene:
    """Read what a run knows of a task's objects; without ``scene.json`` its calibration only.

    Objects weigh what they weighed in the hand, and containers are as high as the scan shows them;
    the task file stands in for others. Robot and poses are left to whoever knows them.
    """
    calibration, record = read_calibration(run), read_record(run)
    drawn = {} if calibration is None else _mapping(calibration.record, "posterior")
    notes = [OTHER_TASKS] if drawn and task.name not in _mapping(drawn, "tasks") else []
    weighed = {
        key: replace(task.objects[key], mass_kg=mass)
        for key, (mass, _) in learned(calibration, task).items()
    }
    task = replace(task, objects={**task.objects, **weighed})
    calibration_id = None if calibration is None else calibration.calibration_id
    if record is None:
        return ReplayScene(task=task, calibration_id=calibration_id, notes=tuple(notes))
    lattices, library = {}, Library.of(run, record)
    for key in task.soft_objects:
        found = _lattice(library.place(key), task.objects[key])
        if isinstance(found, str):
            notes.append(f"{key}: {found}")
        else:
            lattices[key] = found
    path = run.scene_dir / SDF
    static = _load_static(path, path.stat().st_mtime_ns) if path.is_file() else None
    notes += [] if static else [NO_DISTANCES]
    heights = _mapping(_mapping(record, "sdf"), "rim_height_m")
    return ReplayScene(
        task=with_heights(task, {key: float(height_m) for key, height_m in heights.items()}),
        calibration_id=calibration_id,
        scene_hash=str(record["scene_hash"]),
        static_sdf=static,
        lattices=lattices,
        notes=tuple(notes),
    )


def scene_of_other_robot(run: RunFolder, robot: str) -> str:
    """Say which other robot recorded the scene of a run; empty: none that is known.

    A scene stands where the robot that recorded it was calibrated.
    """
    sources: list[dict[str, Any]] = (read_record(run) or {}).get("sources") or []
    names = {str(source.get("id", "")) for source in sources}
    for path in (each for each in run.episodes() if each.stem in names):
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
    paths = [folder / SDF, *sorted(folder.glob(f"objects/*/{SDF}"))]
    return {
        path.relative_to(folder).as_posix(): provenance.hash_file(path)
        for path in paths
        if path.is_file()
    }


def _lattice(folder: Path | None, model: ObjectModel) -> Mapping[str, np.ndarray] | str:
    """The scene's lattice of one object; or why the task file's shape stands in, in words."""
    if folder is None:
        return f"{TASK_SHAPE} ({NOT_SCANNED})"
    path = folder / SDF
    if not path.is_file():
        return f"{TASK_SHAPE} (the scene has no shape of it)"
    if not _watertight(folder / "object.json"):
        return f"{TASK_SHAPE} (the scene's mesh of it is not watertight)"
    try:
        found = _load_lattice(path, path.stat().st_mtime_ns)
    except (UnreadableArraysError, ShapeError) as error:
        return f"{TASK_SHAPE} ({error})"
    off = float(np.max(np.abs(np.ptp(found["nodes_m"], axis=0) / np.array(model.size_m) - 1.0)))
    if off > MOST_OFF:
        return f"{TASK_SHAPE} (an extent of the scene's lattice is {off:.0%} off)"
    return found


@lru_cache(maxsize=16)
def _load_lattice(path: Path, mtime_ns: int) -> Mapping[str, np.ndarray]:
    return lattice(SdfGrid.load(path))


def _watertight(path: Path) -> bool:
    try:
        about = json.loads(path.read_text())
    except (OSError, ValueError):
        return False
    geometry = about.get("geometry") if isinstance(about, dict) else None
    return isinstance(geometry, dict) and geometry.get("watertight") is True


@lru_cache(maxsize=2)
def _load_static(path: Path, mtime_ns: int) -> StaticSdf:
    """One and the same grid each time: what is derived from it is remembered by its identity."""
    return StaticSdf.load(path)
