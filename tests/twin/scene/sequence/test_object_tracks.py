"""Objects over a trial: standing until the fingers close on them, then with the tool."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest

from bridge.episode.streams import JointTrack
from bridge.geometry import se3
from bridge.robots.default import ROBOT
from bridge.task.task_file import Task, load_task
from twin.robot.model import load_robot
from twin.robot.posture import PostureTrack
from twin.scene.object_tracks import ObjectTracks, carried_tracks

S = 1_000_000_000
HOME = np.array([-0.263, -1.709, 1.365, -1.227, -1.571, 1.308])
TURN = np.array([0.6, 0.1, -0.1, 0.0, 0.0, 0.0])
URDF = ROBOT.urdf_text()
TASK = load_task("cube_into_box")
STANDS = se3.transform_from(np.array([1.0, 0.0, 0.0, 0.0]), np.array([0.5, 0.2, 0.0]))


def posture_track(held_m: float = 0.05) -> PostureTrack:
    """Ten seconds: closed from 3 to 7 s, while the arm turns; opens slowly; nothing at 8 s."""
    stamps = np.arange(0, 10 * S + 1, S // 20)
    share = np.clip((stamps / S - 3.5) / 3.0, 0.0, 1.0)
    t_s = stamps / S
    widths_m = [0.085, held_m, held_m, held_m + 0.002, 0.085, 0.085, 0]
    width = np.interp(t_s, [2.9, 3.0, 7.0, 7.1, 7.2, 7.9, 8], widths_m)
    arm = JointTrack(names=ROBOT.joints, stamps_ns=stamps, position=HOME + share[:, None] * TURN)
    widths = JointTrack(names=("gripper_width",), stamps_ns=stamps, position=width[:, None])
    return PostureTrack(urdf=URDF, arm=arm, widths=widths)


def T_tcp(t_s: float, track: PostureTrack) -> np.ndarray:
    return load_robot(URDF).T_base_tcp(track.at(round(t_s * S)).joints_rad)


def record(name: str, T: np.ndarray | None, plan_id: str | None = None) -> Mapping[str, object]:
    pose = None if T is None else se3.pose_record(T)
    return {"object": name, "found": T is not None, "T_base_object": pose, "plan_id": plan_id}


def tracks(
    before: np.ndarray | None,
    after: np.ndarray | None,
    track: PostureTrack | None = None,
    seen_in_hand: np.ndarray | None = None,
    task: Task = TASK,
) -> ObjectTracks:
    track = posture_track() if track is None else track
    boxes = [record("box", STANDS), record("box", STANDS, "plan_1")]
    records = [record("cube", before), record("cube", after, "plan_1"), *boxes]
    if seen_in_hand is not None:
        entry = {"grip_ns": 3 * S, "T_tcp_object": se3.pose_record(seen_in_hand)}
        records[1] = {**records[1], "in_hand": [entry]}
    return carried_tracks(records, {"plan_1": (S, 9 * S)}, task, track)


IN_HAND = se3.transform_from(np.array([0.95, 0.0, 0.3, 0.0]), np.array([0.005, 0.0, 0.01]))
"""Tilted about the line between the pads."""


def test_what_the_fingers_close_on_goes_with_the_tool_and_stays_where_they_open() -> None:
    track = posture_track()
    before, after = T_tcp(3, track) @ IN_HAND, T_tcp(7, track) @ IN_HAND
    found = tracks(before, after)
    assert found.notes == ()
    for t_s, expected in (
        (0.0, before), (2.9, before), (4.3, T_tcp(4.3, track) @ IN_HAND),
        (5.5, T_tcp(5.5, track) @ IN_HAND), (7.2, after), (20.0, after),
    ):  # fmt: skip
        poses = found.at(round(t_s * S), T_tcp(min(t_s, 10.0), track))
        np.testing.assert_allclose(poses["cube"], expected, atol=1e-9, err_msg=str(t_s))
        np.testing.assert_allclose(poses["box"], STANDS, atol=1e-12)


def test_what_localisation_and_joints_disagree_about_is_left_to_the_fall() -> None:
    track = posture_track()
    before, after = T_tcp(3, track) @ IN_HAND, T_tcp(7, track) @ IN_HAND
    off = after.copy()
    off[:3, 3] += [0.01, -0.02, 0.0]
    found = tracks(before, off)
    for t_s in (3.1, 5.0, 6.9):
        held = found.at(round(t_s * S), T_tcp(t_s, track))["cube"]
        np.testing.assert_allclose(held, T_tcp(t_s, track) @ IN_HAND, atol=1e-9)
    poses = [found.at(round(t * S), T_tcp(t, track))["cube"] for t in np.arange(6.9, 7.2, 0.001)]
    steps = np.linalg.norm(np.diff([T[:3, 3] for T in poses], axis=0), axis=1)
    assert steps.max() < 0.001
    np.testing.assert_allclose(poses[-1], off, atol=1e-9)
    assert found.notes == ()


def test_a_cube_that_looks_the_same_after_a_quarter_turn_does_not_spin_in_the_hand() -> None:
    track = posture_track()
    before, after = T_tcp(3, track) @ IN_HAND, T_tcp(7, track) @ IN_HAND
    quarter = se3.small_motion(np.array([0.0, 0.0, np.pi / 2, 0.0, 0.0, 0.0]))
    poses = tracks(before, after @ quarter).at(5 * S, T_tcp(5, track))
    np.testing.assert_allclose(poses["cube"], T_tcp(5, track) @ IN_HAND, atol=1e-9)


@pytest.mark.parametrize("way_m", [0.02, 0.5])
def test_what_is_pushed_moves_while_the_hand_is_near(way_m: float) -> None:
    """The hand is there until 3.5 s, in the execution from 1 s on, and turns away."""
    track = posture_track(0.0005)
    before = T_tcp(3, track) @ IN_HAND
    after = before.copy()
    after[0, 3] += way_m
    found = tracks(before, after, track)
    way = f"{100 * way_m:.0f} cm"
    assert found.notes == (f"cube was moved by {way} without being held: drawn there afterwards",)
    x = [found.at(round(t * S), T_tcp(t, track))["cube"][0, 3] - before[0, 3] for t in range(10)]
    np.testing.assert_allclose(x[:2], 0.0, atol=1e-9)
    if way_m < 0.1:
        assert 0.1 * way_m < x[2] < x[3] < 0.9 * way_m
    else:  # it was never there
        np.testing.assert_allclose(x[2:4], 0.0, atol=1e-9)
    np.testing.assert_allclose(x[5 if way_m < 0.1 else 6 :], way_m, atol=1e-9)
    assert (np.diff(x) >= 0.0).all()


@pytest.mark.parametrize("stood", [True, False])
def test_what_slips_out_of_the_hand_falls_from_there(stood: bool) -> None:
    """At 5 s; fingers that closed as far without a stop had nothing between them."""
    track = posture_track()
    assert track.widths is not None
    t_s = track.widths.stamps_ns / S
    shut_m = np.interp(t_s, [3.0, 5.0], [0.085, 0.0])
    width_m = np.where(t_s < 5, track.widths.position[:, 0] if stood else shut_m, 0.0)
    track = replace(track, widths=replace(track.widths, position=width_m[:, None]))
    before, after = T_tcp(3, track) @ IN_HAND, T_tcp(5, track) @ IN_HAND
    after[2, 3] -= 0.2
    found = tracks(before, after, track)
    assert ("where it was let go" if stood else "without being held") in found.notes[0]
    held, lies = (found.at(round(t * S), T_tcp(t, track))["cube"] for t in (4.8, 5.4))
    assert np.allclose(held, T_tcp(4.8, track) @ IN_HAND, atol=1e-6) == stood
    np.testing.assert_allclose(lies, after, atol=1e-9)


def tipping_s(edge_m: float) -> float:
    """How long a cube takes from 3 degrees past its balance on an edge to lie on its next face."""
    faster_per_s = np.sqrt(3 * 9.81 / (2 * np.sqrt(2) * edge_m))
    return float(np.arccosh(np.radians(45) / np.radians(3)) / faster_per_s)


@pytest.mark.parametrize(("fell_m", "aside_m"), [(0.02, 0.0), (0.2, 0.0), (0.04, 0.045)])
def test_what_was_let_go_falls_as_long_as_gravity_takes(fell_m: float, aside_m: float) -> None:
    """Straight down freely; beside, a cube of 4 cm tips off an edge first."""
    track = posture_track()
    before, after = T_tcp(3, track) @ IN_HAND, T_tcp(7, track) @ IN_HAND
    after[2, 3] -= fell_m
    after[0, 3] += aside_m
    found = tracks(before, after)
    way = f"{100 * np.hypot(fell_m, aside_m):.0f} cm from where it was let go"
    said = f"cube lay {way}: drawn there from then on"
    assert found.notes == (() if fell_m == 0.02 else (said,))
    np.testing.assert_allclose(found.at(8 * S, T_tcp(8, track))["cube"], after, atol=1e-9)
    times_s = np.arange(6.9, 7.6, 0.001)
    z = np.array([found.at(round(t * S), T_tcp(t, track))["cube"][2, 3] for t in times_s])
    on_its_way = (z > after[2, 3] + 1e-6) & (z < after[2, 3] + fell_m - 1e-6)
    assert times_s[np.argmax(on_its_way)] == pytest.approx(7.0, abs=0.01)
    free_s = np.sqrt(2 * np.hypot(fell_m, aside_m) / 9.81) + (tipping_s(0.04) if aside_m else 0.0)
    assert 0.001 * on_its_way.sum() == pytest.approx(free_s, abs=0.02)
    half = np.count_nonzero(on_its_way & (z > after[2, 3] + fell_m / 2)) / on_its_way.sum()
    assert half == pytest.approx(np.sqrt(0.5), abs=0.05)  # slow at first


def test_a_second_grip_looks_for_a_cube_where_the_first_one_pushed_it() -> None:
    """Cameras saw it in the first: from where it lay the second missed it."""
    once = posture_track()
    t_s = once.arm.stamps_ns / S
    times_s = [2.9, 3.0, 4.0, 4.1, 5.9, 6.0, 8.0, 8.1]
    width_m = np.interp(t_s, times_s, [0.085, 0.04, 0.04, 0.085] * 2)[:, None]
    turned = np.clip(t_s - 4.5, 0.0, 1.0)[:, None] * np.array([0.06, 0.0, 0.0, 0.0, 0.0, 0.0])
    arm = replace(once.arm, position=HOME + turned)
    widths = JointTrack(names=("gripper_width",), stamps_ns=arm.stamps_ns, position=width_m)
    track = PostureTrack(urdf=URDF, arm=arm, widths=widths)
    second = (se3.invert(T_tcp(3, track)) @ T_tcp(6, track))[:3, 3]
    lies = np.eye(4)
    lies[1, 3] = -0.045 * np.sign(second[1])
    assert np.linalg.norm(second) < 0.05 < np.linalg.norm(second - lies[:3, 3])
    found = tracks(T_tcp(3, track) @ lies, None, track, np.eye(4))
    in_hand = se3.invert(T_tcp(7, track)) @ found.at(7 * S, T_tcp(7, track))["cube"]
    np.testing.assert_allclose(in_hand, se3.invert(T_tcp(6, track)) @ T_tcp(4, track), atol=1e-9)


def test_a_cube_lies_in_the_hand_as_cameras_saw_it_there() -> None:
    """Tipped onto an edge and pushed aside by a finger; of poses that look alike the nearest."""
    track = posture_track()
    tipped = se3.from_rotation(
        se3.rotation_from_vector(np.radians([35.0, 10.0, 5.0])), [0.02, 0.002, -0.009]
    )
    other_side = se3.small_motion(np.array([np.pi / 2, 0.0, 0.0, 0.0, 0.0, 0.0]))
    before, after = T_tcp(3, track), T_tcp(7, track)
    found = tracks(before, after, track, tipped @ other_side)
    for t_s in (3.1, 5.0, 6.9):
        held = found.at(round(t_s * S), T_tcp(t_s, track))["cube"]
        np.testing.assert_allclose(held, T_tcp(t_s, track) @ tipped, atol=1e-9)
    poses = [found.at(round(t * S), T_tcp(t, track))["cube"] for t in np.arange(2.5, 3.1, 0.001)]
    steps = np.linalg.norm(np.diff([T[:3, 3] for T in poses], axis=0), axis=1)
    assert steps.max() < 0.002
    for t_s, there in ((5, before), (9, after)):  # no joints: where it was taken
        np.testing.assert_allclose(found.at(t_s * S, None)["cube"], there, atol=1e-9)


def test_what_nobody_found_is_absent_and_what_is_lost_stays_where_the_hand_put_it() -> None:
    track = posture_track()
    assert tracks(None, None).absent == {"cube"}
    assert "cube" not in (tracks(None, None).first() or {})
    assert ObjectTracks().first() is None
    found = tracks(T_tcp(3, track) @ IN_HAND, None)
    np.testing.assert_allclose(found.at(8 * S, None)["cube"], T_tcp(7, track) @ IN_HAND, atol=1e-9)
    assert "left where the hand put it" in found.notes[0]


def test_a_toy_that_nobody_found_has_fallen_to_the_height_at_which_it_lay() -> None:
    track, sloth = posture_track(), load_task("sloth_into_basket").objects["sloth"]
    soft = replace(TASK.objects["cube"], soft=sloth.soft)
    task = replace(TASK, objects={**TASK.objects, "cube": soft})
    before, let_go = (T_tcp(t_s, track) @ IN_HAND for t_s in (3, 7))
    let_go[2, 3] = before[2, 3]
    np.testing.assert_allclose(tracks(before, None, task=task).at(8 * S, None)["cube"], let_go)
