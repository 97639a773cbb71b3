"""From sets of Gaussians to instances: colour, box, parts and keypoints."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np
from jaxtyping import Bool, Float, Float32, Int64, UInt16
from scipy.spatial import cKDTree

from bridge.geometry import se3
from bridge.terminal import Advance
from twin.naming.colours import colour_name
from twin.naming.things import Instance, MaskSet, SemanticScene
from twin.naming.words import kind_of, label_of
from twin.scene.frames.rgbd import NEAR_M
from twin.scene.gaussians import GaussianCloud, moved_cloud
from twin.scene.raster.rasteriser import Rasteriser
from twin.scene.semantics.associate import AssociateConfig, SmoothConfig, associate, smooth_shares
from twin.scene.semantics.language import NAMED, Numbered, numbered
from twin.scene.semantics.lift import Viewpoint, observe, visible_weight
from twin.scene.semantics.part_segmentation import Parts, PartsConfig, find_parts
from twin.scene.semantics.segment import (
    SOURCE,
    SegmentConfig,
    Thing,
    points_of,
    solid_splats,
)
from twin.scene.semantics.shape_descriptors import CONTAINER, measure_shape
from twin.scene.semantics.stable_things import segment_stably
from twin.scene.semantics.support import (
    NoSupportError,
    SupportConfig,
    SupportPlane,
    find_support,
    level_frame,
)

NEAR_POINT_M = 0.02
"""Gaussians farther from all points of the fused surface belong to no thing."""
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
    frames: Iterable[tuple[Viewpoint, MaskSet]],
    rasteriser: Rasteriser,
    config: AssociateConfig | None = None,
    advance: Advance = lambda done, note: None,
) -> SemanticScene:
    """Fuse the masks of a 2D segmenter into the Gaussians of a scene."""
    observations, sources = [], []
    for viewpoint, masks in _told(frames, 0, SHOWN, advance, "masks lifted"):
        observations.append(observe(rasteriser, cloud, viewpoint, masks))
        sources.append(masks.source)
    source = ", ".join(dict.fromkeys(sources)) or "no masks"
    found = associate(
        observations,
        len(cloud),
        config or AssociateConfig(),
        smooth=lambda share: smooth_shares(share, cloud, SmoothConfig()),
    )
    plane = support_of(cloud)
    instances = tuple(
        describe(
            cloud,
            number=number,
            mask=track.mask,
            label=track.label,
            support=track.support,
            seen=track.seen,
            score=track.score,
            source=source,
            plane=plane,
        )
        for number, track in enumerate(
            _told(found.tracks, SHOWN, 100, advance, "things measured"), start=1
        )
    )
    num_masks = sum(len(item.labels) for item in observations)
    remark = (
        ""
        if instances
        else (
            f"{num_masks} masks in {len(observations)} frames gave no instance: each needs "
            "matching masks in several frames"
        )
    )
    return SemanticScene(instances=instances, labels=found.labels, source=source, remark=remark)


def scene_by_default(
    cloud: GaussianCloud,
    viewpoints: Iterable[Viewpoint],
    rasteriser: Rasteriser,
    config: SegmentConfig | None = None,
    known: Mapping[str, Bool[np.ndarray, " num_splats"]] | None = None,
    surfaces_m: Mapping[str, Float[np.ndarray, "_ 3"]] | None = None,
    fused: GaussianCloud | None = None,
    advance: Advance = lambda done, note: None,
) -> SemanticScene:
    """Segment the scene with the default segmenter.

    Support and seen count the viewpoints that show an instance; what fewer than two of them show
    whole is left out. A scene without a level plane, or with nothing on it, gives only what is
    known already, and a remark that says so. Where z of the scene's frame does not point up, the
    work is done in a frame where it does, and a remark says that, too.

    Args:
        known: Gaussians of the objects that a task names, by their ids. They come first, under
            their names.
        surfaces_m: Points of the reconstructed surfaces of some of them, where they stand: parts
            are told apart on these, which are thinner than any coat of Gaussians.
        fused: The surface as it was measured, evenly sampled: things are looked for in it. None:
            in the scene's Gaussians, which a fit put where colours change.
    """
    frames = list(viewpoints)
    ids = np.flatnonzero(solid_splats(cloud))
    config = config or SegmentConfig()
    searched = cloud.take(ids) if fused is None else fused
    points = points_of(searched)
    Ts = [frame.T_base_camera for frame in frames]
    T_level_base = level_frame(points.p_m, points.normals, Ts, config.support)
    is_level = np.array_equal(T_level_base, np.eye(4))
    if not is_level:
        cloud, searched = (moved_cloud(item, T_level_base) for item in (cloud, searched))
        points = points_of(searched)
        frames = [replace(f, T_base_camera=T_level_base @ f.T_base_camera) for f in frames]
        surfaces_m = {key: se3.apply(T_level_base, p) for key, p in (surfaces_m or {}).items()}
    labels = np.zeros(len(cloud), dtype=np.uint16)
    things: tuple[Thing, ...] = ()
    plane: SupportPlane | None = None
    try:
        found = segment_stably(points, config)
    except NoSupportError as error:
        remark = str(error)
    else:
        labels[ids] = _nearest_label(found.labels, points.p_m, cloud.means_m[ids])
        things, plane, remark = found.things, found.plane, found.remark
    advance(FOUND, f"{len(things)} things found")
    instances, numbers = _seen_instances(
        cloud, frames, rasteriser, labels, things, known or {}, surfaces_m or {}, plane, advance
    )
    if not is_level:
        up = ", ".join(f"{value:.2f}" for value in T_level_base[2, :3])
        remark = " ".join(filter(None, [remark, f"z does not point up here, ({up}) does"]))
        instances = tuple(_moved(item, se3.invert(T_level_base)) for item in instances)
    return SemanticScene(instances=instances, labels=numbers, source=SOURCE, remark=remark)


def _nearest_label(
    labels: Int64[np.ndarray, " num_points"],
    p_m: Float[np.ndarray, "num_points 3"],
    wanted_m: Float32[np.ndarray, "num_splats 3"],
) -> UInt16[np.ndarray, " num_splats"]:
    """What the nearest point belongs to; nothing where none is near."""
    far_m, nearest = cKDTree(p_m).query(wanted_m, distance_upper_bound=NEAR_POINT_M)
    known = np.append(labels, 0)  # the query gives the number of points where none is near
    return np.asarray(np.where(np.isfinite(far_m), known[nearest], 0), dtype=np.uint16)


def _seen_instances(
    cloud: GaussianCloud,
    frames: Sequence[Viewpoint],
    rasteriser: Rasteriser,
    labels: UInt16[np.ndarray, " num_splats"],
    things: Sequence[Thing],
    known: Mapping[str, Bool[np.ndarray, " num_splats"]],
    surfaces_m: Mapping[str, Float[np.ndarray, "_ 3"]],
    plane: SupportPlane | None,
    advance: Advance,
) -> tuple[tuple[Instance, ...], UInt16[np.ndarray, " num_splats"]]:
    """Describe what is known and the things that enough frames show whole; their labels, too."""
    final = numbered(labels, known)
    total = len(final.keys) + len(final.others)
    looked = _told(frames, FOUND, SHOWN, advance, "frames looked at")
    shown, whole = _num_shown(cloud, final.labels, total, looked, rasteriser)
    final, kept = _seen_whole(final, shown, whole, min(MIN_WHOLE, len(frames)))
    named = [(key, "", 1.0, NAMED) for key in final.keys]
    named += [("", things[n - 1].label, things[n - 1].score, SOURCE) for n in final.others]
    reporting = _told(named, SHOWN, 100, advance, "things measured")
    instances = tuple(
        describe(
            cloud,
            number=number,
            mask=final.labels == number,
            key=key,
            label=label,
            support=shown[kept[number - 1]],
            seen=shown[kept[number - 1]],
            score=score,
            source=source,
            plane=plane,
            surface_m=surfaces_m.get(key),
        )
        for number, (key, label, score, source) in enumerate(reporting, start=1)
    )
    return instances, final.labels


def _moved(item: Instance, T: Float[np.ndarray, "4 4"]) -> Instance:
    """The same instance in another frame."""
    keypoints = {name: se3.apply(T, point[None])[0] for name, point in item.keypoints_m.items()}
    return replace(item, T_base_instance=T @ item.T_base_instance, keypoints_m=keypoints)


def _seen_whole(
    found: Numbered, shown: Sequence[int], whole: Sequence[int], least: int
) -> tuple[Numbered, list[int]]:
    """Drop what too few frames show whole; known objects stay. Also the old number of each."""
    others = range(len(found.keys) + 1, len(found.keys) + len(found.others) + 1)
    firm = [n for n in others if whole[n] >= max(least, MIN_WHOLE_SHARE * shown[n])]
    kept = [*range(1, len(found.keys) + 1), *firm]
    new_number = np.zeros(len(whole), dtype=np.uint16)
    new_number[kept] = np.arange(1, len(kept) + 1)
    things = tuple(found.others[n - 1 - len(found.keys)] for n in kept[len(found.keys) :])
    return replace(found, labels=new_number[found.labels], others=things), kept


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
) -> tuple[list[int], list[int]]:
    """For each label the number of viewpoints that show it, and of those that show it whole."""
    shown = np.zeros(num_things + 1, dtype=np.int64)
    whole = np.zeros(num_things + 1, dtype=np.int64)
    size = np.maximum(np.bincount(labels, minlength=num_things + 1), 1)
    if num_things:
        for viewpoint in viewpoints:
            weight: Float32[np.ndarray, " num_splats"]
            weight = visible_weight(rasteriser, cloud, viewpoint)
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


def support_of(cloud: GaussianCloud) -> SupportPlane | None:
    """The plane that things stand on, if there is one."""
    points = points_of(cloud.take(solid_splats(cloud)))
    try:
        return find_support(points.p_m, points.normals, SupportConfig())
    except NoSupportError:
        return None


def describe(
    cloud: GaussianCloud,
    *,
    number: int,
    mask: Bool[np.ndarray, " num_splats"],
    label: str,
    support: int,
    seen: int,
    score: float,
    source: str,
    plane: SupportPlane | None,
    key: str = "",
    surface_m: Float[np.ndarray, "_ 3"] | None = None,
) -> Instance:
    """Measure one instance: colour, box, parts, keypoints.

    Without a plane, or where it lies above the thing, heights count from its lowest Gaussian. An
    object of a task is called by its ``key`` and its colour, whatever the label.

    Args:
        score: Confidence, 0..1.
        key: Id of the object in the task; empty: none.
        surface_m: Points of its reconstructed surface, where there is one.
    """
    ids = np.flatnonzero(mask)
    p = cloud.means_m[ids].astype(np.float64)
    up = np.array([0.0, 0.0, _ground_m(p, plane)])
    xyh = p - up
    measured = measure_shape(xyh, CELL_M)
    color = np.clip(np.rint(np.median(cloud.colors[ids], axis=0) * 255), 0, 255)
    if key:
        is_open = measured.cavity is not None
        label = label_of(key, colour_name(color / 255), is_open=is_open, shape=measured.word)
    is_nameless_container = kind_of(label) == "other" and measured.word == CONTAINER
    called = CONTAINER if is_nameless_container else label
    parts = _parts_of(xyh, called, None if surface_m is None else surface_m - up)
    T = np.eye(4)
    T[:2, :2] = [
        [np.cos(measured.yaw_rad), -np.sin(measured.yaw_rad)],
        [np.sin(measured.yaw_rad), np.cos(measured.yaw_rad)],
    ]
    T[:3, 3] = measured.centre_m + up
    return Instance(
        id=number,
        label=label,
        mask=mask,
        support=support,
        seen=seen,
        score=score,
        source=source,
        color_srgb=(int(color[0]), int(color[1]), int(color[2])),
        T_base_instance=T,
        size_m=measured.size_m,
        parts={name: _among(ids, part, len(cloud)) for name, part in parts.masks.items()},
        keypoints_m={name: point + up for name, point in parts.keypoints.items()},
    )


def _ground_m(p: Float[np.ndarray, "num_points 3"], plane: SupportPlane | None) -> float:
    """Height of what a thing stands on."""
    lowest = float(np.quantile(p[:, 2], 0.01))
    if plane is None:
        return lowest
    under = float(np.median(p[:, 2] - plane.height_m(p) / plane.normal[2]))
    return under if -0.02 < lowest - under < 0.05 else lowest


def _parts_of(
    xyh: Float[np.ndarray, "num_points 3"],
    called: str,
    surface: Float[np.ndarray, "_ 3"] | None,
) -> Parts:
    """Parts of a thing's Gaussians, told apart on its reconstructed surface where there is one."""
    if surface is None:
        return find_parts(xyh, called, CELL_M, PartsConfig())
    found = find_parts(surface, called, CELL_M, PartsConfig())
    nearest = cKDTree(surface).query(xyh)[1]
    masks = {name: part[nearest] for name, part in found.masks.items()}
    return Parts(masks=masks, keypoints=found.keypoints)


def _among(ids: np.ndarray, part: np.ndarray, num_splats: int) -> np.ndarray:
    mask = np.zeros(num_splats, dtype=bool)
    mask[ids[part]] = True
    return mask
