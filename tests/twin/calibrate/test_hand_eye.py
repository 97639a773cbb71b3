"""Laws of AX = XB and AX = ZB, and what a tool's motion says of an arm, by known truth.

For the arm that is a truth that moves by rotation matrices multiplied by hand and sags by the
numerical slope of its potential energy; the fit has the same arm from a URDF, through pinocchio.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bridge.errors import UsageError
from bridge.geometry import se3
from twin.calibrate import hand_eye
from twin.calibrate.hand_eye import PosePairs
from twin.calibrate.motion import Arm, Found, Seen, find_motion, stays_alike
from twin.robot.hand import Hand


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


@pytest.mark.parametrize("seed", range(5))
def test_exact_pairs_give_the_exact_answer_by_the_closed_form(seed: int) -> None:
    Ts_a, Ts_b, X, _ = made_pairs(seed, 6)
    found, _ = hand_eye.solve_motions(*hand_eye.motions(Ts_a, Ts_b))
    np.testing.assert_allclose(found, X, atol=1e-9)


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


JOINTS = ("turn", "lift", "bend", "roll")
AXES = "zyyx"
UP_M = (0.1, 0.3, 0.4, 0.2)
"""From each joint to the next, along z where all are zero; the last to the hand."""
LENGTH_M = (0.3, 0.4, 0.2, 0.2)
MASS_KG = (0.0, 3.0, 2.0, 0.5)
"""Of each link, half way to the next joint."""
ZEROS_RAD = np.array([0.0, 0.010, -0.020, 0.0])
COMPLIANCE = np.array([0.0, 0.002, 0.004, 0.0])
T_WORLD_BASE = se3.transform_from(np.array([1.0, 0.0, 0.01, 0.0]), np.array([0.01, -0.02, 0.015]))
T_HAND_TOOL = se3.transform_from(np.array([0.9, 0.1, 0.3, 0.2]), np.array([0.03, 0.02, 0.05]))


def urdf() -> str:
    links = [
        f'<link name="{name}"><inertial><mass value="{mass}"/><origin xyz="0 0 {length / 2}"/>'
        '<inertia ixx="1e-3" iyy="1e-3" izz="1e-3" ixy="0" ixz="0" iyz="0"/></inertial></link>'
        for name, mass, length in zip(
            (*JOINTS[:-1], "hand"), MASS_KG, (*UP_M[1:], 0.2), strict=True
        )
    ]
    joints = [
        f'<joint name="{name}" type="continuous"><parent link="{parent}"/><child link="{child}"/>'
        f'<axis xyz="{" ".join("1" if a == axis else "0" for a in "xyz")}"/>'
        f'<origin xyz="0 0 {up}"/><limit effort="1" velocity="1"/></joint>'
        for name, parent, child, axis, up in zip(
            JOINTS, ("root", *JOINTS[:-1]), (*JOINTS[:-1], "hand"), AXES, UP_M, strict=True
        )
    ]
    return f'<robot name="made"><link name="root"/>{"".join(links + joints)}</robot>'


@pytest.fixture
def arm(tmp_path: Path) -> Arm:
    path = tmp_path / "arm.urdf"
    path.write_text(urdf())
    hand = Hand(path, JOINTS, "hand")
    return Arm(JOINTS, hand.T_base_hand, hand.gravity_nm)


def true_hand(q: np.ndarray) -> tuple[np.ndarray, float]:
    """Pose of the hand by hand, and the potential energy of the arm [J]."""
    R, p, energy = np.eye(3), np.zeros(3), 0.0
    for k, axis in enumerate(AXES):
        p = p + R @ [0, 0, UP_M[k]]
        R = R @ Rotation.from_euler(axis, q[k]).as_matrix()
        energy += 9.81 * MASS_KG[k] * float((p + R @ [0, 0, LENGTH_M[k] / 2])[2])
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, p
    return T, energy


def true_tool(q: np.ndarray) -> np.ndarray:
    steps = 1e-5 * np.eye(4)
    torque = np.array([(true_hand(q + d)[1] - true_hand(q - d)[1]) / 2e-5 for d in steps])
    T, _ = true_hand(q + ZEROS_RAD - COMPLIANCE * torque)
    return np.asarray(T_WORLD_BASE @ T @ T_HAND_TOOL)


def seen(
    amplitudes: np.ndarray, delay_s: float, seed: int, noise: tuple[float, float] = (1e-3, 2e-3)
) -> Seen:
    """All joints swing, each at its own pace, and rest in between; noise stays for 0.5 s."""
    rng = np.random.default_rng(seed)
    times = np.arange(0.0, 12.0, 0.02)
    pace = np.array([0.9, 0.6, 1.1, 1.3])
    swing = np.clip(1.3 * np.sin(pace * np.maximum(times - 1.0, 0.0)[:, None]), -1.0, 1.0)
    joints = amplitudes * swing
    seen_s = np.arange(0.0, 12.0, 0.05)
    at = np.stack([np.interp(seen_s - delay_s, times, q) for q in joints.T], axis=1)
    Ts = np.array([true_tool(q) for q in at])
    jumps = rng.normal(size=(24, 6)).repeat(10, axis=0) * np.repeat(noise, 3)
    Ts[:, :3, 3] += jumps[:, :3]
    Ts[:, :3, :3] = Ts[:, :3, :3] @ se3.rotation_from_vector(jumps[:, 3:])
    return Seen(f"run {seed}", times, joints, seen_s, Ts)


RICH = np.array([0.8, 0.7, 0.9, 1.2])


def covered(found: Found) -> list[bool]:
    """Whether the interval of each zero and each compliance holds the truth."""
    truth = {f"zero of {joint}": ZEROS_RAD[k] for k, joint in enumerate(JOINTS)}
    truth |= {f"compliance of {joint}": COMPLIANCE[k] for k, joint in enumerate(JOINTS)}
    rows = ((found.parameters[name], value) for name, value in truth.items())
    return [item["low"] <= value <= item["high"] for item, value in rows]


def test_a_rich_motion_gives_zeros_sag_and_delays_with_intervals_that_hold(arm: Arm) -> None:
    delays = (0.12, 1.38)
    runs = [seen(RICH, delay_s, seed) for seed, delay_s in enumerate(delays)]
    found = find_motion(arm, runs, np.eye(4))
    assert all(covered(found))
    for name in ("zero of lift", "zero of bend", "compliance of lift", "compliance of bend"):
        assert found.parameters[name]["why"] == ""
    for name in ("zero of turn", "compliance of turn"):  # which is the base's, and has no load
        assert found.parameters[name]["why"]
    assert list(found.delays_s.values()) == pytest.approx(delays, abs=0.003)
    q = np.array([[0.4, -0.9, 0.6, 0.3], [-0.5, 0.3, -1.2, 1.0]])
    told = found.motion.Ts_frame_hand(arm, q) @ found.motion.T_hand_tool
    truth = np.array([true_tool(row) for row in q])
    assert told[:, :3, 3] == pytest.approx(truth[:, :3, 3], abs=2e-3)


def test_a_joint_that_did_not_move_says_so_and_its_interval_holds_the_truth(arm: Arm) -> None:
    found = find_motion(arm, [seen(RICH * [0, 1, 0, 0], 0.3, 5)], np.eye(4))
    for name in ("bend", "roll"):
        assert found.parameters[f"zero of {name}"]["why"]
    assert found.parameters["zero of lift"]["why"].startswith("only together with")
    assert found.parameters["compliance of roll"]["why"] == "nothing that moves shows it"
    assert all(covered(found))


def test_a_third_of_the_time_elsewhere_leaves_the_rest_as_it_was(arm: Arm) -> None:
    run = seen(RICH, 0.3, 7)
    away = (run.seen_s > 7.0) & (run.seen_s < 10.5)
    lost = run.Ts_frame_tool.copy()
    lost[away] = lost[away] @ se3.transform_from(np.array([1.0, 0, 0, 0.1]), np.full(3, 0.05))
    found = find_motion(arm, [replace(run, Ts_frame_tool=lost)], np.eye(4))
    assert found.motion.zeros_rad[2] == pytest.approx(ZEROS_RAD[2], abs=0.004)
    assert found.delays_s["run 7"] == pytest.approx(0.3, abs=0.01)


def test_an_arm_that_stands_still_is_refused(arm: Arm) -> None:
    with pytest.raises(UsageError, match="nothing turns"):
        find_motion(arm, [seen(0 * RICH, 0.3, 1)], np.eye(4))


def test_residuals_that_say_the_same_count_once() -> None:
    rng = np.random.default_rng(0)
    free = rng.normal(size=(4, 400, 6))
    assert stays_alike(list(free)) == pytest.approx(1.0, abs=0.2)
    assert stays_alike([free[0]] * 4) == pytest.approx(4.0, rel=0.2)
    assert stays_alike(list(free[:, :100].repeat(4, axis=1))) == pytest.approx(4.0, rel=0.3)
