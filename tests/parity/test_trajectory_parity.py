"""Trajectory errors against evo, angles against SciPy: the same definitions, the same numbers."""

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bridge.geometry.trajectory import PoseTrajectory
from bridge.task.task_file import ObjectModel
from evaluator.metrics.state import turn_between_rad, turns_alike
from evaluator.metrics.trajectory import angles_rad, pose_errors

pytestmark = pytest.mark.parity

TOLERANCE = 1e-9


def motion(seed: int, num: int = 60) -> PoseTrajectory:
    """A smooth random walk in position and orientation."""
    rng = np.random.default_rng(seed)
    p = np.cumsum(rng.normal(scale=0.01, size=(num, 3)), axis=0)
    turns = Rotation.from_rotvec(rng.normal(scale=0.05, size=(num, 3)))
    q = [Rotation.identity()]
    for turn in turns[1:]:
        q.append(q[-1] * turn)
    wxyz = np.stack([each.as_quat(scalar_first=True) for each in q])
    return PoseTrajectory(np.arange(num, dtype=np.int64) * 10_000_000, p, wxyz)


def near(track: PoseTrajectory, seed: int) -> PoseTrajectory:
    """The same motion, disturbed, and with quaternions of either sign."""
    rng = np.random.default_rng(seed)
    turned = Rotation.from_quat(track.q_wxyz, scalar_first=True) * Rotation.from_rotvec(
        rng.normal(scale=0.1, size=(len(track), 3))
    )
    sign = rng.choice([-1.0, 1.0], size=(len(track), 1))
    return PoseTrajectory(
        track.stamps_ns,
        track.p_m + rng.normal(scale=0.02, size=track.p_m.shape),
        turned.as_quat(scalar_first=True) * sign,
    )


def as_evo(track: PoseTrajectory) -> Any:
    from evo.core.trajectory import PoseTrajectory3D

    return PoseTrajectory3D(
        positions_xyz=track.p_m,
        orientations_quat_wxyz=track.q_wxyz,
        timestamps=track.stamps_ns * 1e-9,
    )


@pytest.mark.parametrize("seed", range(5))
def test_absolute_errors_are_those_of_evo(seed: int) -> None:
    metrics = pytest.importorskip("evo.core.metrics")
    recorded = motion(seed)
    replayed = near(recorded, seed + 100)
    found = pose_errors(recorded, replayed)
    for relation, ours in (
        (metrics.PoseRelation.translation_part, found.position_m),
        (metrics.PoseRelation.rotation_angle_rad, found.rotation_rad),
    ):
        ape = metrics.APE(relation)
        ape.process_data((as_evo(recorded), as_evo(replayed)))
        np.testing.assert_allclose(ours, ape.error, atol=TOLERANCE)


def test_angles_are_those_of_scipy() -> None:
    rng = np.random.default_rng(0)
    first, second = (Rotation.random(200, rng=rng) for _ in range(2))
    small = first * Rotation.from_rotvec(rng.normal(scale=1e-7, size=(200, 3)))
    for other in (second, small, first):
        theirs = (first.inv() * other).magnitude()
        ours = angles_rad(first.as_quat(scalar_first=True), -other.as_quat(scalar_first=True))
        np.testing.assert_allclose(ours, theirs, atol=TOLERANCE)


@pytest.mark.parametrize(
    ("size_m", "group"),
    [((0.04, 0.04, 0.04), "O"), ((0.1, 0.1, 0.2), "D4"), ((0.1, 0.2, 0.3), "D2")],
)
def test_turns_that_look_alike_are_scipys_groups(
    size_m: tuple[float, float, float], group: str
) -> None:
    model = ObjectModel(id="x", shape="box", size_m=size_m, color_srgb=(0, 0, 0))
    turns = turns_alike(model)
    theirs = Rotation.create_group(group, axis="Z").as_matrix()
    assert len(turns) == len(theirs)
    for R in theirs:
        assert np.abs(turns - R).max(axis=(1, 2)).min() < TOLERANCE
    rng = np.random.default_rng(1)
    for _ in range(20):
        first, second = Rotation.random(rng=rng), Rotation.random(rng=rng)
        least = min((first.inv() * second * Rotation.from_matrix(R)).magnitude() for R in theirs)
        ours = turn_between_rad(first.as_matrix(), second.as_matrix(), turns)
        assert ours == pytest.approx(least, abs=TOLERANCE)
