"""The geometry files of one object: mesh, distances, collision parts, lattice, and their record.

The mass is a prior by name and volume. Volumes come from the outside: a hollow toy counts as if it
were filled, so densities are "what it weighs over what it displaces". Calibration replaces the
prior when the log allows.
"""

import re
import shutil
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from bridge.whole_file import write_whole
from twin.scene.shape.carve import ShapeError
from twin.scene.shape.collision import CollisionParts, collision_parts
from twin.scene.shape.lattice import lattice
from twin.scene.shape.mesh import mesh_ply
from twin.scene.shape.reconstruct import ObjectShape


@dataclass(frozen=True, kw_only=True)
class MassPrior:
    """A guess with its range, and where it comes from."""

    mass_kg: float
    low_kg: float
    high_kg: float
    density_kg_m3: float
    material: str
    source: str


@dataclass(frozen=True, kw_only=True)
class _Material:
    name: str
    words: tuple[str, ...]
    density_kg_m3: tuple[float, float, float]
    """Low, likely, high."""
    source: str


_DESIGN = "design page on perception, section 3: foam 0.05, plush 0.15, plastic 0.5-1.0 g/cm3"
_MATERIALS = (
    _Material(
        name="foam",
        words=("foam", "sponge"),
        density_kg_m3=(20.0, 50.0, 100.0),
        source=_DESIGN,
    ),
    _Material(
        name="plush",
        words=("plush", "sloth", "teddy", "bear", "bunny", "doll", "stuffed", "cushion"),
        density_kg_m3=(80.0, 150.0, 250.0),
        source=_DESIGN,
    ),
    _Material(
        name="hollow soft plastic",
        words=("duck", "ball"),
        density_kg_m3=(80.0, 200.0, 450.0),
        source="assumed: a hollow bath toy, between plush and solid plastic; not measured",
    ),
    _Material(
        name="plastic",
        words=("plastic", "box", "bin", "tray", "basket", "container", "bowl", "cup", "cube"),
        density_kg_m3=(500.0, 750.0, 1000.0),
        source=_DESIGN,
    ),
)
_UNKNOWN = _Material(
    name="unknown",
    words=(),
    density_kg_m3=(50.0, 500.0, 2000.0),
    source="no word of the label names a material: anything from foam to stone",
)


def mass_prior(label: str, volume_m3: float) -> MassPrior:
    """Mass of a thing from the words of its label and its volume.

    Args:
        label: A name or a few words; ``duck_3`` and ``red cube`` are understood.
        volume_m3: Volume of its closed shape.

    Raises:
        ShapeError: When the volume is not a positive number.
    """
    if not 0 < volume_m3 < float("inf"):
        message = f"{label!r} has a volume of {volume_m3:g} m3, so nothing is known of its mass."
        raise ShapeError(message)
    words = {re.sub(r"s$", "", word) for word in re.split(r"[^a-z]+", label.lower())}
    material = next((m for m in _MATERIALS if words & set(m.words)), _UNKNOWN)
    low, likely, high = material.density_kg_m3
    return MassPrior(
        mass_kg=likely * volume_m3,
        low_kg=low * volume_m3,
        high_kg=high * volume_m3,
        density_kg_m3=likely,
        material=material.name,
        source=material.source,
    )


MESH, SDF, SOFT, COLLISION = "mesh.ply", "sdf.npz", "soft.npz", "collision"
TASK_SHAPE = "task file"
"""Source of a shape that no view gave."""


def remove_shape(folder: Path) -> None:
    """Remove what an earlier reconstruction left in an object's folder."""
    for name in (MESH, SDF, SOFT):
        (folder / name).unlink(missing_ok=True)
    if (folder / COLLISION).is_dir():
        shutil.rmtree(folder / COLLISION)


def write_shape(
    folder: Path, shape: ObjectShape, label: str, *, soft: bool
) -> tuple[list[str], dict[str, Any]]:
    """Write the geometry of one object, in the frame of its mesh.

    Args:
        folder: The object's folder, which exists.
        shape: From ``reconstruct``.
        label: What the object is called; decides the mass prior.
        soft: Whether it gets a lattice.

    Returns:
        Names of the files, and what ``object.json`` says of them.
    """
    write_whole(folder / MESH, mesh_ply(shape.vertices_m, shape.faces))
    shape.sdf.save(folder / SDF)
    parts = collision_parts(shape)
    names = [MESH, SDF, *_write_parts(folder, parts)]
    about = describe_shape(shape) | {
        "collision": {
            "num_parts": len(parts.parts),
            "hull_ratio": round(parts.hull_ratio, 4),
            "volume_ratio": round(parts.volume_ratio, 4),
            "cavity_blocked": parts.cavity_blocked,
        },
        "mass_prior": asdict(mass_prior(label, shape.volume_m3)),
    }
    if soft:
        try:
            inside = lattice(shape)
        except ShapeError as error:
            about["lattice"] = {"remark": str(error)}
        else:
            inside.save(folder / SOFT)
            names.append(SOFT)
            about["lattice"] = {
                "num_nodes": len(inside.nodes_m),
                "num_springs": len(inside.springs),
                "num_tets": len(inside.tets),
                "spacing_m": inside.spacing_m,
            }
    return names, about


def _write_parts(folder: Path, parts: CollisionParts) -> list[str]:
    (folder / COLLISION).mkdir(exist_ok=True)
    names = [f"{COLLISION}/{index:02d}.ply" for index in range(len(parts.parts))]
    for name, part in zip(names, parts.parts, strict=True):
        write_whole(folder / name, mesh_ply(part.vertices_m, part.faces))
    return names


def describe_shape(shape: ObjectShape) -> dict[str, Any]:
    """Return the numbers of a shape as ``object.json`` holds them."""
    cavity = shape.cavity
    return {
        "watertight": shape.is_watertight,
        "volume_m3": shape.volume_m3,
        "completed_fraction": round(shape.completed_fraction, 4),
        "completed": "share of the surface no view saw; closed by the plane it stands on, or solid",
        "unseen_top_m2": shape.unseen_top_m2,
        "cavity": None
        if cavity is None
        else {"volume_m3": cavity.volume_m3, "depth_m": cavity.depth_m},
        "voxel_m": shape.sdf.voxel_m,
        "truncation_m": shape.truncation_m,
        "num_views": shape.num_views,
        "view_shift_m": shape.view_shift_m,
    }
