"""Simulate cases: the recorded arm, the commanded gripper, and parameters to be judged.

Only the gripper collides: the arm's own shapes touch nothing in a probe, and leaving them out makes
an evaluation several times quicker.
"""

import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from functools import lru_cache
from types import TracebackType

import numpy as np
from jaxtyping import Float

from bridge.process_pool import Failed, ProcessPool
from bridge.robots.robot import robot_of
from twin.calibrate.physics.cases import Case, Prediction, planar
from twin.calibrate.physics.parameters import (
    BIAS,
    MASS_SCALE,
    PhysicsParameter,
    apply_values,
    shifted,
    values_of,
)
from twin.errors import TwinError
from twin.physics.config import PhysicsConfig
from twin.physics.world import World
from twin.robot.model import parse_description

SETTLE_S = 0.6
"""The robot stands still for this long before the final state is read, or until all lies still."""
REST_S, REST = 0.05, 2e-5
"""Whatever moves or turns by less [m and quaternion] in this time lies still."""


def predict(case: Case, values: Mapping[str, float], config: PhysicsConfig) -> Prediction:
    """Say what a case would have shown if the parameters were these: settled poses and widths.

    Args:
        values: By name; what is missing counts as nominal.
        config: Everything that is not a parameter.
    """
    physics = apply_values(values, config)
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
        _spawn(world, case, values, statics, bias)
        for begin_s, end_s in case.stretches_s:
            first, last = int(begin_s * rate), min(int(np.ceil(end_s * rate)), steps)
            world.reset_robot(targets[first], float(widths[first]))
            for step in range(first, last):
                world.robot.command(targets[step + 1], velocities[step], float(widths[step]))
                world.step()
                if step in holds:
                    held[step] = world.robot.width_m()
        _settle(world, case, targets[-1], float(widths[-1]))
        settled = np.stack([planar(world.T_base_object(key)) for key in case.objects])
    return Prediction(
        settled=settled - bias,
        held_widths_m=np.array([held[int(step)] for step in holds], dtype=np.float64),
    )


def _spawn(
    world: World,
    case: Case,
    values: Mapping[str, float],
    statics: Mapping[str, Float[np.ndarray, "4 4"]],
    shift: Float[np.ndarray, "3"],
) -> None:
    world.add_table(0.0)
    for key, T in statics.items():
        world.add_static(case.task.objects[key].panels(), T)
    for key in case.objects:
        model = case.task.objects[key]
        mass_kg = model.mass_kg * values.get(MASS_SCALE, 1.0)
        world.add_free(
            key, np.array(model.size_m), mass_kg, shifted(case.Ts_base_start[key], shift)
        )


def _settle(
    world: World, case: Case, joints_rad: Float[np.ndarray, " num_joints"], width_m: float
) -> None:
    """Let things come to rest."""
    rate = world.config.rate_hz
    at_rest = np.zeros(len(joints_rad))
    before: Float[np.ndarray, "num_objects 7"] | None = None
    for step in range(round(SETTLE_S * rate)):
        world.robot.command(joints_rad, at_rest, width_m)
        world.step()
        if step % round(REST_S * rate) == 0:
            now = np.array([world.object_pose(key) for key in case.objects])
            if before is not None and np.abs(now - before).max() < REST:
                break
            before = now


@lru_cache(maxsize=4)
def gripper_only(urdf: str) -> str:
    """Leave only the gripper's collision shapes in a description, and no pictures."""
    root, gripper = parse_description(urdf), robot_of(urdf).gripper
    for link in root.findall("link"):
        drop = ["visual"] if link.get("name") in gripper.links else ["visual", "collision"]
        for tag in drop:
            for element in link.findall(tag):
                link.remove(element)
    return ET.tostring(root, encoding="unicode")


Piece = tuple[int, Case, Mapping[str, float], PhysicsConfig]
"""Its number, and what ``predict`` takes."""


class LostPieceError(TwinError):
    """A case could not be simulated, although it was tried again."""


class Evaluator:
    """Predictions of cases at points in units of the prior. A context manager."""

    def __init__(
        self,
        cases: Sequence[Case],
        parameters: Sequence[PhysicsParameter],
        config: PhysicsConfig,
        *,
        workers: int = 1,
    ) -> None:
        """Have processes ready, where there is more than one.

        Args:
            config: Everything that is not a parameter.
        """
        self.cases = list(cases)
        self._parameters = list(parameters)
        self._config = config
        self._pool = ProcessPool(workers) if workers > 1 else None

    def predict(
        self, points: Float[np.ndarray, "num_points num_parameters"], chosen: Sequence[int]
    ) -> list[list[Prediction]]:
        """Predict the chosen cases, by their numbers, at every point.

        Args:
            points: Parameters, in units of the prior.

        Raises:
            LostPieceError: When a case was begun again and its process died again.
        """
        pairs = [(x, index) for x in points for index in chosen]
        pieces = [self._piece(number, *pair) for number, pair in enumerate(pairs)]
        if self._pool is None:
            flat = [_predict(piece) for piece in pieces]
        else:
            flat = _side_by_side(self._pool, pieces)
        size = len(chosen)
        return [flat[k * size : (k + 1) * size] for k in range(len(points))]

    def _piece(self, number: int, x: Float[np.ndarray, " num_parameters"], index: int) -> Piece:
        values = values_of(self._parameters, x)
        return number, self.cases[index], values, self._config

    def __enter__(self) -> "Evaluator":
        """Use as a context manager."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """End the processes; what is being done is lost."""
        if self._pool is not None:
            self._pool.__exit__()


def _side_by_side(pool: ProcessPool, pieces: Sequence[Piece]) -> list[Prediction]:
    """Predict, and put the answers back into order."""
    answers: dict[int, Prediction] = {}
    for (number, case, *_), answer in pool.run(_predict, pieces, _cost):
        if isinstance(answer, Failed):
            raise _error_of(case, answer)
        answers[number] = answer
    return [answers[number] for number in range(len(pieces))]


def _error_of(case: Case, failed: Failed) -> Exception:
    """What to raise, as one process alone would have done; a bug keeps its trace."""
    if not failed.known:
        return RuntimeError(failed.trace)
    return LostPieceError(
        f"{case.episode} could not be simulated: {failed.message}. Nothing was written. Try again, "
        "with fewer --workers."
    )


def _cost(_: Piece) -> float:
    """All take about as long."""
    return 1.0


def _predict(piece: Piece) -> Prediction:
    _, case, values, config = piece
    return predict(case, values, config)
