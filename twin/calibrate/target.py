"""A camera found from pose pairs of a target: in the hand, or fixed with the target in the hand."""

from dataclasses import dataclass

from bridge.geometry import se3
from twin.calibrate.config import Mount
from twin.calibrate.pairs import PosePairs
from twin.calibrate.robot_world import RobotWorld, UndeterminedCameraError, solve

CLEARLY = 3.0
"""One explanation of the pairs beats the other when its misfit is this many times smaller."""
MAX_RESIDUAL_M = 0.02
MAX_RESIDUAL_RAD = 0.05
"""Pairs that disagree by more belong to no one mounting."""


@dataclass(frozen=True, kw_only=True)
class TargetCamera:
    """What was found, and how the camera is mounted."""

    solution: RobotWorld
    mount: Mount
    """``hand`` or ``fixed``."""


def find_camera(pairs: PosePairs, mount: Mount, *, seed: int = 0) -> TargetCamera:
    """Find a camera from pose pairs; says so when the pairs belong to the other mounting.

    With the camera in the hand X is ``T_effector_camera`` and Z is ``T_base_target``; with a fixed
    camera X is ``T_effector_target`` and Z is ``T_base_camera``.

    Raises:
        UndeterminedCameraError: Too few pairs, rotations about one axis only, pairs that fit
            neither mounting, or that fit the other one than was asked for.
    """
    found = {name: _solve(pairs, name, seed) for name in ("hand", "fixed")}
    size = {name: item.solution.residual_m.value for name, item in found.items()}
    best = "hand" if size["hand"] <= size["fixed"] else "fixed"
    other = "fixed" if best == "hand" else "hand"
    if mount == "auto" and size[other] < CLEARLY * size[best]:
        message = (
            f"the {len(pairs)} pose pairs of {pairs.source} fit a camera in the hand to "
            f"{size['hand'] * 1e3:.1f} mm and a fixed one to {size['fixed'] * 1e3:.1f} mm, which "
            "does not tell them apart. Say which: --mount hand or --mount fixed."
        )
        raise UndeterminedCameraError(message)
    chosen = best if mount == "auto" else mount
    if chosen != best and size[chosen] > CLEARLY * size[best]:
        message = (
            f"the pose pairs of {pairs.source} miss a camera mounted {chosen!r} by "
            f"{size[chosen] * 1e3:.1f} mm and fit {best!r} to {size[best] * 1e3:.1f} mm. Say "
            f"--mount {best}, or invert the target poses: T_camera_target is wanted."
        )
        raise UndeterminedCameraError(message)
    return _believable(found[chosen], pairs)


def _solve(pairs: PosePairs, mount: Mount, seed: int) -> TargetCamera:
    seen = pairs.Ts_camera_target
    Ts_b = se3.invert(seen) if mount == "hand" else seen
    return TargetCamera(solution=solve(pairs.Ts_base_effector, Ts_b, seed=seed), mount=mount)


def _believable(found: TargetCamera, pairs: PosePairs) -> TargetCamera:
    metres, turn = found.solution.residual_m.value, found.solution.residual_rad.value
    if metres > MAX_RESIDUAL_M or turn > MAX_RESIDUAL_RAD:
        message = (
            f"the pose pairs of {pairs.source} disagree by {metres * 1e3:.0f} mm and "
            f"{turn * 57.3:.1f} degrees (median): they come from different instants, another link "
            "or a target that moved. Check --link, and that robot and target stood still."
        )
        raise UndeterminedCameraError(message)
    return found
