"""Pictures of a replay: things are drawn where they were, in the eyes of the recorded cameras."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from drawn_run import (
    AWAY,
    BLUE,
    CAMERA,
    GREEN,
    HOME,
    RED,
    SECOND,
    T0,
    T_BASE_SIDE,
    T_TCP_WRIST,
    block,
    write_recording,
    write_scene,
)
from verdicts import verdict_of

from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.errors import UsageError
from bridge.exchange.lerobot.video import read_frames
from bridge.geometry import se3
from bridge.media.color import decode_color
from twin.physics.soft import SoftModel
from twin.replay.images import RATE_HZ, render_replay
from twin.replay.result import ReplayResult
from twin.replay.scene import ReplayScene
from twin.robot.model import load_robot
from twin.scene.render import render
from twin.scene.settings import RenderConfig
from twin.scene.store.calibration import write_calibration


def result_of(scene: ReplayScene, movable: str, nodes_m: np.ndarray | None = None) -> ReplayResult:
    """The arm goes from home to away, the movable along the table and round, the box stays."""
    share = np.linspace(0.0, 1.0, 61)
    joints = HOME + share[:, None] * (AWAY - HOME)
    robot = load_robot(scene.urdf)
    Ts = np.tile(scene.Ts_base_object[movable], (61, 1, 1))
    for T, s in zip(Ts, share, strict=True):
        T[:3, :3] = se3.rotation_from_vector(np.array([0.0, 0.0, s])) @ T[:3, :3]
        T[:3, 3] += s * np.array([-0.05, 0.1, 0.08])
    return ReplayResult(
        verdict=verdict_of(),
        stamps_ns=np.linspace(0, 2 * SECOND, 61).round().astype(np.int64),
        joints_rad=joints,
        width_m=np.full(61, 0.05),
        Ts_base_tcp=np.stack([robot.T_base_tcp(q) for q in joints]),
        Ts_base_object={movable: Ts},
        finger_contact={movable: np.zeros(61, dtype=bool)},
        clearance_m=np.ones(61),
        contacts=[],
        nodes_m={}
        if nodes_m is None
        else {movable: np.stack([se3.apply(T, nodes_m) for T in Ts]).astype(np.float32)},
    )  # fmt: skip


def pictures(
    run: RunFolder,
    episode: Episode,
    result: ReplayResult,
    scene: ReplayScene,
    *,
    executed: bool = True,
    planned: bool = False,
) -> dict[str, dict[int, np.ndarray]]:
    """Images by camera and stamp, 0..1."""
    found: dict[str, dict[int, np.ndarray]] = {}
    for camera_id, image in render_replay(
        run, episode, result, scene, start_ns=T0, executed=executed, planned=planned
    ):
        found.setdefault(camera_id, {})[image.stamp_ns - T0] = decode_color(image.data) / 255.0
    return found


def middle_of(image: np.ndarray, color: tuple[float, ...]) -> np.ndarray:
    """Centre of the pixels that have a colour [px]; NaN when there are none."""
    other = [channel for channel in range(3) if color[channel] < 0.5]
    own = int(np.argmax(color))
    share = image[..., own] - image[..., other].max(axis=-1)
    rows, columns = np.nonzero(share > 0.4)
    return np.array([columns.mean() + 0.5, rows.mean() + 0.5]) if len(rows) else np.full(2, np.nan)


def seen_at(T_base_camera: np.ndarray, p_m: np.ndarray) -> np.ndarray:
    return CAMERA.project(se3.apply(se3.invert(T_base_camera), p_m[None]))[0][0]


def whole(pixel: np.ndarray) -> bool:
    """Whether a thing there lies in the picture with all of itself."""
    return bool(((pixel > 15) & (pixel < [CAMERA.width - 15, CAMERA.height - 15])).all())


def test_everything_lies_where_the_recorded_cameras_would_have_seen_it(
    run: RunFolder, script: SimpleNamespace
) -> None:
    scene = script.scene()
    write_scene(run, scene, "cube", block())
    episode = write_recording(run, scene.urdf)
    result = result_of(scene, "cube")
    images = pictures(run, episode, result, scene)
    assert {name: len(found) for name, found in images.items()} == {"side": 3, "wrist": 3}
    robot = load_robot(scene.urdf)
    for t_ns, index in ((0, 0), (SECOND, 30), (2 * SECOND, 60)):
        view = images["side"][t_ns]
        cube = result.Ts_base_object["cube"][index][:3, 3]
        tool = robot.T_base_link("tool0", result.joints_rad[index])[:3, 3]
        box = scene.Ts_base_object["box"][:3, 3]
        for p_m, color in ((cube, RED), (tool, BLUE), (box, GREEN)):
            np.testing.assert_allclose(
                middle_of(view, color), seen_at(T_BASE_SIDE, p_m), atol=1.0, err_msg=str(color)
            )
        T_wrist = robot.T_base_tcp(result.joints_rad[index]) @ T_TCP_WRIST
        if whole(expected := seen_at(T_wrist, cube)):
            found = middle_of(images["wrist"][t_ns], RED)
            np.testing.assert_allclose(found, expected, atol=1.5)


@pytest.mark.slow
@pytest.mark.parametrize(("executed", "count"), [(False, int(2 * RATE_HZ)), (True, 3)])
def test_a_plan_is_seen_from_the_hand_that_carries_it_out(
    run: RunFolder, script: SimpleNamespace, *, executed: bool, count: int
) -> None:
    """The arm goes the other way round than when images were taken, if any were."""
    scene = script.scene()
    write_scene(run, scene, "cube", block())
    episode = write_recording(run, scene.urdf)
    forward = result_of(scene, "cube")
    result = replace(
        forward, joints_rad=forward.joints_rad[::-1], Ts_base_tcp=forward.Ts_base_tcp[::-1]
    )
    images = pictures(run, episode, result, scene, executed=executed, planned=True)
    assert {name: len(found) for name, found in images.items()} == {"side": count, "wrist": count}
    robot = load_robot(scene.urdf)
    checked = 0
    for t_ns, view in images["wrist"].items():
        index = int(np.abs(result.stamps_ns - t_ns).argmin())
        T_wrist = robot.T_base_tcp(result.joints_rad[index]) @ T_TCP_WRIST
        p_m = result.Ts_base_object["cube"][index][:3, 3]
        expected, found = seen_at(T_wrist, p_m), middle_of(view, RED)
        if whole(expected):
            np.testing.assert_allclose(found, expected, atol=1.5)
            checked += 1
    assert checked >= count // 3
    first, last = images["side"][0], images["side"][max(images["side"])]
    assert np.linalg.norm(middle_of(first, BLUE) - middle_of(last, BLUE)) > 8


@pytest.mark.slow
def test_a_toy_bends_with_its_nodes(run: RunFolder, script: SimpleNamespace) -> None:
    """The red ones sit at one end of the toy, which is lifted; the rest stays."""
    scene = script.toy_scene()
    body = SoftModel.from_task(scene.task.objects["sloth"])
    nodes = body.nodes_m.astype(np.float64)
    axis = int(np.argmax(np.ptp(nodes, axis=0)))
    end = nodes[nodes[:, axis] > np.quantile(nodes[:, axis], 0.9)]
    write_scene(run, scene, "sloth", end)
    episode = write_recording(run, scene.urdf)
    lifted = nodes + np.outer(np.clip(nodes[:, axis], 0.0, None), np.array([0.0, 0.0, 1.0]))
    flat, bent = (result_of(scene, "sloth", rest) for rest in (nodes, lifted))
    for result in (flat, bent):
        view = pictures(run, episode, result, scene)["side"][0]
        T = result.Ts_base_object["sloth"][0]
        moved = se3.apply(T, (nodes if result is flat else lifted)[np.isin(nodes, end).all(1)])
        p_m = moved.mean(axis=0)
        np.testing.assert_allclose(middle_of(view, RED), seen_at(T_BASE_SIDE, p_m), atol=2.0)


def calibrate(run: RunFolder, **Ts_link_camera: tuple[str, np.ndarray]) -> None:
    """Say of cameras where they are mounted."""
    mounts = {}
    for name, (link, T) in Ts_link_camera.items():
        q, p = se3.split(T)
        pose = {"p_m": p.tolist(), "q_wxyz": q.tolist()}
        mounts[name] = {"link": link, "stream": "color", "T_link_camera": pose}
    write_calibration(run, mounts, {})


@pytest.mark.parametrize("planned", [False, True])
def test_calibrated_cameras_see_from_where_the_calibration_has_them(
    run: RunFolder, script: SimpleNamespace, *, planned: bool
) -> None:
    """As objects are localised: /tf says something else, which may be why it was calibrated."""
    scene = script.scene()
    write_scene(run, scene, "cube", block())
    episode, result = write_recording(run, scene.urdf), result_of(scene, "cube")
    robot = load_robot(scene.urdf)
    T_side = T_BASE_SIDE @ se3.transform_from(np.array([0.99, 0.02, 0.05, 0.0]), np.zeros(3))
    T_tcp_wrist = T_TCP_WRIST @ se3.transform_from(np.array([0.99, 0.1, 0.0, 0.0]), np.zeros(3))
    T_tool_tcp = se3.invert(robot.T_base_link("tool0", HOME)) @ robot.T_base_tcp(HOME)
    before = pictures(run, episode, result, scene, planned=planned)
    calibrate(run, side=("base_link", T_side), wrist=("tool0", T_tool_tcp @ T_tcp_wrist))
    images = pictures(run, episode, result, scene, planned=planned)
    assert {name: list(found) for name, found in images.items()} == {
        name: list(found) for name, found in before.items()
    }
    checked = 0
    for t_ns, index in ((0, 0), (SECOND, 30), (2 * SECOND, 60)):
        p_m = result.Ts_base_object["cube"][index][:3, 3]
        T_wrist = robot.T_base_tcp(result.joints_rad[index]) @ T_tcp_wrist
        for name, T in (("side", T_side), ("wrist", T_wrist)):
            if whole(expected := seen_at(T, p_m)):
                found = middle_of(images[name][t_ns], RED)
                np.testing.assert_allclose(found, expected, atol=1.5, err_msg=name)
                checked += 1
    assert checked >= 4


def test_a_trial_shows_the_recorded_arm_and_says_whom_nobody_found(
    run: RunFolder, script: SimpleNamespace, tmp_path: Path
) -> None:
    scene = script.scene()
    write_scene(run, scene, "cube", block())
    write_recording(run, scene.urdf)
    about = render(
        run, RenderConfig(episode="trial_0001", camera="side", depth=True, out=tmp_path / "f")
    )
    assert about["frames"] == 3
    assert "cube was not localised: not drawn" in about["notes"]
    images = [decode_color((tmp_path / "f" / f"{t}.png").read_bytes()) for t in STAMPS_MS]
    tools = [middle_of(image / 255.0, BLUE) for image in images]
    assert np.isnan([middle_of(image / 255.0, RED) for image in images]).all()
    robot = load_robot(scene.urdf)
    for tool, share in zip(tools, (0.0, 0.5, 1.0), strict=True):
        p_m = robot.T_base_link("tool0", HOME + share * (AWAY - HOME))[:3, 3]
        np.testing.assert_allclose(tool, seen_at(T_BASE_SIDE, p_m), atol=1.0)
    for ending in ("depth", "seen"):
        assert (tmp_path / "f" / f"{STAMPS_MS[0]}_{ending}.png").is_file()


STAMPS_MS = ("0000000", "0001000", "0002000")


def test_a_video_has_the_frames_and_what_does_not_go_together_is_refused(
    run: RunFolder, script: SimpleNamespace, tmp_path: Path
) -> None:
    pytest.importorskip("av")
    scene = script.scene()
    write_scene(run, scene, "cube", block())
    write_recording(run, scene.urdf)
    eye = {"eye": (1.2, -0.8, 0.9), "target": (0.45, 0.0, 0.2)}
    config = RenderConfig(episode="trial_0001", size="97x64", out=tmp_path / "a.mp4", **eye)
    assert render(run, config)["frames"] == 3
    frames = list(read_frames(tmp_path / "a.mp4", [0.0, 1.0, 2.0], 0.01))
    assert {frame.shape for frame in frames} == {(64, 97, 3)}
    assert np.abs(frames[0].astype(int) - frames[-1]).max() > 80
    for wrong, found in (
        ({"out": tmp_path / "a.avi"}, "an .mp4 file or a folder"),
        ({"depth": True}, "--out FOLDER"),
        ({"size": "big"}, "write WIDTHxHEIGHT"),
        ({"compare": True}, "leave out --eye and --size"),
        ({"episode": "trial_9"}, "no episode 'trial_9'.*trial_0001"),
        ({"eye": None}, "belong together"),
    ):
        with pytest.raises(UsageError, match=found):
            render(run, replace(config, **wrong))
