"""Soft toys, also several equal ones: what is left beside the rigid objects, fitted and assigned.

A toy is laid out by its mesh at rest; how far its extents then differ is what its softness did.
Equal toys are told apart by where each is expected: its start range, or where it was last seen
(assignment of least total cost, Kuhn 1955).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from scipy.cluster.vq import kmeans2
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree

from bridge.geometry import se3
from bridge.task.task_file import ObjectModel
from twin.scene.localise.mesh_fit import (
    MIN_EXPLAINED,
    SEE_THROUGH_M,
    MeshFit,
    MeshSurface,
    agreeing,
    facing,
    fit_mesh,
    known_surface,
)
from twin.scene.localise.points import (
    MIN_POINTS,
    VOXEL_M,
    CameraView,
    Cluster,
    object_points,
    voxel_mean,
)
from twin.scene.shape.known import surface_distances

LEAST_HEIGHT_M = 0.006
"""Lower points may be table."""
CLEAR_M = 0.009
"""Points nearer than this to a rigid object that was found belong to it."""
GROWTH = 1.2
"""A cluster with a longer diagonal than the toy's times this holds more than one thing."""
SHRINK = 0.35
"""One shorter than the toy's shortest extent times this is not the toy."""
FILL = 0.7
"""A toy covers this share of the rectangle around it, seen from above."""
STRETCH_M = 0.012
"""Points nearer than this to the fitted surface show how the toy is deformed."""
TILT_SIGMA_RAD = 0.1
"""Prior of roll and pitch of a toy that stands."""
WELL_EXPLAINED = 0.9
"""With less it may lie on another side: more starts are tried."""
WELL_SEEN_THROUGH = 0.12
"""So they are with more of its surface seen through."""
TURNED_SHARE = 0.1
"""Clusters with fewer points than this share of the largest show too little of a toy to tell
its sides apart."""
MAX_SEEN_THROUGH = 0.3
"""With more of its surface seen through it is something else."""
MIN_AGREEING = 0.35
"""Some camera must measure this share of the surface that faces it where the toy is."""
MOVED_M = 0.05
"""Equal toys farther from where they are expected were moved, no matter how far: those that
stayed keep their names."""
SCORE_M = 0.2
"""In the assignment, a point of score counts like this distance."""
MIN_MARGIN_M = 0.02
"""Equal toys whose exchange would cost less are reported as hardly told apart."""
STANDS = 0.9
"""Cosine of the tilt up to which the underside of a toy is taken to be level."""


def soft_shape(
    views: Sequence[CameraView], surface: MeshSurface, model: ObjectModel, fit: MeshFit
) -> dict[str, Any]:
    """Extents along the axes of the fitted pose: those at rest, plus how far the seen ends moved.

    All points near the fitted surface count, whatever their colour. As the entry ``soft_shape`` of
    a localisation record has it: a box with its middle, axes and extents.
    """
    T = fit.T_base_object
    T_object_base = se3.invert(T)
    above = [view.p_base[view.p_base[:, 2] > LEAST_HEIGHT_M] for view in views]
    local = se3.apply(T_object_base, np.concatenate(above))
    reach = np.array(model.size_m) / 2 + STRETCH_M
    local = voxel_mean(local[np.all(np.abs(local) < reach, axis=1)], VOXEL_M)
    distance, _ = cKDTree(surface.p_m).query(local)
    local = local[distance < STRETCH_M]
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
    return {
        "centroid_m": se3.apply(T, ends.mean(axis=0)[None])[0].tolist(),
        "axes": T[:3, :3].T.tolist(),
        "extents_m": (ends[0] - ends[1]).tolist(),
        "extents_sigma_m": [float(np.hypot(0.005, fit.residual_m))] * 3,
    }


DENSE_SAMPLES = 20_000
CELL_M = 0.004


def candidates(
    model: ObjectModel,
    count: int,
    views: Sequence[CameraView],
    blocked: Mapping[ObjectModel, Float[np.ndarray, "4 4"]],
) -> list[Cluster]:
    """Clusters that may be one toy each; what touches is cut apart.

    Args:
        blocked: Rigid objects with their poses; their points do not count.
    """
    single = []
    is_other = partial(_on_others, blocked=blocked)
    for group in object_points(views, model, LEAST_HEIGHT_M, is_other):
        if len(group) < MIN_POINTS:
            continue
        for piece in _cut(group, model, count):
            extent = np.ptp(np.percentile(piece.p_base, [2, 98], axis=0), axis=0).max()
            if len(piece) >= MIN_POINTS and extent > SHRINK * min(model.size_m):
                single.append(piece)
    return single


def _on_others(
    p: Float[np.ndarray, "num_points 3"],
    blocked: Mapping[ObjectModel, Float[np.ndarray, "4 4"]],
) -> Bool[np.ndarray, " num_points"]:
    mask = np.zeros(len(p), dtype=bool)
    for model, T in blocked.items():
        if model.mesh is None:
            distance, _ = surface_distances(p, model, T)
            mask |= np.abs(distance) < CLEAR_M
        elif len(p):
            surface = se3.apply(T, known_surface(model, DENSE_SAMPLES).p_m)
            distance, _ = cKDTree(surface).query(p, distance_upper_bound=CLEAR_M)
            mask |= np.isfinite(distance)
    return mask


def _cut(group: Cluster, model: ObjectModel, count: int) -> list[Cluster]:
    """Cut a cluster that is too large for one toy into as many as would cover its area."""
    low, high = np.percentile(group.p_base[:, :2], [1, 99], axis=0)
    if float(np.linalg.norm(high - low)) <= GROWTH * float(np.linalg.norm(model.size_m[:2])):
        return [group]
    cells = np.unique(np.floor(group.p_base[:, :2] / CELL_M).astype(np.int64), axis=0)
    one = FILL * model.size_m[0] * model.size_m[1]
    number = round(len(cells) * CELL_M**2 / one)
    if not 2 <= number <= count:
        return []
    return _pieces(group, number)


def _pieces(group: Cluster, number: int) -> list[Cluster]:
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
    shape: Mapping[str, Any] | None = None
    """See ``soft_shape``."""


def fit_toys(
    models: Sequence[ObjectModel],
    views: Sequence[CameraView],
    blocked: Mapping[ObjectModel, Float[np.ndarray, "4 4"]],
    expected_m: Mapping[str, Float[np.ndarray, "3"]],
) -> dict[str, SoftFit]:
    """Find toys that all look the same.

    Args:
        expected_m: Where each toy is expected, by id; those without are taken as they come.
    """
    model = models[0]
    groups = candidates(model, len(models), views, blocked)
    surface = known_surface(model)
    enough = TURNED_SHARE * max((len(group) for group in groups), default=0)
    fits = [fit_toy(group, views, surface, turn=len(group) >= enough) for group in groups]
    if len(models) > 1:  # what no toy explains may be two that touch
        odd = [g for g, fit in zip(groups, fits, strict=True) if fit.explained < MIN_EXPLAINED]
        halves = [half for group in odd for half in _pieces(group, 2) if len(half) >= enough]
        groups += halves
        fits += [fit_toy(half, views, surface, turn=True) for half in halves]
    good = [
        index
        for index, item in enumerate(fits)
        if item.explained >= MIN_EXPLAINED
        and item.seen_through <= MAX_SEEN_THROUGH
        and agreeing(item.T_base_object, surface, views, SEE_THROUGH_M) >= MIN_AGREEING
    ]
    cost = _costs(models, [fits[index] for index in good], expected_m)
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
        found[item.id] = SoftFit(
            reason=_doubt(item, margins[row]),
            num_points=len(groups[index]),
            fit=fits[index],
            shape=soft_shape(views, surface, model, fits[index]),
        )
    return found


def fit_toy(
    group: Cluster, views: Sequence[CameraView], surface: MeshSurface, *, turn: bool
) -> MeshFit:
    """Lay a toy's mesh onto points, standing first, on its other sides if that explains little."""
    standing = fit_mesh(group, views, surface, tilt_sigma_rad=TILT_SIGMA_RAD)
    doubtful = standing.seen_through > WELL_SEEN_THROUGH
    doubtful |= standing.explained < WELL_EXPLAINED
    if not turn or not doubtful:
        return standing
    lying = fit_mesh(group, views, surface, tilt_sigma_rad=10.0, lying=True)
    return min((standing, lying), key=lambda item: item.score)


def _costs(
    models: Sequence[ObjectModel],
    fits: Sequence[MeshFit],
    expected_m: Mapping[str, Float[np.ndarray, "3"]],
) -> Float[np.ndarray, "num_models num_candidates"]:
    """What it costs to say that a fit is a toy [m]."""
    cost = np.tile([SCORE_M * fit.score for fit in fits], (len(models), 1))
    for row, item in enumerate(models):
        for column, fit in enumerate(fits if item.id in expected_m else ()):
            away_m = np.linalg.norm(fit.T_base_object[:3, 3] - expected_m[item.id])
            cost[row, column] += MOVED_M * (1.0 - np.exp(-away_m / MOVED_M))  # hardly grows beyond
    return cost


def _margins(
    cost: Float[np.ndarray, "num_models num_candidates"], taken: Mapping[int, int]
) -> dict[int, float]:
    """Per assigned toy: what the cheapest exchange with another one would cost."""
    chosen = cost[np.ix_(list(taken), list(taken.values()))]
    own = np.diag(chosen)
    exchanged = chosen + chosen.T - own - own[:, None]
    np.fill_diagonal(exchanged, np.inf)
    return dict(zip(taken, exchanged.min(axis=1, initial=np.inf).tolist(), strict=True))


def _doubt(model: ObjectModel, margin_m: float) -> str | None:
    if margin_m >= MIN_MARGIN_M:
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
