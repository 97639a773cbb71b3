"""What a rebuilt scene adds to a task: shapes of soft bodies, distances, calibrated physics.

Nothing here is needed: for what the scene does not have, and for lattices that cannot be trusted,
the task file stands in, and the place says so in a sentence. Distances that are there and cannot be
read are an error: somebody saw what stands in the way, and a yes without it would be no answer.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from jaxtyping import Float

from bridge.episode import provenance
from bridge.episode.run_folder import RunFolder
from bridge.task.task_file import ObjectModel, Task
from twin.replay.place.calibrated import Correction, correction_of
from twin.replay.place.scene import ReplayScene
from twin.scene.shape.lattice import Lattice
from twin.scene.shape.npz import UnreadableArraysError
from twin.scene.shape.static import StaticSdf
from twin.scene.store.calibration import read_calibration
from twin.scene.store.folder import read_record

TASK_SHAPE = "shape of the task file"
MOST_OFF = 0.25
"""A lattice of which an extent differs by more from the task's size is some other body."""
NO_DISTANCES = "the scene has no sdf.npz: only the table and the containers are in the way"


@dataclass(frozen=True, kw_only=True)
class Place:
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
    remarks: tuple[str, ...] = ()
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
        """Put objects into the place: where a replay happens.

        Args:
            task: Whose objects they are.
            urdf: The robot's description.
            Ts_base_object: Where the objects were localised; moved as the calibration says.
            reasons: Why others are not.
            covariances: How sure the poses are.
        """
        return ReplayScene(
            task=self.correction.task(task),
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


def read_place(run: RunFolder, task: Task) -> Place:
    """Read what the scene folder of a run knows about a task's objects.

    Raises:
        UnreadableSceneError: When ``scene.json`` cannot be understood.
        UnreadableCalibrationError: When ``calibration.json`` cannot be understood.
        UnreadableArraysError: When ``sdf.npz`` is there and cannot be read.
    """
    sources = dict.fromkeys(task.objects, TASK_SHAPE)
    calibration = read_calibration(run)
    place = Place(
        shape_sources=sources,
        calibration_id=None if calibration is None else calibration.calibration_id,
        correction=correction_of(calibration),
    )
    record = read_record(run)
    if record is None:
        return place
    lattices, remarks = {}, []
    for key in task.soft_objects:
        arrays, sources[key] = _lattice(run.scene_dir / "objects" / key, task.objects[key])
        if arrays is None:
            remarks.append(f"{key}: {sources[key]}")
        else:
            lattices[key] = arrays
    static = _static(run.scene_dir / "sdf.npz", place.correction)
    if static is None:
        remarks.append(NO_DISTANCES)
    return replace(
        place,
        scene_hash=str(record["scene_hash"]),
        static_sdf=static,
        lattices=lattices,
        remarks=tuple(remarks),
    )


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
    """The scene's lattice of one object, or None; and in a sentence where its shape comes from."""
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
        "springs": found.springs,
        "rest_lengths_m": found.rest_lengths_m,
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
