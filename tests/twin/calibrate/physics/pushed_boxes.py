"""A made arm with a palm and a finger, and recordings of boxes that it pushes."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.spatial import ConvexHull

from bridge.episode import schema
from bridge.episode.cdr.batch import pose_messages
from bridge.episode.metadata import EpisodeInfo
from bridge.episode.run_folder import RunFolder
from bridge.episode.writer import EpisodeWriter
from bridge.geometry import se3
from bridge.task.scripted_motion import RECORD_NAME, JointTarget, PushedBox, ScriptedMotion

HAND_URDF = """<robot name="made">
  <link name="root"/>
  <joint name="turn" type="continuous"><parent link="root"/><child link="hand"/>
    <axis xyz="0 0 1"/><origin xyz="-0.3 0 0.03"/><limit effort="1" velocity="1"/></joint>
  <link name="hand"><collision><geometry>
    <mesh filename="package://made/meshes/palm.stl"/></geometry></collision></link>
  <joint name="bend" type="revolute"><parent link="hand"/><child link="finger"/>
    <axis xyz="0 1 0"/><origin xyz="0 0 0.1"/>
    <limit effort="1" velocity="1" lower="0" upper="2"/></joint>
  <link name="finger"><collision><geometry>
    <mesh filename="package://made/meshes/finger.stl"/></geometry></collision></link>
</robot>"""
MOTION = ScriptedMotion(
    robot="robot/hand.urdf",
    hand_link="hand",
    joints=("turn",),
    base_m=(0.0, 0.0, 0.0),
    targets=(JointTarget(t_s=0.0, joints_rad={"turn": 0.0}),),
    gain_hz=10.0,
    limit_rad_s=0.5,
    period_s=0.05,
    duration_s=2.5,
    boxes={"cube": PushedBox(size_m=(0.08, 0.08, 0.06), mass_kg=0.1)},
)
MARKER_M = np.array([0.01, 0.02, 0.05])
"""Where the tracked body is on the hand."""
PALM_M = 0.04
"""Thickness of the palm."""
BOX_X_M = 0.0


def write_robot(run: RunFolder) -> None:
    """Palm: a plate across the way. Finger: a rod upwards that bends forward, over the box."""
    meshes = run.path / "robot" / "meshes"
    meshes.mkdir(parents=True)
    (run.path / "robot" / "hand.urdf").write_text(HAND_URDF)
    _write_block(meshes / "palm.stl", (PALM_M, 0.2, 0.04), 0.0)
    _write_block(meshes / "finger.stl", (0.01, 0.01, 0.1), 0.05)


def _write_block(path: Path, size_m: tuple[float, float, float], up_m: float) -> None:
    """A cuboid as an STL file in text."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) / 2
    points = corners * size_m + np.array([0.0, 0.0, up_m])
    lines = ["solid block"]
    for triangle in ConvexHull(points).simplices:
        lines += ["facet normal 0 0 0", "outer loop"]
        lines += [f"vertex {x:.6f} {y:.6f} {z:.6f}" for x, y, z in points[triangle]]
        lines += ["endloop", "endfacet"]
    path.write_text("\n".join([*lines, "endsolid block", ""]))


def hand_x_m(speed_m_s: float) -> tuple[Float[np.ndarray, " num"], Float[np.ndarray, " num"]]:
    """At rest for 1.1 s, then forward by 0.3 m, then at rest again; at 100 Hz."""
    t_s = np.arange(250) / 100
    return t_s, -0.3 + np.clip(speed_m_s * (t_s - 1.1), 0.0, 0.3)


def write_recording(
    run: RunFolder,
    name: str,
    speed_m_s: float,
    box_end_x_m: float = BOX_X_M,
    box: bool = True,
    motion: ScriptedMotion | None = MOTION,
) -> Path:
    """The tracked tool, and a box that is at its start and, in the end, at its end."""
    _, x = hand_x_m(speed_m_s)
    tool = np.tile(np.eye(4), (len(x), 1, 1))
    tool[:, :3, 3] = np.stack([x, 0 * x, 0 * x + 0.03], axis=1) + MARKER_M
    cube = np.tile(np.eye(4), (len(x), 1, 1))
    cube[:, :3, 3] = [BOX_X_M, 0.0, 0.03]
    cube[-1, 0, 3] = box_end_x_m
    tracks = {"/lab/tcp/pose": tool} | ({"/lab/object/cube/pose": cube} if box else {})
    return write_tracks(run, name, tracks, motion)


def write_tracks(
    run: RunFolder, name: str, tracks: dict[str, np.ndarray], motion: ScriptedMotion | None
) -> Path:
    """Poses at 100 Hz as an imported episode."""
    path = run.episodes_dir / f"{name}.mcap"
    path.unlink(missing_ok=True)
    with EpisodeWriter(path) as writer:
        writer.describe(EpisodeInfo(id=name, kind="imported", task="push", cell="lab"))
        for topic, Ts in tracks.items():
            stamps = np.arange(len(Ts)) * 10_000_000
            for stamp_ns, data in zip(
                stamps.tolist(), pose_messages(stamps, "world", Ts), strict=True
            ):
                writer.write(topic, data, type_name=schema.POSE_STAMPED, log_time_ns=stamp_ns)
        if motion is not None:
            writer.add_metadata(RECORD_NAME, motion.to_record())
    return path


TURNING = replace(MOTION, targets=(JointTarget(t_s=0.0, joints_rad={"turn": 0.9}),), boxes={})
DELAY_S, TIP_RAD = 0.45, 0.04
BASE_M = np.array([0.02, -0.015, 0.01])


def write_turning(run: RunFolder, name: str, seed: int) -> None:
    """The hand turns late about an axis that stands askew, 27 mm off; seen with noise of 0.3 mm."""
    at_s = np.arange(250) / 100
    turns = np.clip(0.5 * (at_s - DELAY_S), 0.0, 0.9)  # as the speed's limit has it
    c, s, one = np.cos(turns), np.sin(turns), np.ones_like(turns)
    tool = np.tile(np.eye(4), (len(turns), 1, 1))
    tool[:, :2, :2] = np.moveaxis(np.array([[c, -s], [s, c]]), 2, 0)
    x, y, z = MARKER_M
    tool[:, :3, 3] = np.stack([c * x - s * y - 0.3, s * x + c * y, (0.03 + z) * one], axis=1)
    askew = np.eye(4)
    askew[:3, :3], askew[:3, 3] = turned_about_y(TIP_RAD), BASE_M
    tool = askew @ tool
    tool[:, :3, 3] += np.random.default_rng(seed).normal(scale=3e-4, size=(len(turns), 3))
    write_tracks(run, name, {"/lab/tcp/pose": tool}, TURNING)


def turned_about_y(rad: float) -> Float[np.ndarray, "3 3"]:
    return np.asarray(se3.rotation_from_vector(np.array([0.0, rad, 0.0])))
