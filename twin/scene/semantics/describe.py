"""From sets of Gaussians to instances: colour, box and parts."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import TypeVar

import numpy as np
from jaxtyping import Bool, Float, UInt16
from scipy.spatial import cKDTree

from bridge.geometry import se3
from bridge.terminal import Advance
from twin.naming.colours import colour_name, main_colour
from twin.naming.things import NAMED, Instance, Mask, SemanticScene
from twin.naming.words import kind_of, label_of
from twin.scene.frames.rgbd import NEAR_M
from twin.scene.gaussians import GaussianCloud, moved_cloud
from twin.scene.raster.rasteriser import Rasteriser
from twin.scene.semantics.lift import Viewpoint, lifted
from twin.scene.semantics.masks import associate, observe
from twin.scene.semantics.points import points_of, solid_splats
from twin.scene.semantics.segment import SOURCE, segment
from twin.scene.semantics.shape_descriptors import CONTAINER, find_parts, measure_shape
from twin.scene.semantics.support import NoSupportError, SupportPlane, find_support, level_frame
from twin.scene.shape.known import pose_of

MIN_SPLATS = 20
"""Of a known object with fewer Gaussians nothing can be said."""
NEAR_POINT_M, NEAR_SIGMAS = 0.0175, 2.0
"""Gaussians farther from the fused surface's next point, and in its sigmas, are of no thing."""
CELL_M = 0.004
"""Gaussians of a scene lie about this far apart."""
MIN_SHOWN_PX = 20.0
"""A frame shows a thing when its Gaussians give this many pixels of the image."""
MIN_WHOLE, MIN_WHOLE_SHARE = 2, 0.4
"""Frames that show all of a thing, and of all that show it: what most frames cut off goes on,
nobody knows how far."""
EDGE_SHARE = 0.01
"""Of an image's width: what reaches this near to its edge is cut off."""
WHOLE_SHARE = 0.98
"""Of a thing's Gaussians within the edges."""
FOUND, SHOWN = 30, 70
"""Percent of the work when things are found, and when the frames that show them are counted."""

Item = TypeVar("Item")


def scene_from_masks(
    cloud: GaussianCloud,
    frames: Iterable[tuple[Viewpoint, Sequence[Mask]]],
    rasteriser: Rasteriser,
    source: str,
    advance: Advance = lambda done, note: None,
) -> SemanticScene:
    """Fuse the masks of a 2D segmenter into the Gaussians of a scene."""
    observations = [
        observe(rasteriser, cloud, viewpoint, masks)
        for viewpoint, masks in _told(frames, 0, SHOWN, advance, "masks lifted")
    ]
    found, labels = associate(observations, len(cloud), source)
    plane: SupportPlane | None = None
    with suppress(NoSupportError):
        plane = find_support(points_of(cloud.take(solid_splats(cloud))))
    told = _told(found, SHOWN, 100, advance, "things measured")
    instances = tuple(describe(cloud, thing, plane) for thing in told)
    num_masks = sum(len(item.labels) for item in observations)
    remark = (
        f"{num_masks} masks in {len(observations)} frames gave no instance: each needs matching "
        "masks in several frames"
    )
    remark = "" if instances else remark
    return SemanticScene(instances=instances, labels=labels, source=source, remark=remark)


def scene_by_default(
    cloud: GaussianCloud,
    viewpoints: Iterable[Viewpoint],
    rasteriser: Rasteriser,
    known: Mapping[str, Bool[np.ndarray, " num_splats"]] | None = None,
    surfaces_m: Mapping[str, Float[np.ndarray, "_ 3"]] | None = None,
    fused: GaussianCloud | None = None,
    advance: Advance = lambda done, note: None,
) -> SemanticScene:
    """Segment the scene with the default segmenter.

    What fewer than two viewpoints show whole is left out. A scene without a level plane, or with
    nothing on it, gives only what is known already, and a remark that says so. Where z of the
    scene's frame does not point up, the work is done in a frame where it does, and a remark says
    that, too.

    Args:
        known: Gaussians of the objects that a task names, by their ids. They come first, under
            their names. In others that nobody measured no thing is looked for.
        surfaces_m: Points of the reconstructed surfaces of some of them, where they stand: parts
            are told apart on these, which are thinner than any coat of Gaussians.
        fused: The surface as it was measured, evenly sampled: things are looked for in it. None:
            in the scene's Gaussians, which a fit put where colours change.
    """
    frames, surfaces_m, known = list(viewpoints), surfaces_m or {}, known or {}
    is_measured = np.any([~cloud.completed, *known.values()], axis=0)
    ids = np.flatnonzero(solid_splats(cloud) & is_measured)
    searched = cloud.take(ids) if fused is None else fused
    points = points_of(searched)
    Ts = [frame.T_base_camera for frame in frames]
    T_level_base = level_frame(points, Ts)
    is_level = np.array_equal(T_level_base, np.eye(4))
    if not is_level:
        cloud, searched = (moved_cloud(item, T_level_base) for item in (cloud, searched))
        points = points_of(searched)
        frames = [replace(f, T_base_camera=T_level_base @ f.T_base_camera) for f in frames]
        surfaces_m = {key: se3.apply(T_level_base, p) for key, p in surfaces_m.items()}
    labels = np.zeros(len(cloud), dtype=np.uint16)
    found = segment(points)
    far_m, nearest = cKDTree(points.p_m).query(cloud.means_m[ids])
    reach_m = np.maximum(NEAR_POINT_M, NEAR_SIGMAS * np.exp(searched.scales_log.max(axis=1)))
    labels[ids] = np.where(far_m < reach_m[nearest], found.labels[nearest], 0)
    things, remark = found.things, found.remark
    advance(FOUND, f"{len(things)} things found")
    keys, others, labels = numbered(labels, known)
    named = [(key, "", 1.0, NAMED) for key in keys]
    named += [("", things[n - 1].label, things[n - 1].score, SOURCE) for n in others]
    looked = _told(frames, FOUND, SHOWN, advance, "frames looked at")
    shown, whole = _num_shown(cloud, labels, len(named), looked, rasteriser)
    least = min(MIN_WHOLE, len(frames))
    kept = [
        n
        for n, (key, *_) in enumerate(named, start=1)
        if key or whole[n] >= max(least, MIN_WHOLE_SHARE * shown[n])
    ]
    new_number = np.zeros(len(named) + 1, dtype=np.uint16)
    new_number[kept] = np.arange(1, len(kept) + 1)
    labels = new_number[labels]
    instances = []
    for old in _told(kept, SHOWN, 100, advance, "things measured"):
        key, label, score, source = named[old - 1]
        item = Instance(
            id=int(new_number[old]),
            label=label,
            mask=labels == new_number[old],
            score=score,
            source=source,
        )
        item = describe(cloud, item, found.plane, key, surfaces_m.get(key))
        T = se3.invert(T_level_base) @ item.T_base_instance
        instances.append(item if is_level else replace(item, T_base_instance=T))
    if not is_level:
        up = ", ".join(f"{value:.2f}" for value in T_level_base[2, :3])
        remark = " ".join(filter(None, [remark, f"z does not point up here, ({up}) does"]))
    return SemanticScene(instances=tuple(instances), labels=labels, source=SOURCE, remark=remark)


def numbered(
    labels: UInt16[np.ndarray, " num_splats"],
    known: Mapping[str, Bool[np.ndarray, " num_splats"]],
) -> tuple[list[str], list[int], UInt16[np.ndarray, " num_splats"]]:
    """Let the known objects have their Gaussians, and what the segmenter joined with them.

    A thing of which at least half belongs to one known object is that object: its rest is what
    was left in the background when the object was cut out.

    Returns:
        Known objects, from number 1 on; the segmenter's numbers of the other things, which follow
        them; the new labels.
    """
    keys = [key for key, mask in known.items() if int(mask.sum()) >= MIN_SPLATS]
    sizes = np.bincount(labels, minlength=1)
    new_number, most = np.zeros((2, len(sizes)), dtype=np.int64)
    for number, key in enumerate(keys, start=1):
        held = np.bincount(labels[known[key]], minlength=len(sizes))
        mine = (2 * held >= sizes) & (held > most)
        new_number[mine], most[mine] = number, held[mine]
    new_number[0] = 0
    others = [n for n in range(1, len(sizes)) if not new_number[n] and sizes[n]]
    new_number[others] = np.arange(len(keys) + 1, len(keys) + len(others) + 1)
    joined = new_number.astype(np.uint16)[labels]
    for number, key in enumerate(keys, start=1):
        joined[known[key]] = number
    return keys, others, joined


def _told(
    items: Iterable[Item], first: int, last: int, advance: Advance, note: str
) -> Iterator[Item]:
    """Give one item after another, and tell the percentage after each."""
    known = list(items)
    for done, item in enumerate(known, start=1):
        yield item
        advance(first + (last - first) * done // len(known), note)


def _num_shown(
    cloud: GaussianCloud,
    labels: UInt16[np.ndarray, " num_splats"],
    num_things: int,
    viewpoints: Iterable[Viewpoint],
    rasteriser: Rasteriser,
) -> tuple[Sequence[int], Sequence[int]]:
    """For each label the number of viewpoints that show it, and of those that show it whole."""
    shown, whole = np.zeros((2, num_things + 1), dtype=np.int64)
    size = np.maximum(np.bincount(labels, minlength=num_things + 1), 1)
    for viewpoint in viewpoints if num_things else ():
        camera = viewpoint.camera
        everywhere = np.ones((1, camera.height, camera.width), dtype=np.float32)
        weight = lifted(rasteriser, cloud, viewpoint, everywhere)[:, 0]
        pixels = np.bincount(labels, weights=weight, minlength=num_things + 1)
        inside = _within_edges(cloud.means_m, viewpoint)
        share = np.bincount(labels, weights=inside, minlength=num_things + 1) / size
        shown += pixels >= MIN_SHOWN_PX
        whole += (pixels >= MIN_SHOWN_PX) & (share >= WHOLE_SHARE)
    return shown.tolist(), whole.tolist()


def _within_edges(
    p_m: Float[np.ndarray, "num_splats 3"], viewpoint: Viewpoint
) -> Bool[np.ndarray, " num_splats"]:
    """Which points a camera has well inside its image, hidden ones included."""
    camera = viewpoint.camera
    p = se3.apply(se3.invert(viewpoint.T_base_camera), p_m.astype(np.float64))
    front = p[:, 2] > NEAR_M
    uv, _ = camera.project(np.where(front[:, None], p, 1.0))
    edge = EDGE_SHARE * camera.width
    inside = np.all((uv > edge) & (uv < [camera.width - edge, camera.height - edge]), axis=1)
    return np.asarray(front & inside)


def describe(
    cloud: GaussianCloud,
    item: Instance,
    plane: SupportPlane | None,
    key: str = "",
    surface_m: Float[np.ndarray, "_ 3"] | None = None,
) -> Instance:
    """Measure one instance: colour, box, parts.

    Without a plane, or where it lies above the thing, heights count from its lowest Gaussian. An
    object of a task is called by its ``key`` and its colour, whatever the label.

    Args:
        key: Id of the object in the task; empty: none.
        surface_m: Points of its reconstructed surface, where there is one: parts are told apart on
            these.
    """
    ids = np.flatnonzero(item.mask)
    p = cloud.means_m[ids].astype(np.float64)
    up = np.array([0.0, 0.0, _ground_m(p, plane)])
    measured = measure_shape(p - up, CELL_M)
    color = np.clip(np.rint(main_colour(cloud.colors[ids]) * 255), 0, 255)
    label = item.label
    if key:
        is_open = measured.cavity is not None
        label = label_of(key, colour_name(color / 255), is_open=is_open, shape=measured.word)
    parts = {}
    if kind_of(label) == "container" or measured.word == CONTAINER:
        surface = p if surface_m is None else surface_m
        nearest = np.arange(len(p)) if surface_m is None else cKDTree(surface).query(p)[1]
        for name, part in find_parts(surface - up, CELL_M).items():
            parts[name] = np.isin(np.arange(len(cloud)), ids[part[nearest]])
    return replace(
        item,
        label=label,
        color_srgb=(int(color[0]), int(color[1]), int(color[2])),
        T_base_instance=pose_of(np.array([*(measured.centre_m + up), measured.yaw_rad])),
        size_m=measured.size_m,
        parts=parts,
    )


def _ground_m(p: Float[np.ndarray, "num_points 3"], plane: SupportPlane | None) -> float:
    """Height of what a thing stands on."""
    lowest = float(np.quantile(p[:, 2], 0.01))
    if plane is None:
        return lowest
    under = float(np.median(p[:, 2] - plane.height_m(p) / plane.normal[2]))
    return under if -0.02 < lowest - under < 0.05 else lowest
