"""Laws of AX = XB and AX = ZB; references: known truth, OpenCV."""

import json
import os
from pathlib import Path

import numpy as np
import pytest

from bridge.geometry import se3
from twin.calibrate import hand_eye
from twin.calibrate.hand_eye import PosePairs

SHARED = Path(os.environ.get("GST_SHARED_DATA", Path(__file__).parents[4] / "shared" / "data"))
MOVEIT = SHARED / "handeye_moveit_samples" / "pose_samples.json"


def transform(rng: np.random.Generator, metres: float = 1.0, radians: float = 1.0) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = se3.rotation_from_vector(rng.normal(size=3) * radians)
    T[:3, 3] = rng.normal(size=3) * metres
    return T


def made_pairs(
    seed: int, count: int, *, metres: float = 0.0, radians: float = 0.0
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """A, B, X, Z with A X = Z B up to noise on B."""
    rng = np.random.default_rng(seed)
    X, Z = transform(rng, 0.1), transform(rng)
    Ts_a = np.array([transform(rng, 0.3, 0.5) for _ in range(count)])
    noise = np.array([transform(rng, metres, radians) for _ in range(count)])
    Ts_b = se3.invert(Z) @ Ts_a @ X @ noise
    return Ts_a, Ts_b, X, Z


def distance(T_a: np.ndarray, T_b: np.ndarray) -> float:
    return float(np.linalg.norm(T_a[:3, 3] - T_b[:3, 3]))


def angle(T_a: np.ndarray, T_b: np.ndarray) -> float:
    return float(se3.rotation_angle_rad(T_a[:3, :3].T @ T_b[:3, :3]))


@pytest.mark.parametrize("seed", range(5))
def test_exact_pairs_give_the_exact_answer_by_the_closed_form(seed: int) -> None:
    Ts_a, Ts_b, X, _ = made_pairs(seed, 6)
    np.testing.assert_allclose(hand_eye.solve_hand_eye(Ts_a, Ts_b), X, atol=1e-9)


def test_the_error_shrinks_with_the_number_of_pairs() -> None:
    errors = {
        count: np.median(
            [
                distance(hand_eye.solve(*made[:2]).X, made[2])
                for made in (made_pairs(s, count, metres=2e-3, radians=2e-3) for s in range(5))
            ]
        )
        for count in (6, 64)
    }
    assert errors[64] < 0.5 * errors[6]
    assert errors[64] < 1e-3


def test_the_choice_of_base_frame_changes_only_what_lies_in_it() -> None:
    Ts_a, Ts_b, _, _ = made_pairs(1, 12, metres=1e-3, radians=1e-3)
    G = transform(np.random.default_rng(9))
    before, after = hand_eye.solve(Ts_a, Ts_b), hand_eye.solve(G @ Ts_a, Ts_b)
    np.testing.assert_allclose(after.X, before.X, atol=1e-8)
    np.testing.assert_allclose(after.Z, G @ before.Z, atol=1e-8)
    assert after.residual_m == pytest.approx(before.residual_m, rel=1e-6)


def test_wrong_pairs_are_counted_and_have_no_say() -> None:
    Ts_a, Ts_b, X, _ = made_pairs(5, 30, metres=5e-4, radians=5e-4)
    clean = hand_eye.solve(Ts_a, Ts_b)
    rng = np.random.default_rng(0)
    for index in range(6):
        Ts_b[index] = Ts_b[index] @ transform(rng, 0.2, 0.5)
    dirty = hand_eye.solve(Ts_a, Ts_b)
    assert dirty.num_outliers == 6
    assert clean.num_outliers == 0
    assert distance(dirty.X, X) < 2 * distance(clean.X, X) + 3e-4


def test_it_knows_how_wrong_the_position_is() -> None:
    found, missed = [], []
    for seed in range(12):
        Ts_a, Ts_b, X, _ = made_pairs(seed + 50, 20, metres=2e-3, radians=2e-3)
        solution = hand_eye.solve(Ts_a, Ts_b)
        found.append(solution.sigma_m)
        missed.append(distance(solution.X, X))
    ratio = float(np.sqrt(np.mean(np.square(missed)) / np.mean(np.square(found))))
    assert 0.5 < ratio < 2.0


def about_one_axis(count: int, wobble_rad: float) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    turns = np.outer(np.linspace(-1.0, 1.0, count), [0, 0, 1])
    Ts_a = np.tile(np.eye(4), (count, 1, 1))
    Ts_a[:, :3, :3] = se3.rotation_from_vector(turns + rng.normal(size=turns.shape) * wobble_rad)
    Ts_a[:, :3, 3] = rng.normal(size=(count, 3)) * 0.2
    X, Z = transform(rng, 0.1), transform(rng)
    return Ts_a, se3.invert(Z) @ Ts_a @ X


def test_turning_about_one_axis_is_refused_and_about_two_is_not() -> None:
    with pytest.raises(hand_eye.UndeterminedCameraError, match=r"one axis only.*Tilt the tool"):
        hand_eye.solve(*about_one_axis(15, 0.002))
    assert hand_eye.solve(*about_one_axis(15, 0.2)).residual_m < 1e-6


@pytest.mark.parametrize(("count", "found"), [(8, "does not turn at all"), (3, r"3 pair\(s\)")])
def test_too_few_pairs_and_turns_are_refused(count: int, found: str) -> None:
    Ts_a, Ts_b, _, _ = made_pairs(0, count)
    Ts_a[:, :3, :3] = np.eye(3)
    with pytest.raises(hand_eye.UndeterminedCameraError, match=found):
        hand_eye.solve(Ts_a, Ts_b)


def pairs_of(Ts_a: np.ndarray, Ts_b: np.ndarray) -> PosePairs:
    return PosePairs(Ts_base_effector=Ts_a, Ts_camera_target=Ts_b, source="made up")


@pytest.mark.parametrize("mount", ["hand", "fixed"])
def test_the_mounting_is_found_and_the_wrong_one_is_refused(mount: str) -> None:
    Ts_a, Ts_b, X, Z = made_pairs(4, 15, metres=5e-4, radians=5e-4)
    pairs = pairs_of(Ts_a, se3.invert(Ts_b) if mount == "hand" else Ts_b)
    found, chosen = hand_eye.find_camera(pairs, "auto")
    assert chosen == mount
    assert distance(found.X, X) < 2e-3
    assert distance(found.Z, Z) < 4e-3
    other = "fixed" if mount == "hand" else "hand"
    with pytest.raises(hand_eye.UndeterminedCameraError, match=f"--mount {mount}, or invert"):
        hand_eye.find_camera(pairs, other)  # type: ignore[arg-type]


@pytest.mark.parity
@pytest.mark.skipif(not MOVEIT.is_file(), reason="shared data is not here (GST_SHARED_DATA)")
def test_opencv_finds_the_same_camera_in_recorded_pairs() -> None:
    cv2 = pytest.importorskip("cv2")
    if not hasattr(cv2, "calibrateHandEye"):
        pytest.skip("this OpenCV has no calibrateHandEye (the main module of version 5 lacks it)")
    A, B = np.moveaxis(np.array(json.loads(MOVEIT.read_text())), 1, 0)
    found, mount = hand_eye.find_camera(pairs_of(A, B), "auto")
    Ts_seen = B if mount == "hand" else se3.invert(B)
    R, t = cv2.calibrateHandEye(
        A[:, :3, :3], A[:, :3, 3], Ts_seen[:, :3, :3], Ts_seen[:, :3, 3],
        method=cv2.CALIB_HAND_EYE_PARK,
    )  # fmt: skip
    theirs = np.eye(4)
    theirs[:3, :3], theirs[:3, 3] = R, t[:, 0]
    Ts_b = se3.invert(Ts_seen)
    ours = hand_eye.solve_hand_eye(A, Ts_b)
    assert distance(ours, theirs) < 5e-4
    assert angle(ours, theirs) < 1e-3
    assert distance(found.X, theirs) < 5e-3
    assert angle(found.X, theirs) < 5e-3
