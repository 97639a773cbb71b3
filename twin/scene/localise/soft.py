"""Soft toys, also several equal ones: what is left beside the rigid objects, fitted and assigned.

A toy is laid out by its mesh at rest; how far its extents then differ is what its softness did.
Equal toys are told apart by where each is expected: its start range, or where it was last seen
(assignment of least total cost, Kuhn 1955).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy.optimize import linear_sum_assignment

from bridge.task.task_file import ObjectModel
from twin.scene.localise.candidates import candidates
from twin.scene.localise.colour import ColourConfig
from twin.scene.localise.fit import FitConfig
from twin.scene.localise.mesh import MeshFit, MeshFitConfig, fit_mesh
from twin.scene.localise.points import Cluster, PointConfig, View
from twin.scene.localise.soft_config import SoftConfig
from twin.scene.localise.soft_shape import SoftShape, soft_shape
from twin.scene.localise.surface import Surface, agreeing, known_surface


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
    views: Sequence[View],
    blocked: Mapping[ObjectModel, Float[np.ndarray, "4 4"]],
    expected_m: Mapping[str, Float[np.ndarray, "3"]],
    *,
    points: PointConfig,
    colour: ColourConfig,
    fit: FitConfig,
    mesh: MeshFitConfig,
    soft: SoftConfig,
    min_explained: float,
) -> dict[str, SoftFit]:
    """Find toys that all look the same.

    Args:
        models: Equal but for their ids.
        views: What the cameras saw.
        blocked: Rigid objects that were found, with their poses.
        expected_m: Where each toy is expected, by id; those without are taken as they come.
        points: Which points count.
        colour: Which pixels have the toy's colour.
        fit: Standard errors and bounds.
        mesh: Starts and scores.
        soft: See there.
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
    views: Sequence[View],
    surface: Surface,
    fit: FitConfig,
    mesh: MeshFitConfig,
    soft: SoftConfig,
    *,
    turn: bool,
) -> MeshFit:
    """Lay a toy's mesh onto points, standing first, on its other sides if that explains little.

    Args:
        group: The points.
        views: What the cameras saw.
        surface: The mesh at rest.
        fit: Standard errors and bounds.
        mesh: Starts and scores.
        soft: What explains little.
        turn: Whether to try the other sides at all.
    """
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
