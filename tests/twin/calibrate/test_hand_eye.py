"""Laws of AX = XB and AX = ZB; references: known truth, finite differences, OpenCV."""

import json
from pathlib import Path

import numpy as np
import pytest

from bridge.errors import PathNotFoundError, UsageError
from bridge.geometry import se3
from twin.calibrate.hand_eye import (
    UndeterminedCameraError,
    find_camera,
    solve,
    solve_hand_eye,
)
from twin.calibrate.pairs import PosePairs, read_pairs


def transform(rng: np.random.Generator, metres: float = 1.0, radians: float = 1.0) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = se3.rotation_from_vector(rng.normal(size=3) * radians)
    T[:3, 3] = rng.normal(size=3) * metres
    return T


def made_pairs(
    seed: int, count: int, *, metres: float = 0.0, radians: float = 0.0
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
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
    np.testing.assert_allclose(solve_hand_eye(Ts_a, Ts_b), X, atol=1e-9)


def test_the_error_shrinks_with_the_number_of_pairs() -> None:
    errors = {
        count: np.median(
            [
                distance(solve(*made[:2]).X, made[2])
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
    before, after = solve(Ts_a, Ts_b), solve(G @ Ts_a, Ts_b)
    np.testing.assert_allclose(after.X, before.X, atol=1e-8)
    np.testing.assert_allclose(after.Z, G @ before.Z, atol=1e-8)
    assert after.residual_m.value == pytest.approx(before.residual_m.value, rel=1e-6)


def test_wrong_pairs_are_counted_and_have_no_say() -> None:
    Ts_a, Ts_b, X, _ = made_pairs(5, 30, metres=5e-4, radians=5e-4)
    clean = solve(Ts_a, Ts_b)
    rng = np.random.default_rng(0)
    for index in range(6):
        Ts_b[index] = Ts_b[index] @ transform(rng, 0.2, 0.5)
    dirty = solve(Ts_a, Ts_b)
    assert dirty.num_outliers == 6
    assert clean.num_outliers == 0
    assert distance(dirty.X, X) < 2 * distance(clean.X, X) + 3e-4


def test_the_bootstrap_knows_how_wrong_the_position_is() -> None:
    found, missed = [], []
    for seed in range(12):
        Ts_a, Ts_b, X, _ = made_pairs(seed + 50, 20, metres=2e-3, radians=2e-3)
        solution = solve(Ts_a, Ts_b)
        found.append(solution.x_sigma_m)
        missed.append(distance(solution.X, X))
        assert solution.residual_m.low <= solution.residual_m.value <= solution.residual_m.high
    ratio = float(np.sqrt(np.mean(np.square(missed)) / np.mean(np.square(found))))
    assert 0.5 < ratio < 2.0


def about_one_axis(count: int, wobble_rad: float) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    Ts = []
    for turn in np.linspace(-1.0, 1.0, count):
        T = np.eye(4)
        T[:3, :3] = se3.rotation_from_vector(
            np.array([0, 0, turn]) + rng.normal(size=3) * wobble_rad
        )
        T[:3, 3] = rng.normal(size=3) * 0.2
        Ts.append(T)
    Ts_a = np.array(Ts)
    X, Z = transform(rng, 0.1), transform(rng)
    return Ts_a, se3.invert(Z) @ Ts_a @ X


def test_turning_about_one_axis_is_refused_and_about_two_is_not() -> None:
    with pytest.raises(UndeterminedCameraError, match=r"one axis only.*Tilt the tool"):
        solve(*about_one_axis(15, 0.002))
    assert solve(*about_one_axis(15, 0.2)).residual_m.value < 1e-6


def test_not_turning_at_all_is_refused() -> None:
    Ts_a, Ts_b, _, _ = made_pairs(0, 8)
    Ts_a[:, :3, :3] = np.eye(3)
    with pytest.raises(UndeterminedCameraError, match="does not turn at all"):
        solve(Ts_a, Ts_b)


def test_too_few_pairs_are_refused() -> None:
    Ts_a, Ts_b, _, _ = made_pairs(0, 3)
    with pytest.raises(UndeterminedCameraError, match=r"3 pair\(s\)"):
        solve(Ts_a, Ts_b)


def pairs_of(Ts_a: np.ndarray, Ts_b: np.ndarray) -> PosePairs:
    return PosePairs(Ts_base_effector=Ts_a, Ts_camera_target=Ts_b, source="made up")


@pytest.mark.parametrize("mount", ["hand", "fixed"])
def test_the_mounting_is_found_and_the_wrong_one_is_refused(mount: str) -> None:
    Ts_a, Ts_b, X, Z = made_pairs(4, 15, metres=5e-4, radians=5e-4)
    pairs = pairs_of(Ts_a, se3.invert(Ts_b) if mount == "hand" else Ts_b)
    found = find_camera(pairs, "auto")
    assert found.mount == mount
    assert distance(found.solution.X, X) < 2e-3
    assert distance(found.solution.Z, Z) < 4e-3
    other = "fixed" if mount == "hand" else "hand"
    with pytest.raises(UndeterminedCameraError, match=f"--mount {mount}, or invert"):
        find_camera(pairs, other)  # type: ignore[arg-type]


def test_a_file_holds_the_pairs_that_were_written(tmp_path: Path) -> None:
    Ts_a, Ts_b, _, _ = made_pairs(0, 5)
    (tmp_path / "pairs.json").write_text(json.dumps(np.stack([Ts_a, Ts_b], axis=1).tolist()))
    found = read_pairs(tmp_path / "pairs.json")
    np.testing.assert_allclose(found.Ts_base_effector, Ts_a, atol=1e-12)
    np.testing.assert_allclose(found.Ts_camera_target, Ts_b, atol=1e-12)


@pytest.mark.parametrize(
    ("name", "text", "found"),
    [
        ("p.json", "{", "no pose pairs"),
        ("p.json", "{}", "no pose pairs"),
        ("p.json", "[[1, 2]]", "no pose pairs"),
        ("p.csv", "a,b\n1,2\n", "no pose pairs"),
        ("p.json", json.dumps([[np.eye(4).tolist(), (2 * np.eye(4)).tolist()]]), "pair 1"),
        ("p.json", json.dumps([[np.eye(4).tolist(), np.full((4, 4), np.nan).tolist()]]), "pair 1"),
        ("p.json", json.dumps([[np.diag([1, 1, -1, 1]).tolist(), np.eye(4).tolist()]]), "T_base"),
    ],
)
def test_a_file_without_pose_pairs_is_refused(
    tmp_path: Path, name: str, text: str, found: str
) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(UsageError, match=found):
        read_pairs(tmp_path / name)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(PathNotFoundError, match="nowhere"):
        read_pairs(tmp_path / "nowhere.json")


def least_squares(Ts_a: np.ndarray, Ts_b: np.ndarray) -> np.ndarray:
    """X of AX = ZB by SciPy, from unknowns and residuals of another kind than ours."""
    from scipy.optimize import least_squares as minimise
    from scipy.spatial.transform import Rotation

    def unpacked(values: np.ndarray) -> np.ndarray:
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = Rotation.from_rotvec(values[:3]).as_matrix(), values[3:]
        return T

    def residual(values: np.ndarray) -> np.ndarray:
        return (Ts_a @ unpacked(values[:6]) - unpacked(values[6:]) @ Ts_b)[:, :3].ravel()

    X = solve_hand_eye(Ts_a, Ts_b)
    Z = Ts_a[0] @ X @ se3.invert(Ts_b[0])
    start = [[Rotation.from_matrix(T[:3, :3]).as_rotvec(), T[:3, 3]] for T in (X, Z)]
    return unpacked(minimise(residual, np.ravel(start)).x[:6])


@pytest.mark.parity
@pytest.mark.parametrize("seed", [0, 1])
def test_scipy_finds_the_same_camera_in_noisy_pairs(seed: int) -> None:
    Ts_a, Ts_b, X, _ = made_pairs(seed, 40, metres=1e-3, radians=1e-3)
    theirs, ours = least_squares(Ts_a, Ts_b), solve(Ts_a, Ts_b).X
    assert distance(ours, theirs) < max(distance(theirs, X), 3e-4)
    assert angle(ours, theirs) < 1e-3
