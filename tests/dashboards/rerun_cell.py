"""A run with everything that the Rerun file shows, made for tests."""

from collections.abc import Sequence
from pathlib import Path
from types import ModuleType

import numpy as np

from bridge.episode import schema
from bridge.episode.cdr import messages
from bridge.episode.metadata import Derived, EpisodeInfo
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.episode.topics import TRUTH, object_topic
from bridge.episode.writer import EpisodeWriter
from bridge.geometry import se3
from bridge.geometry.camera import Camera
from bridge.media.color import encode_jpeg
from bridge.robots.default import ARM_JOINTS

CUBE_STL = """solid s
facet normal 0 0 1
outer loop
vertex 0 0 0
vertex 0.1 0 0
vertex 0 0.1 0
endloop
endfacet
endsolid s
"""
T_BASE_CAMERA = se3.look_at(np.array([1.0, 0.2, 0.8]), np.zeros(3), np.array([0.0, 0.0, 1.0]))
CAMERA = Camera(width=16, height=12, fx=20.0, fy=21.0, cx=8.25, cy=6.5)
SECOND_NS = 1_000_000_000


def urdf(mesh: Path) -> str:
    """A world above ``base_link``, one arm joint, a mesh and a box."""
    return f"""<robot name="two"><link name="world"/>
<joint name="fix" type="fixed"><parent link="world"/><child link="base_link"/>
<origin xyz="0 0 5"/></joint>
<link name="base_link"><visual><geometry><mesh filename="{mesh}"/></geometry></visual>
<collision><geometry><mesh filename="package://nowhere/x.stl"/></geometry></collision></link>
<joint name="{ARM_JOINTS[0]}" type="revolute"><parent link="base_link"/><child link="arm"/>
<axis xyz="0 0 1"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
<link name="arm"><visual><geometry><box size="0.1 0.1 0.1"/></geometry></visual></link></robot>"""


def write_cell_run(folder: Path, synthetic: ModuleType) -> RunFolder:
    """One trial with camera, robot, truth and replays."""
    run = RunFolder.create(folder / "cell")
    mesh = folder / "part.stl"
    mesh.write_text(CUBE_STL)
    trial = synthetic.TRIALS[0]
    source = RunFolder.create(folder / "source")
    recorded = synthetic.write_trial(source, trial, images=False)
    path = run.episodes_dir / recorded.name
    with EpisodeWriter(path) as writer:
        opened = Episode.open(recorded)
        writer.describe(opened.info, outcome=opened.outcome)
        synthetic.copy_messages(opened, writer)
        for topic, type_name, data, ns in extra(synthetic.START_NS, urdf(mesh)):
            writer.write(topic, data, type_name=type_name, log_time_ns=ns, publish_time_ns=ns)
    synthetic.write_replay(run, trial, "planned", False)
    synthetic.write_replay(run, trial, "executed", False)
    return run


def extra(start: int, description: str) -> list[tuple[str, str, bytes, int]]:
    """Two frames of a moving camera, the robot description, and truth nobody may show."""
    info = messages.CameraInfo(stamp_ns=start, frame_id="hand_color_optical", camera=CAMERA)
    found = [
        ("/robot_description", schema.STRING, messages.string_to_cdr(description), start),
        ("/standin/cam/hand/color/info", schema.CAMERA_INFO, info.to_cdr(), start),
        ("/standin/cam/hand/depth/info", schema.CAMERA_INFO, info.to_cdr(), start),
    ]
    for index in range(2):
        ns = start + index * SECOND_NS
        T = T_BASE_CAMERA.copy()
        T[0, 3] += 0.1 * index
        moved = messages.FrameTransform(
            stamp_ns=ns, parent="base_link", child="hand_color_optical", T_parent_child=T
        )
        image = np.full((12, 16, 3), 60 * index, dtype=np.uint8)
        color = messages.CompressedColor(
            stamp_ns=ns, frame_id="hand_color_optical", format="jpeg", data=encode_jpeg(image)
        )
        depth = messages.DepthImage(
            stamp_ns=ns,
            frame_id="hand_color_optical",
            depth_mm=np.full((12, 16), 700 + index, dtype=np.uint16),
        )
        truth = messages.PoseSample(stamp_ns=ns, frame_id="base_link", T_frame_body=np.eye(4))
        found += [
            ("/tf", schema.TF_MESSAGE, messages.transforms_to_cdr([moved]), ns),
            ("/standin/cam/hand/color/image", schema.COMPRESSED_IMAGE, color.to_cdr(), ns),
            ("/standin/cam/hand/depth/image", schema.IMAGE, depth.to_cdr(), ns),
            (object_topic(TRUTH, "secret", "pose"), schema.POSE_STAMPED, truth.to_cdr(), ns),
        ]
    return found


def write_localised(
    run: RunFolder, episode: str, start: int, p_m: Sequence[float] = (0.4, 0.1, 0.02)
) -> None:
    """Where the twin found the cube, and that it did not find the box."""
    pose = {"p_m": list(p_m), "q_wxyz": [1.0, 0.0, 0.0, 0.0]}
    with EpisodeWriter(run.derived_dir / f"{episode}.localised.0a0b.mcap") as writer:
        writer.describe(
            EpisodeInfo(id=episode, kind="trial"),
            derived=Derived(kind="localised", source_episode=episode, source_sha256=""),
        )
        for name, T in (("cube", pose), ("box", None)):
            record = {
                "schema_version": 1,
                "stamp_ns": start,
                "object": name,
                "found": T is not None,
                "T_base_object": T,
                "covariance": None,
                "confidence": 0.5,
                "method": "test",
                "reason": None if T else "hidden",
            }
            writer.write(
                "/standin/localisation", record, type_name=schema.LOCALISATION, log_time_ns=start
            )
