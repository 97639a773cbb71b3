"""Semantics in the scene folder: ``semantics.npz`` beside the splats, a summary in the record."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, UInt8, UInt16

from bridge.episode import provenance
from bridge.errors import InvalidRecordError, PathNotFoundError
from bridge.geometry import se3
from twin.errors import UnreadableFileError
from twin.naming.things import Instance, SemanticScene, SemanticsError
from twin.npz import UnreadableArraysError, read_npz, write_npz

SEMANTICS_FILE = "semantics.npz"
VECTORS_FILE = "features.npz"
FORMAT_VERSION = 1
MAX_BYTES = 8 << 30
"""Unpacked; a file that claims more is refused."""
BACKGROUND_KEY = "background"


class UnreadableSemanticsError(UnreadableFileError, SemanticsError):
    """``semantics.npz`` is damaged, or was made for another scene."""


def write_semantics(folder: Path, scene: SemanticScene, rows: Mapping[str, int]) -> dict[str, Any]:
    """Write labels and parts of a scene; return what ``scene.json`` says about it.

    Args:
        rows: How many Gaussians each of them has, in that order: ``background``, object ids.
    """
    if sum(rows.values()) != len(scene.labels):
        message = f"{len(scene.labels)} labels for files with {dict(rows)} Gaussians."
        raise SemanticsError(message)
    about = [about_item(item) | {"object": _object_of(item, rows)} for item in scene.instances]
    known = {"source": scene.source, "remark": scene.remark, "instances": about}
    table = {"version": FORMAT_VERSION, "rows": dict(rows)} | known
    path, coded = folder / SEMANTICS_FILE, np.frombuffer(json.dumps(table).encode(), dtype=np.uint8)
    write_npz(path, {"labels": scene.labels, "parts": _part_codes(scene), "about": coded})
    return {"file": SEMANTICS_FILE, "sha256": provenance.hash_file(path)} | known


def _part_codes(scene: SemanticScene) -> UInt8[np.ndarray, " num_splats"]:
    """Index of each Gaussian's part in its instance's list of parts, from 1; 0 is none."""
    codes = np.zeros(len(scene.labels), dtype=np.uint8)
    for item in scene.instances:
        for number, mask in enumerate(item.parts.values(), start=1):
            codes[mask] = number
    return codes


def about_item(item: Instance) -> dict[str, Any]:
    """What is told and stored about one thing."""
    return {
        "id": item.id,
        "label": item.label,
        "name": item.name,
        "num_splats": int(item.mask.sum()),
        "score": round(item.score, 4),
        "source": item.source,
        "color_srgb": list(item.color_srgb),
        "T_base_instance": se3.pose_record(item.T_base_instance),
        "size_m": list(item.size_m),
        "parts": list(item.parts),
    }


def _object_of(item: Instance, rows: Mapping[str, int]) -> str | None:
    """The object most of an instance's Gaussians belong to; None for the background."""
    parts = np.split(item.mask, np.cumsum(list(rows.values()))[:-1])
    most = list(rows)[int(np.argmax([part.sum() for part in parts]))]
    return None if most == BACKGROUND_KEY else most


def read_semantics(folder: Path, rows: Mapping[str, int]) -> SemanticScene:
    """Read what ``write_semantics`` wrote, for files with these numbers of Gaussians.

    Args:
        rows: How many Gaussians each file has, in the order of the labels: ``background``, object
            ids.
    """
    path = folder / SEMANTICS_FILE
    if not path.is_file():
        raise PathNotFoundError(
            path=path, what="semantics", hint="Make them: robot-gst rebuild RUN."
        )
    try:
        arrays = read_npz(path, ("labels", "parts", "about"), MAX_BYTES)
        table = json.loads(arrays["about"].astype(np.uint8).tobytes())
        if table["version"] != FORMAT_VERSION:
            message = f"format version {table['version']}, this program knows {FORMAT_VERSION}"
            raise ValueError(message)
        if table["rows"] != dict(rows):
            message = f"made for files with {table['rows']} Gaussians, there are {dict(rows)}"
            raise ValueError(message)
        for name, kind in (("labels", np.uint16), ("parts", np.uint8)):
            if arrays[name].dtype != kind or arrays[name].shape != (sum(rows.values()),):
                message = f"{name} of type {arrays[name].dtype} and shape {arrays[name].shape}"
                raise ValueError(message)
        labels, codes = arrays["labels"], arrays["parts"]
        instances = tuple(_instance(item, labels, codes) for item in table["instances"])
    except UnreadableArraysError as error:
        raise UnreadableSemanticsError(path=path, found=f"unreadable ({error.found})") from error
    except (ValueError, KeyError, TypeError, InvalidRecordError) as error:
        raise UnreadableSemanticsError(path=path, found=f"unreadable ({error})") from error
    return SemanticScene(
        instances=instances,
        labels=labels,
        source=str(table["source"]),
        remark=str(table["remark"]),
    )


def _instance(
    about: Mapping[str, Any],
    labels: UInt16[np.ndarray, " num_splats"],
    codes: UInt8[np.ndarray, " num_splats"],
) -> Instance:
    number = int(about["id"])
    mask = labels == number
    red, green, blue = (int(channel) for channel in about["color_srgb"])
    long, short, height = (float(extent) for extent in about["size_m"])
    return Instance(
        id=number,
        label=str(about["label"]),
        mask=mask,
        score=float(about["score"]),
        source=str(about["source"]),
        color_srgb=(red, green, blue),
        T_base_instance=se3.pose_from_record(about["T_base_instance"]),
        size_m=(long, short, height),
        parts={
            str(name): mask & (codes == code) for code, name in enumerate(about["parts"], start=1)
        },
    )


def write_vectors(
    folder: Path,
    scene: SemanticScene,
    vectors: Float32[np.ndarray, "num_instances num_channels"],
    source: str,
) -> dict[str, Any]:
    """Write a vector for each instance, in the space of a model's words; what to record of it.

    Args:
        source: The model, and the beginning of its weights' SHA-256.
    """
    arrays = {
        "instance_ids": np.array([item.id for item in scene.instances], dtype=np.int32),
        "instance_embeddings": vectors,
        "source": np.frombuffer(source.encode(), dtype=np.uint8),
    }
    write_npz(folder / VECTORS_FILE, arrays)
    return {"file": VECTORS_FILE, "source": source, "num_channels": vectors.shape[1]}


def read_vectors(
    folder: Path, scene: SemanticScene
) -> tuple[Float32[np.ndarray, "num_instances num_channels"], str] | None:
    """What ``write_vectors`` wrote, in the order of the instances; None where there are none."""
    path = folder / VECTORS_FILE
    if not path.is_file():
        return None
    try:
        names = ("instance_ids", "instance_embeddings", "source")
        arrays = read_npz(path, names, MAX_BYTES)
    except UnreadableArraysError as error:
        raise UnreadableSemanticsError(path=path, found=f"unreadable ({error.found})") from error
    ids, vectors = arrays["instance_ids"].tolist(), arrays["instance_embeddings"]
    of_scene = ids == [item.id for item in scene.instances]
    if not of_scene or vectors.ndim != 2 or len(vectors) != len(ids):
        raise UnreadableSemanticsError(path=path, found="made for another scene")
    return vectors.astype(np.float32), arrays["source"].astype(np.uint8).tobytes().decode()
