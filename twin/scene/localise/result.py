"""What localisation says of one object: its pose with how sure it is, or why there is none."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float

from bridge.geometry import se3
from bridge.task.record import check_record
from bridge.task.task_file import SCANNED, ObjectModel
from twin.scene.localise.mesh_fit import MeshFit
from twin.scene.shape.known import pose_of, rectangle_yaw_rad, surface_distances, turned_alike

SCHEMA_VERSION = 1
METHOD = "colour_shape_fit"
MESH_METHOD = "colour_mesh_icp"
BOX_METHOD = "colour_box"
BOXED_M = 0.01
"""A point of a thing that is only boxed in lies this near to the box."""
REST_TOLERANCE_M = 0.005
"""Nearer than this to standing on the table counts as standing on it."""
UPRIGHT = 0.98
"""Cosine of the tilt up to which an object stands."""


@dataclass(frozen=True, kw_only=True)
class LocalisedObject:
    """One object's pose, or the reason why there is none."""

    object_id: str
    T_base_object: Float[np.ndarray, "4 4"] | None = None
    """None: it was not found."""
    covariance: Float[np.ndarray, "6 6"] | None = None
    """Of (x, y, z, rotation about x, y, z), base frame [m^2, m rad, rad^2]."""
    confidence: float
    """0 to 1: the share of points and outline that the fitted shape explains."""
    method: str
    reason: str | None
    stamp_ns: int
    symmetry: str = "none"
    detail: Mapping[str, Any] = field(default_factory=dict)
    """Numbers behind the pose: points, residuals, what the table said of the cameras."""

    @property
    def found(self) -> bool:
        """Whether its pose is known."""
        return self.T_base_object is not None

    def to_record(self) -> dict[str, Any]:
        """Return the gst localisation v1 record, checked against its schema."""
        T = self.T_base_object
        record = {
            "schema_version": SCHEMA_VERSION,
            "stamp_ns": self.stamp_ns,
            "object": self.object_id,
            "found": self.found,
            "T_base_object": None if T is None else se3.pose_record(T),
            "covariance": None if self.covariance is None else self.covariance.ravel().tolist(),
            "symmetry": self.symmetry,
            "confidence": self.confidence,
            "method": self.method,
            "reason": self.reason,
            **self.detail,
        }
        check_record(record, name="localisation")
        return record


def missing(
    model: ObjectModel, stamp_ns: int, reason: str, detail: Mapping[str, Any]
) -> LocalisedObject:
    """Say why an object was not found."""
    method = METHOD if model.mesh is None else MESH_METHOD
    return _of(model, stamp_ns, detail, confidence=0.0, method=method, reason=reason)


def _of(
    model: ObjectModel, stamp_ns: int, detail: Mapping[str, Any], **found: Any
) -> LocalisedObject:
    return LocalisedObject(
        object_id=model.id, symmetry=model.symmetry, stamp_ns=stamp_ns, detail=detail, **found
    )


def found_by_fit(
    model: ObjectModel, fit: MeshFit, stamp_ns: int, detail: dict[str, Any]
) -> LocalisedObject:
    """Turn a fitted mesh or shape into a result; what nearly stands on the table stands on it."""
    T = fit.T_base_object.copy()
    lift_m = float(T[2, 3]) - model.rest_height_m
    detail |= {"residual_m": fit.residual_m, "lift_m": lift_m}
    detail["seen_through_fraction"] = fit.seen_through
    confidence = fit.explained * (1 - fit.seen_through)
    method = METHOD if model.mesh is None and model.shape != SCANNED else MESH_METHOD
    is_upright = bool(T[2, 2] > UPRIGHT)
    if model.soft is None and is_upright:
        T = turned_alike(T, np.eye(4), model)
    reason = None
    if is_upright and abs(lift_m) <= REST_TOLERANCE_M:
        T[2, 3] = model.rest_height_m
    else:
        tilt = np.degrees(np.arccos(np.clip(T[2, 2], -1, 1)))
        reason = (
            f"{model.id} is {lift_m * 1e3:+.0f} mm from standing on the table, "
            f"tilted by {tilt:.0f} degrees"
        )
    sure = {"covariance": fit.covariance, "confidence": confidence}
    return _of(model, stamp_ns, detail, T_base_object=T, method=method, reason=reason, **sure)


def found_by_box(
    model: ObjectModel,
    points: Float[np.ndarray, "num_points 3"],
    stamp_ns: int,
    detail: dict[str, Any],
) -> LocalisedObject:
    """Box in a thing whose shape nobody knows yet; it stands on the table.

    The box of the stated size lies over the middle of the points, along the smallest rectangle
    around them. Its frame is a name for the place, good enough to reconstruct the thing in: which
    side is the front is whatever came out.
    """
    yaw = rectangle_yaw_rad(points[:, :2])
    c, s = np.cos(yaw), np.sin(yaw)
    local = points[:, :2] @ np.array([[c, -s], [s, c]])
    low, high = np.percentile(local, [1, 99], axis=0)
    if (high - low)[0] < (high - low)[1] and model.size_m[0] > model.size_m[1]:
        yaw += np.pi / 2
    u, v = (low + high) / 2
    T = pose_of(np.array([c * u - s * v, s * u + c * v, model.rest_height_m, yaw]))
    away, _ = surface_distances(points, model, T)
    half = np.array([*(high - low) / 2, model.size_m[2] / 2])
    spread = np.concatenate([half / 4, np.array([0.02, 0.02, 0.3])])
    sure = {"covariance": np.diag(np.square(spread)), "confidence": float((away < BOXED_M).mean())}
    reason = f"the shape of {model.id} is not known yet: only boxed in"
    return _of(model, stamp_ns, detail, T_base_object=T, method=BOX_METHOD, reason=reason, **sure)
