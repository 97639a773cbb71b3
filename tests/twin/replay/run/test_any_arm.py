"""Arms of five to seven joints, from a TOML and a URDF only: recorded, replayed, judged, drawn."""

from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pinocchio as pin
import pytest
import small_plans
from drawn_run import cloud
from joint_samples import at_positions

import robot_gst
from bridge.episode import schema, streams
from bridge.episode.cdr.messages import (
    CameraInfo,
    CompressedColor,
    FrameTransform,
    string_to_cdr,
    transforms_to_cdr,
)
from bridge.episode.metadata import EpisodeInfo
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.episode.streams import JointTrack
from bridge.episode.writer import EpisodeWriter
from bridge.geometry import se3
from bridge.geometry.camera import Camera
from bridge.robots.robot import Robot, read_robot
from bridge.task.plan import Plan
from bridge.task.verdict import Verdict
from twin.gate.twin_process import Question, answer
from twin.replay import runner
from twin.replay.config import ReplayConfig
from twin.replay.path import UnusablePlanError
from twin.replay.scene import ReplayScene, StartState, StartStates
from twin.replay.verdict import replay_plan
from twin.robot.model import load_robot
from twin.robot.posture import Posture
from twin.robot.surface import link_surfaces
from twin.scene.gaussians import write_ply
from twin.scene.localise.episode import Phase
from twin.scene.movable_scene import read_movable_scene
from twin.scene.raster.rasteriser import Rasteriser
from twin.scene.robot.splats import write_links
from twin.scene.store.folder import background_hash, read_scene, write_record

T0 = 1_700_000_000_000_000_000
SECOND = 1_000_000_000
CAMERA = Camera(width=160, height=120, fx=130.0, fy=130.0, cx=80.0, cy=60.0)
BLUE, GREY = (0.02, 0.02, 0.95), (0.3, 0.3, 0.3)


@dataclass(frozen=True)
class Case:
    """A robot, and where it finds cube and box; without them it moves along a line."""

    robot: str
    cube_m: tuple[float, float] | None = (0.5, -0.15)
    box_m: tuple[float, float] = (0.5, 0.19)
    pace: float = 2.0


QUICK = ("panda", "kinova")
"""Seven joints with a gripper, six with a fixed tool; the others are slow."""
CASES = {
    "ur3": Case("ur3_parallel_gripper", (0.3, -0.15), (0.3, 0.19), 1.5),
    "ur10": Case("ur10_parallel_gripper"),
    "ur10e": Case("ur10e_parallel_gripper"),
    "panda": Case("panda", pace=1.5),
    "xarm7": Case("xarm7_parallel_gripper"),
    "kinova": Case("kinova_j2s6s200", None),
    "z1": Case("z1", None),
    "so100": Case("so100", None),
    "so101": Case("so101", None),
}


def scene_of(case: Case, script: SimpleNamespace) -> ReplayScene:
    scene: ReplayScene = script.scene()
    Ts = {name: T.copy() for name, T in scene.Ts_base_object.items()}
    places = {"cube": case.cube_m or (0.9, -0.6), "box": case.box_m if case.cube_m else (0.9, 0.6)}
    for name, place in places.items():
        Ts[name][:2, 3] = place
    return replace(scene, Ts_base_object=Ts, urdf=read_robot(case.robot).description())


def line_plan(scene: ReplayScene) -> Plan:
    """From home 8 cm sideways and 4 cm down and back, the hand open."""
    robot = load_robot(scene.urdf)
    record = robot.record
    q, p = se3.split(robot.T_base_tcp(robot.home_rad))
    tau = tuple(
        small_plans.waypoint(
            t_s,
            se3.transform_from(q, p + share * np.array([0.0, 0.08, -0.04])),
            record.gripper.max_width_m,
        )
        for t_s, share in ((0.0, 0.0), (1.5, 1.0), (3.0, 0.0))
    )
    return small_plans.plan_of(
        "line", robot=record.name, frame=record.base_frame, tau=tau, task=scene.task.name
    )


def plan_of(case: Case, scene: ReplayScene, script: SimpleNamespace) -> Plan:
    plan: Plan = line_plan(scene) if case.cube_m is None else script.plan(scene, pace=case.pace)
    return plan


def tracks_of(plan: Plan, scene: ReplayScene, script: SimpleNamespace) -> list[JointTrack]:
    """What encoders say of a motion that follows the plan."""
    robot = load_robot(scene.urdf).record
    result = replay_plan(plan, scene, ReplayConfig(mode="kinematic"))
    tracks = script.recorded_tracks(result, T0 + SECOND, names=robot.joints)
    return list(tracks[: 2 if robot.gripper.fingers else 1])


def record_trial(
    run: RunFolder,
    plan: Plan,
    scene: ReplayScene,
    tracks: list[JointTrack],
    urdf: str | None = None,
) -> None:
    """A trial with one plan that was executed, and a camera beside the table."""
    robot = load_robot(scene.urdf).record
    end = int(tracks[0].stamps_ns[-1])
    info = EpisodeInfo(
        id="trial_1", kind="trial", task=scene.task.name, cell="lab", robot=robot.name
    )
    side = FrameTransform(
        stamp_ns=T0, parent=robot.base_frame, child="side", T_parent_child=T_base_side(scene)
    )
    with EpisodeWriter(run.episodes_dir / "trial_1.mcap") as writer:
        writer.describe(info)

        def say(topic: str, data: bytes, kind: str, stamp: int) -> None:
            writer.write(topic, data, type_name=kind, log_time_ns=stamp)

        say("/robot_description", string_to_cdr(urdf or scene.urdf), schema.STRING, T0)
        say("/tf_static", transforms_to_cdr([side]), schema.TF_MESSAGE, T0)
        eye = CameraInfo(stamp_ns=T0, frame_id="side", camera=CAMERA)
        say("/lab/cam/side/color/info", eye.to_cdr(), schema.CAMERA_INFO, T0)
        image = CompressedColor(stamp_ns=T0, frame_id="side", format="jpeg", data=b"-")
        say("/lab/cam/side/color/image", image.to_cdr(), schema.COMPRESSED_IMAGE, T0)
        say("/lab/plan", plan.to_json(), schema.PLAN, T0 + 1)
        for kind, stamp in (("execution_started", T0 + SECOND), ("execution_ended", end)):
            event = {"schema_version": 1, "stamp_ns": stamp, "type": kind, "plan_id": plan.id}
            writer.write("/lab/event", event, type_name=schema.EVENT, log_time_ns=stamp)
        for topic, track in zip(("joint_states", "gripper/state"), tracks, strict=False):
            for stamp, row in zip(track.stamps_ns.tolist(), track.position, strict=True):
                sample = at_positions(stamp, track.names, row)
                say(f"/lab/{topic}", sample.to_cdr(), schema.JOINT_STATE, stamp)


def T_base_side(scene: ReplayScene) -> np.ndarray:
    robot = load_robot(scene.urdf)
    hand = robot.T_base_tcp(robot.home_rad)[:3, 3]
    return se3.look_at(hand + np.array([0.7, -0.9, 0.6]), hand * [0.5, 0.5, 0.5], np.eye(3)[2])


def write_scene(run: RunFolder, urdf: str) -> None:
    """A grey point far away, and the arm as its own surface has it."""
    run.scene_dir.mkdir()
    write_ply(run.scene_dir / "background.ply", cloud(np.array([[0.0, 30.0, 0.0]]), GREY, 0.008))
    parts: dict[str, list[np.ndarray]] = {}
    for item in link_surfaces(load_robot(urdf)):
        corners = item.vertices_m[item.triangles]
        parts.setdefault(item.link, []).append(corners.mean(axis=1)[:: 1 + len(corners) // 300])
    links = {link: cloud(np.concatenate(points), BLUE, 0.008) for link, points in parts.items()}
    record = {
        "schema_version": 1, "key": "k", "scene_hash": background_hash(run), "background": {},
        "sources": [{"id": "trial_1"}], "views": [], "objects": {},
        "robot": {"links": write_links(run, links)},
    }  # fmt: skip
    write_record(run, record)


def raw_tool(robot: Robot, joints_rad: np.ndarray) -> np.ndarray:
    """Forward kinematics of the URDF by pinocchio alone, in the robot's base frame."""
    model = pin.buildModelFromXML(robot.urdf_text())
    data, q = model.createData(), pin.neutral(model)
    for name, value in zip(robot.joints, joints_rad, strict=True):
        joint = model.joints[model.getJointId(name)]
        turns = [np.cos(value), np.sin(value)] if joint.nq == 2 else [value]
        q[joint.idx_q : joint.idx_q + joint.nq] = turns
    pin.framesForwardKinematics(model, data, q)
    base, tool = (data.oMf[model.getFrameId(f)] for f in (robot.base_frame, robot.tool_frame))
    return np.array(base.actInv(tool).homogeneous)


def seen_from(scene: ReplayScene, p_base: np.ndarray) -> tuple[int, int]:
    x, y, z = se3.apply(se3.invert(T_base_side(scene)), p_base[None])[0]
    return round(CAMERA.fy * y / z + CAMERA.cy), round(CAMERA.fx * x / z + CAMERA.cx)


@pytest.mark.parametrize(
    "case",
    [
        pytest.param(case, id=name, marks=() if name in QUICK else pytest.mark.slow)
        for name, case in CASES.items()
    ],
)
def test_an_arm_is_replayed_judged_and_drawn(
    case: Case, run: RunFolder, script: SimpleNamespace, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = scene_of(case, script)
    plan = plan_of(case, scene, script)
    record_trial(run, plan, scene, tracks_of(plan, scene, script))
    write_scene(run, scene.urdf)
    start = StartState(Ts_base_object=dict(scene.Ts_base_object))
    phase = Phase(name="start", plan_id=None, after_ns=None, before_ns=None)
    states = StartStates(scene.task, [phase], [start])
    monkeypatch.setattr(runner, "localised_starts", lambda *_, **__: states)

    assert robot_gst.run(["replay", str(run.path), "--workers", "1", "--quiet"]) == 0
    replays = sorted(run.derived_dir.glob("*.replay.*.mcap"))
    assert [path.name.split(".")[2:4] for path in replays] == [
        ["executed", "dynamic"],
        ["executed", "kinematic"],
        ["planned", "dynamic"],
    ]
    robot = read_robot(case.robot)
    for path in replays:
        check_replay(Episode.open(path), robot, plan, picks=case.cube_m is not None)
    verdict = gate_verdict(run, plan, scene)
    assert (verdict.ik.value, verdict.clearance.value) == (True, True), verdict.clearance
    assert verdict.accepted is (case.cube_m is not None), verdict.reason
    check_picture(run, scene)


def test_another_robot_can_be_named_than_the_recorded_description(
    run: RunFolder, script: SimpleNamespace, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A driver publishes a URDF with a joint of its own name: the file says the rest."""
    case = CASES["kinova"]
    scene = scene_of(case, script)
    plan = line_plan(scene)
    robot = read_robot(case.robot)
    bare = robot.arm_urdf().replace(f'"{robot.joints[0]}"', '"first"')
    record_trial(run, plan, scene, tracks_of(plan, scene, script), urdf=bare)
    start = StartState(Ts_base_object=dict(scene.Ts_base_object))
    phase = Phase(name="start", plan_id=None, after_ns=None, before_ns=None)
    states = StartStates(scene.task, [phase], [start])
    monkeypatch.setattr(runner, "localised_starts", lambda *_, **__: states)
    words = ["replay", str(run.path), "--workers", "1", "--quiet"]
    assert robot_gst.run(words) == 1  # taken for the default robot, whose joints it lacks
    assert not list(run.derived_dir.glob("*.replay.*.mcap"))
    assert robot_gst.run([*words, "--robot", case.robot]) == 0
    replays = list(run.derived_dir.glob("*.replay.*.mcap"))
    assert len(replays) == 3
    for path in replays:
        episode = Episode.open(path)
        assert streams.joint_track(episode).names == read_robot(case.robot).joints
        assert streams.recorded_robot(episode).name == case.robot


def test_a_fixed_tool_grasps_nothing(script: SimpleNamespace) -> None:
    scene = scene_of(CASES["kinova"], script)
    plan = line_plan(scene)
    closing = replace(plan, tau=(plan.tau[0], replace(plan.tau[1], g=1), plan.tau[2]))
    with pytest.raises(UnusablePlanError, match=r"closes a gripper.*'kinova_j2s6s200' has no"):
        replay_plan(closing, scene, ReplayConfig(mode="kinematic"))


def check_replay(episode: Episode, robot: Robot, plan: Plan, *, picks: bool) -> None:
    """Joints and frames are the robot's, the tool is where the plan sends it, the cube in the box.

    Motors lag behind by some millimetres.
    """
    track = streams.joint_track(episode)
    assert track.names == robot.joints
    assert streams.recorded_robot(episode) == replace(
        robot, attached=(), flange="", held=(), mesh_folders={}, folder=Path()
    )
    for row in (0, -1):
        T = raw_tool(robot, track.position[row])
        assert np.linalg.norm(T[:3, 3] - np.array(plan.tau[row].p_m)) < 0.01
        poses = streams.pose_track(episode, "/lab/tcp/pose")
        np.testing.assert_allclose(poses.transforms()[row], T, atol=1e-6)
    verdict: Verdict = streams.verdicts(episode)[-1][1]
    assert (verdict.ik.value, verdict.clearance.value) == (True, True), verdict.reason
    if verdict.mode == "dynamic":
        assert verdict.terminal.value is picks, verdict.reason


def gate_verdict(run: RunFolder, plan: Plan, scene: ReplayScene) -> Verdict:
    """What the gate's own process answers."""
    question = Question(
        run_path=run.path,
        plan=plan,
        seen=scene,
        config=ReplayConfig(mode="dynamic"),
        max_steps=100_000,
    )
    return answer(question)


def check_picture(run: RunFolder, scene: ReplayScene) -> None:
    """The hand is seen where forward kinematics has it, in two postures that look different."""
    robot, rasteriser = load_robot(scene.urdf), Rasteriser()
    parts = read_movable_scene(run, read_scene(run))
    images = []
    for turned_rad in (0.0, 0.6):
        joints = robot.home_rad.copy()
        joints[0] += turned_rad
        posture = Posture(joints_rad=joints, width_m=0.0)
        drawn = parts.draw(
            rasteriser, parts.at({}, posture, scene.urdf), CAMERA, T_base_side(scene)
        )
        images.append(drawn.image_u8.astype(int))
        row, column = seen_from(scene, robot.T_base_tcp(joints)[:3, 3])
        near = images[-1][row - 6 : row + 7, column - 6 : column + 7]
        assert (near[..., 2] - near[..., 0] > 60).sum() > 20
    assert (np.abs(images[0] - images[1]).max(axis=-1) > 60).sum() > 300
