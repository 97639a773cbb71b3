"""Live one case through: the recorded arm, the commanded gripper, and parameters to be judged.

Only the gripper collides: the arm's own shapes touch nothing in a probe, and leaving them out makes
an evaluation several times quicker.
"""

import xml.etree.ElementTree as ET
from collections.abc import Mapping
from functools import lru_cache

import numpy as np
from jaxtyping import Float

from bridge.task.predicate import Rollout, all_hold, evaluate_success
from bridge.task.robot import GRIPPER_LINKS
from twin.calibrate.physics.case import Case, Prediction, planar
from twin.calibrate.physics.parameters import BIAS, MASS_SCALE, apply_values, shifted
from twin.physics.config import PhysicsConfig
from twin.physics.world import World
from twin.robot.description import parse_description

SETTLE_S = 0.6
"""The robot stands still for this long before the final state is read, or until all lies still."""
REST_S, REST = 0.05, 2e-5
"""Whatever moves or turns by less [m and quaternion] in this time lies still."""
TAIL_HZ = 60
SAMPLE_STREAM = 606


def predict(
    case: Case, values: Mapping[str, float], config: PhysicsConfig, num_samples: int
) -> Prediction:
    """Say what a case would have shown if the parameters were these.

    The nominal start gives settled poses and widths. For a trial that was judged, noisy starts, the
    same for all parameters (common random numbers), give the share that succeeds.

    Args:
        case: What the robot did, and where the objects were.
        values: By name; what is missing counts as nominal.
        config: Everything that is not a parameter.
        num_samples: Noisy starts of a judged trial.
    """
    physics = apply_values(values, config)
    nominal = _live(case, values, physics, np.zeros((len(case.objects), 3)))
    success = float("nan")
    if case.success is not None and num_samples > 0:
        seed = int(case.sha256[:15] or "0", 16)
        rng = np.random.default_rng([SAMPLE_STREAM, seed])
        results = []
        for _ in range(num_samples):
            noise = np.stack(
                [rng.multivariate_normal(np.zeros(3), C) for C in case.start_covariance]
            )
            results.append(_live(case, values, physics, noise).success)
        success = float(np.mean(results))
    return Prediction(settled=nominal.settled, held_widths_m=nominal.held_widths_m, success=success)


def _live(
    case: Case,
    values: Mapping[str, float],
    physics: PhysicsConfig,
    noise: Float[np.ndarray, "num_objects 3"],
) -> Prediction:
    rate = physics.rate_hz
    steps = int(np.ceil(case.stretches_s[-1, 1] * rate))
    times_s = np.arange(steps + 1) / rate
    targets = np.stack(
        [np.interp(times_s, case.joint_times_s, column) for column in case.joints_rad.T], axis=1
    )
    velocities = np.diff(targets, axis=0) * rate
    index = np.searchsorted(case.width_times_s, times_s, side="right") - 1
    widths = case.width_commands_m[np.clip(index, 0, None)]
    holds = np.rint(case.hold_times_s * rate).astype(int)
    bias = np.array([values.get(name, 0.0) for name in BIAS])
    held: dict[int, float] = {}
    statics = {
        key: shifted(T, bias) for key, T in case.Ts_base_start.items() if key not in case.objects
    }
    with World(gripper_only(case.urdf), {}, physics) as world:
        _furnish(world, case, values, statics, bias + noise)
        for begin_s, end_s in case.stretches_s:
            first, last = int(begin_s * rate), min(int(np.ceil(end_s * rate)), steps)
            world.reset_robot(targets[first], float(widths[first]))
            for step in range(first, last):
                world.command(targets[step + 1], velocities[step], float(widths[step]))
                world.step()
                if step in holds:
                    held[step] = world.width_m()
        success = _settle(world, case, statics, targets[-1], float(widths[-1]))
        settled = np.stack([planar(world.T_base_object(key)) for key in case.objects])
    return Prediction(
        settled=settled - bias,
        held_widths_m=np.array([held[int(step)] for step in holds], dtype=np.float64),
        success=success,
    )


def _furnish(
    world: World,
    case: Case,
    values: Mapping[str, float],
    statics: Mapping[str, Float[np.ndarray, "4 4"]],
    shifts: Float[np.ndarray, "num_objects 3"],
) -> None:
    world.add_table(0.0)
    for key, T in statics.items():
        world.add_static(case.task.objects[key].panels(), T)
    for key, shift in zip(case.objects, shifts, strict=True):
        model = case.task.objects[key]
        mass_kg = model.mass_kg * values.get(MASS_SCALE, 1.0)
        world.add_free(
            key, np.array(model.size_m), mass_kg, shifted(case.Ts_base_start[key], shift)
        )


def _settle(
    world: World,
    case: Case,
    statics: Mapping[str, Float[np.ndarray, "4 4"]],
    joints_rad: Float[np.ndarray, " num_joints"],
    width_m: float,
) -> float:
    """Let things come to rest, and say whether the task's goal holds then."""
    rate = world.config.rate_hz
    stamps: list[int] = []
    poses: dict[str, list[Float[np.ndarray, "4 4"]]] = {key: [] for key in case.objects}
    touches: dict[str, list[bool]] = {key: [] for key in case.objects}
    still = np.zeros(len(joints_rad))
    before: Float[np.ndarray, "num_objects 7"] | None = None
    for step in range(round(SETTLE_S * rate)):
        world.command(joints_rad, still, width_m)
        world.step()
        if case.success is None and step % round(REST_S * rate) == 0:
            now = np.array([world.object_pose(key) for key in case.objects])
            if before is not None and np.abs(now - before).max() < REST:
                break
            before = now
        if case.success is not None and step % (rate // TAIL_HZ) == 0:
            stamps.append(round(step * 1e9 / rate))
            for key in case.objects:
                poses[key].append(world.T_base_object(key))
                touches[key].append(world.finger_touches(key))
    if case.success is None:
        return float("nan")
    fixed = {key: np.repeat(T[None], len(stamps), axis=0) for key, T in statics.items()}
    rollout = Rollout(
        stamps_ns=np.array(stamps, dtype=np.int64),
        Ts_base_object={**{key: np.array(Ts) for key, Ts in poses.items()}, **fixed},
        finger_contact={key: np.array(rows, dtype=bool) for key, rows in touches.items()},
    )
    return float(all_hold(evaluate_success(case.task, rollout)) is True)


@lru_cache(maxsize=4)
def gripper_only(urdf: str) -> str:
    """Leave only the gripper's collision shapes in a description, and no pictures."""
    root = parse_description(urdf)
    for link in root.findall("link"):
        drop = ["visual"] if link.get("name") in GRIPPER_LINKS else ["visual", "collision"]
        for tag in drop:
            for element in link.findall(tag):
                link.remove(element)
    return ET.tostring(root, encoding="unicode")
