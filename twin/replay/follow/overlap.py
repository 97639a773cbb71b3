"""Objects that were localised into each other: small overlaps are resolved, large ones refused.

Physics answers an overlap with a kick, and what follows says nothing about the plan.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import coal
import numpy as np
from jaxtyping import Float

from twin.physics.soft import SoftModel
from twin.replay.clearance.bodies import placed_panels, placement_of
from twin.replay.failure import NotEvaluatedError
from twin.replay.follow.furnish import outline_m
from twin.replay.place.scene import ReplayScene
from twin.robot.collision import signed_distance
from twin.robot.hulls import convex_hull

GAP_M = 0.0002
"""What was moved apart stays this far apart."""
TOUCH_M = 0.0005
"""Overlaps up to this are what contact looks like."""
SOFT_SHARE = 2.0
"""A soft body may overlap so many times as deep: at rest it was pressed together, and its hull
covers more than itself."""
ROUNDS = 6


@dataclass(frozen=True)
class _Solid:
    name: str
    shape: coal.CollisionGeometry
    T: Float[np.ndarray, "4 4"]
    soft: bool = False
    still: bool = False


def free_start(
    scene: ReplayScene, soft: Mapping[str, SoftModel], max_depth_m: float
) -> ReplayScene:
    """Move objects apart that lie in each other or in a container by little.

    The object that can move is moved, along the direction of least depth; of two, each by half.
    Objects are their convex hulls. The table is left to ``furnish``, which lifts what reaches in.

    Args:
        scene: Where the objects were localised.
        soft: The soft ones' bodies.
        max_depth_m: Deeper overlaps of rigid objects are refused.

    Raises:
        NotEvaluatedError: Naming both objects and the depth.
    """
    movable = scene.movable()
    shapes = {
        name: convex_hull(outline_m(scene.task.objects[name], soft.get(name))) for name in movable
    }
    still = _still(scene)
    moved = {name: T.copy() for name, T in movable.items()}
    for _ in range(ROUNDS):
        solids = [_Solid(n, shapes[n], T, soft=n in soft) for n, T in moved.items()]
        if not _apart(solids, still, moved, max_depth_m):
            break
    else:
        names = ", ".join(moved)
        raise NotEvaluatedError(f"the objects ({names}) start in each other and cannot be parted")
    return replace(scene, Ts_base_object={**scene.Ts_base_object, **moved})


def _apart(
    solids: list[_Solid],
    still: list[_Solid],
    moved: dict[str, Float[np.ndarray, "4 4"]],
    max_depth_m: float,
) -> bool:
    """One round; says whether anything had to be moved."""
    anything = False
    for index, solid in enumerate(solids):
        for other in [*still, *solids[index + 1 :]]:
            depth, normal = _overlap(solid, other)
            if depth <= TOUCH_M:
                continue
            limit = max_depth_m * (SOFT_SHARE if solid.soft or other.soft else 1.0)
            if depth > limit:
                raise NotEvaluatedError(
                    f"{solid.name} starts {depth * 1e3:.0f} mm inside {other.name}; up to "
                    f"{limit * 1e3:.0f} mm are moved apart. Localise them again, or look whether "
                    "one hides the other"
                )
            share = 1.0 if other.still else 0.5
            moved[solid.name][:3, 3] -= share * (depth + GAP_M) * normal
            if not other.still:
                moved[other.name][:3, 3] += share * (depth + GAP_M) * normal
            anything = True
    return anything


def _still(scene: ReplayScene) -> list[_Solid]:
    return [
        _Solid(name, coal.Box(*extents), T_base_panel, still=True)
        for name, T in scene.containers().items()
        for T_base_panel, extents in placed_panels(scene.task.objects[name], T)
    ]


def _overlap(first: _Solid, second: _Solid) -> tuple[float, Float[np.ndarray, "3"]]:
    """Depth, negative when apart, and the direction from the first into the second."""
    result = coal.DistanceResult()
    distance = signed_distance(
        first.shape, placement_of(first.T), second.shape, placement_of(second.T), result
    )
    normal = np.array(result.normal, dtype=np.float64)
    length = float(np.linalg.norm(normal))
    return -distance, normal / length if length > 0 else np.array([0.0, 0.0, -1.0])
