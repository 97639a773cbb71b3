"""Soft toys, also several equal ones: what is left beside the rigid objects, fitted and assigned.

A toy is laid out by its mesh at rest; how far its extents then differ is what its softness did.
Equal toys are told apart by where each is expected: its start range, or where it was last seen
(assignment of least total cost, Kuhn 1955).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float
from scipy.cluster.vq import kmeans2
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree

from bridge.geometry import se3
from bridge.task.task_file import ObjectModel
from twin.scene.localise.mesh_fit import (
    MeshFit,
    MeshFitConfig,
    MeshSurface,
    agreeing,
    facing,
    fit_mesh,
    known_surface,
)
from twin.scene.localise.points import (
    CameraView,
    Cluster,
    ColourConfig,
    PointConfig,
    clusters,
    likeness,
    voxel_mean,
)
from twin.scene.localise.shape_fit import ShapeFitConfig
from twin.scene.shape.known import surface_distances


@dataclass(frozen=True, kw_only=True)
class SoftConfig:
    """How soft toys are found."""

    min_height_m: float = 0.006
    """Lower points may be table."""
    clear_m: float = 0.009
    """Points nearer than this to a rigid object that was found belong to it."""
    growth: float = 1.2
    """A cluster with a longer diagonal than the toy's times this holds more than one thing."""
    shrink: float = 0.35
    """One shorter than the toy's shortest extent times this is not the toy."""
    fill: float = 0.7
    """A toy covers this share of the rectangle around it, seen from above."""
    stretch_m: float = 0.012
    """Points nearer than this to the fitted surface show how the toy is deformed."""
    tilt_sigma_rad: float = 0.1
    """Prior of roll and pitch of a toy that stands."""
    well_explained: float = 0.9
    """With less it may lie on another side: more starts are tried."""
    well_seen_through: float = 0.12
    """So they are with more of its surface seen through."""
    hopeless: float = 0.5
    """With less it is no such toy on any side: one on a wrong side explains two thirds."""
    turned_share: float = 0.1
    """Clusters with fewer points than this share of the largest show too little of a toy to tell
    its sides apart."""
    max_seen_through: float = 0.3
    """With more of its surface seen through it is something else."""
    min_agreeing: float = 0.35
    """Some camera must measure this share of the surface that faces it where the toy is."""
    moved_m: float = 0.05
    """Equal toys farther from where they are expected were moved, no matter how far: those that
    stayed keep their names."""
    score_m: float = 0.2
    """In the assignment, a point of score counts like this distance."""
    min_margin_m: float = 0.02
    """Equal toys whose exchange would cost less are reported as hardly told apart."""


STANDS = 0.9
"""Cosine of the tilt up to which the underside of a toy is taken to be level."""


@dataclass(frozen=True, kw_only=True)
class SoftShape:
    """Coarse shape: a box with its middle, axes and extents."""

    centroid_m: Float[np.ndarray, "3"]
    R_base_axes: Float[np.ndarray, "3 3"]
    extents_m: Float[np.ndarray, "3"]
    extents_sigma_m: Float[np.ndarray, "3"]

    def to_record(self) -> dict[str, list[float] | list[list[float]]]:
        """Return the entry ``soft_shape`` of a localisation record."""
        return {
            "centroid_m": self.centroid_m.tolist(),
            "axes": self.R_base_axes.T.tolist(),
            "extents_m": self.extents_m.tolist(),
            "extents_sigma_m": self.extents_sigma_m.tolist(),
        }


def soft_shape(
    views: Sequence[CameraView],
    surface: MeshSurface,
    model: ObjectModel,
    fit: MeshFit,
    points: PointConfig,
    soft: SoftConfig,
) -> SoftShape:
    """Extents along the axes of the fitted pose: those at rest, plus how far the seen ends moved.

    All points near the fitted surface count, whatever their colour.
    """
    T = fit.T_base_object
    T_object_base = se3.invert(T)
    above = [view.p_base[view.p_base[:, 2] > soft.min_height_m] for view in views]
    local = se3.apply(T_object_base, np.concatenate(above))
    reach = np.array(model.size_m) / 2 + soft.stretch_m
    local = voxel_mean(local[np.all(np.abs(local) < reach, axis=1)], points.voxel_m)
    distance, _ = cKDTree(surface.p_m).query(local)
    local = local[distance < soft.stretch_m]
    # An end that every camera looks at from behind was not seen; it is taken as at rest.
    centres = se3.apply(T_object_base, np.array([view.T_base_depth[:3, 3] for view in views]))
    directions = centres / np.linalg.norm(centres, axis=1, keepdims=True)
    faced = np.any([facing(T_object_base, view, surface) for view in views], axis=0)
    half, ends = np.array(model.size_m) / 2, np.zeros((2, 3))
    for row, sign in enumerate((1.0, -1.0)):
        seen = (sign * directions).max(axis=0) > -0.2
        reached = np.percentile(sign * local, 98, axis=0)
        rest = np.percentile(sign * surface.p_m[faced], 98, axis=0)
        ends[row] = sign * np.maximum(half + np.where(seen, reached - rest, 0.0), 0.1 * half)
    if T[2, 2] > STANDS and T[2, 3] + ends[1, 2] < 0:
        ends[1, 2] = -T[2, 3]  # it cannot reach below the table
    sigma = np.hypot(0.005, fit.residual_m) * np.ones(3)
    return SoftShape(
        centroid_m=se3.apply(T, ends.mean(axis=0)[None])[0],
        R_base_axes=T[:3, :3].copy(),
        extents_m=ends[0] - ends[1],
        extents_sigma_m=sigma,
    )


DENSE_SAMPLES = 20_000
CELL_M = 0.004


def candidates(
    model: ObjectModel,
    count: int,
    views: Sequence[CameraView],
    blocked: Mapping[ObjectModel, Float[np.ndarray, "4 4"]],
    points: PointConfig,
    colour: ColourConfig,
    soft: SoftConfig,
) -> list[Cluster]:
    """Clusters that may be one toy each; what touches is cut apart.

    Args:
        count: How many equal ones there are at most.
        blocked: Rigid objects with their poses; their points do not count.
    """
    parts = []
    for view in views:
        p = view.p_base
        alike = p[:, 2] > soft.min_height_m
        alike[alike] = likeness(view.color_linear[alike], model.color_srgb, colour) >= (
            points.min_likeness
        )
        p = voxel_mean(p[alike], points.voxel_m)
        parts.append(p[~_on_others(p, blocked, soft.clear_m)])
    ids = np.repeat(np.arange(len(parts)), [len(part) for part in parts])
    everything = np.concatenate(parts) if parts else np.zeros((0, 3))
    single = []
    for group in clusters(everything, ids, points.cluster_gap_m):
        if len(group) < points.min_points:
            continue
        for piece in _cut(group, model, count, soft):
            extent = np.ptp(np.percentile(piece.p_base, [2, 98], axis=0), axis=0).max()
            if len(piece) >= points.min_points and extent > soft.shrink * min(model.size_m):
                single.append(piece)
    return single


def _on_others(
    p: Float[np.ndarray, "num_points 3"],
    blocked: Mapping[ObjectModel, Float[np.ndarray, "4 4"]],
    clear_m: float,
) -> Bool[np.ndarray, " num_points"]:
    mask = np.zeros(len(p), dtype=bool)
    for model, T in blocked.items():
        if model.mesh is None:
            distance, _ = surface_distances(p, model, T)
            mask |= np.abs(distance) < clear_m
        elif len(p):
            surface = se3.apply(T, known_surface(model, DENSE_SAMPLES).p_m)
            distance, _ = cKDTree(surface).query(p, distance_upper_bound=clear_m)
            mask |= np.isfinite(distance)
    return mask


def _cut(group: Cluster, model: ObjectModel, count: int, soft: SoftConfig) -> list[Cluster]:
    """Cut a cluster that is too large for one toy into as many as would cover its area."""
    low, high = np.percentile(group.p_base[:, :2], [1, 99], axis=0)
    if float(np.linalg.norm(high - low)) <= soft.growth * float(np.linalg.norm(model.size_m[:2])):
        return [group]
    cells = np.unique(np.floor(group.p_base[:, :2] / CELL_M).astype(np.int64), axis=0)
    one = soft.fill * model.size_m[0] * model.size_m[1]
    number = round(len(cells) * CELL_M**2 / one)
    if not 2 <= number <= count:
        return []
    _, labels = kmeans2(group.p_base, number, minit="++", seed=0)
    return [
        Cluster(p_base=group.p_base[labels == label], view_ids=group.view_ids[labels == label])
        for label in range(number)
    ]


@dataclass(frozen=True, kw_only=True)
class SoftFit:
    """One toy, or why there is none."""

    reason: str | None
    num_points: int
    fit: MeshFit | None = None
    shape: SoftShape | None = None
    margin_m: float | None = None
    """What exchanging it with an equal toy would cost; None without equal ones."""


def fit_toys(
    models: Sequence[ObjectModel],
    views: Sequence[CameraView],
    blocked: Mapping[ObjectModel, Float[np.ndarray, "4 4"]],
    expected_m: Mapping[str, Float[np.ndarray, "3"]],
    *,
    points: PointConfig,
    colour: ColourConfig,
    fit: ShapeFitConfig,
    mesh: MeshFitConfig,
    soft: SoftConfig,
    min_explained: float,
) -> dict[str, SoftFit]:
    """Find toys that all look the same.

    Args:
        expected_m: Where each toy is expected, by id; those without are taken as they come.
        min_explained: Share of a cluster's points that the toy must explain.

    Returns:
        By id; a reason where a toy was not found.
    """
    model = models[0]
    groups = candidates(model, len(models), views, blocked, points, colour, soft)
    surface = known_surface(model, mesh.num_samples)
    enough = soft.turned_share * max((len(group) for group in groups), default=0)
    fits = [
        fit_toy(group, views, surface, fit, mesh, soft, turn=len(group) >= enough)
        for group in groups
    ]
    good = [
        index
        for index, item in enumerate(fits)
        if item.explained >= min_explained
        and item.seen_through <= soft.max_seen_through
        and agreeing(item.T_base_object, surface, views, mesh.see_through_m) >= soft.min_agreeing
    ]
    cost = _costs(models, [fits[index] for index in good], expected_m, soft)
    rows, columns = linear_sum_assignment(cost)
    taken = dict(zip(rows.tolist(), columns.tolist(), strict=True))
    margins = _margins(cost, taken)
    found = {}
    for row, item in enumerate(models):
        if row not in taken:
            found[item.id] = SoftFit(
                reason=_why_not(item, len(models), groups, good, fits),
                num_points=0 if good else sum(len(group) for group in groups),
            )
            continue
        index = good[taken[row]]
        margin = margins.get(row)
        found[item.id] = SoftFit(
            reason=_doubt(item, margin, soft),
            num_points=len(groups[index]),
            fit=fits[index],
            shape=soft_shape(views, surface, model, fits[index], points, soft),
            margin_m=margin,
        )
    return found


def fit_toy(
    group: Cluster,
    views: Sequence[CameraView],
    surface: MeshSurface,
    fit: ShapeFitConfig,
    mesh: MeshFitConfig,
    soft: SoftConfig,
    *,
    turn: bool,
) -> MeshFit:
    """Lay a toy's mesh onto points, standing first, on its other sides if that explains little."""
    standing = fit_mesh(group, views, surface, fit, mesh, tilt_sigma_rad=soft.tilt_sigma_rad)
    doubtful = standing.seen_through > soft.well_seen_through
    doubtful |= standing.explained < soft.well_explained
    if not turn or not doubtful or standing.explained < soft.hopeless:
        return standing
    few = replace(mesh, num_starts=max(mesh.num_starts // 2, 1))
    lying = fit_mesh(group, views, surface, fit, few, tilt_sigma_rad=10.0, lying=True)
    return min((standing, lying), key=lambda item: item.score)


def _costs(
    models: Sequence[ObjectModel],
    fits: Sequence[MeshFit],
    expected_m: Mapping[str, Float[np.ndarray, "3"]],
    soft: SoftConfig,
) -> Float[np.ndarray, "num_models num_candidates"]:
    """What it costs to say that a fit is a toy [m]."""
    cost = [
        [
            _displacement(expected_m.get(item.id), fit, soft) + soft.score_m * fit.score
            for fit in fits
        ]
        for item in models
    ]
    return np.array(cost).reshape(len(models), len(fits))


def _displacement(
    expected_m: Float[np.ndarray, "3"] | None, fit: MeshFit, soft: SoftConfig
) -> float:
    """Distance to where a toy is expected; beyond ``moved_m`` it hardly grows [m]."""
    if expected_m is None:
        return 0.0
    distance = float(np.linalg.norm(fit.T_base_object[:3, 3] - expected_m))
    return soft.moved_m * (1.0 - float(np.exp(-distance / soft.moved_m)))


def _margins(
    cost: Float[np.ndarray, "num_models num_candidates"], taken: Mapping[int, int]
) -> dict[int, float]:
    """Per assigned toy: what the cheapest exchange with another one would cost."""
    margins: dict[int, float] = {}
    for row, column in taken.items():
        others = [
            cost[row, other_column] + cost[other, column] - cost[row, column]
            - cost[other, other_column]
            for other, other_column in taken.items()
            if other != row
        ]  # fmt: skip
        if others:
            margins[row] = float(min(others))
    return margins


def _doubt(model: ObjectModel, margin_m: float | None, soft: SoftConfig) -> str | None:
    if margin_m is None or margin_m >= soft.min_margin_m:
        return None
    return (
        f"{model.id} is hardly told apart from an equal object: exchanging them costs "
        f"{margin_m * 1e3:.0f} mm"
    )


def _why_not(
    model: ObjectModel,
    count: int,
    groups: Sequence[Cluster],
    good: Sequence[int],
    fits: Sequence[MeshFit],
) -> str:
    if good:
        return f"{len(good)} of {count} objects that look like {model.id} were seen"
    if not groups:
        return f"no cluster above the table has the colour and the size of {model.id}"
    best = max(fits, key=lambda item: item.explained - item.seen_through)
    return (
        f"{len(groups)} clusters have the colour of {model.id}, none its shape: of the best, "
        f"{best.explained:.0%} of the points fit and {best.seen_through:.0%} of the surface was "
        "seen through"
    )
