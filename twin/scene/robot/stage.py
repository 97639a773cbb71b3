"""The robot's part of a rebuild: found in the frames, kept out of the background, kept as links."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float

from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.errors import GstError
from bridge.geometry import se3
from bridge.task.robot import BASE_FRAME
from bridge.terminal import Output
from twin.robot.model import load_robot
from twin.robot.posture import far_apart, posture_track
from twin.scene.align.align import Alignment, align_robot
from twin.scene.align.view import RobotView
from twin.scene.frames.choice import FrameChoice, load, root_frame, spread
from twin.scene.frames.points import DepthLimits, FrameSurface
from twin.scene.gaussians.cloud import GaussianCloud
from twin.scene.robot.frames import RobotFrames
from twin.scene.robot.splats import write_links

MAX_POSTURES = 24
ALIGN_FRAMES = 12
"""Training frames of one camera that are looked at to find the robot in a foreign root frame."""


@dataclass(frozen=True, kw_only=True)
class FoundRobot:
    """The robot of a rebuild; it may be known in no frame at all, which ``remark`` explains."""

    frames: RobotFrames
    remark: str
    alignment: Alignment | None = None
    """Where the scene's root is not the robot's base: how the two were laid onto each other."""


@dataclass(frozen=True, kw_only=True)
class DrivenRobot:
    """Links that stand where the joints of an episode put them."""

    frames: RobotFrames
    links: Mapping[str, GaussianCloud] = field(default_factory=dict)

    def joined(self, cloud: GaussianCloud, episode: Episode, stamp_ns: int) -> GaussianCloud:
        """The scene with the robot in it as it stood at an instant."""
        return self.frames.joined(cloud, self.links, episode, stamp_ns)


def find_robot(choices: Sequence[FrameChoice], output: Output) -> FoundRobot:
    """Say where the robot is in the frames of a rebuild, if that can be said.

    Where the frames' root is the robot's base, the joints say it. In another root frame (poses
    from odometry, another world) scene and robot are aligned by what the training frames show.
    """
    root = root_frame(choices[0])
    episodes = list({choice.episode.path: choice.episode for choice in choices}.values())
    if root == BASE_FRAME:
        frames = RobotFrames(episodes)
        return FoundRobot(frames=frames, remark=frames.remark)
    try:
        alignment = _aligned(choices)
    except GstError as error:
        remark = f"the scene's root is {root!r}, not the robot's base: {error}"
        return FoundRobot(frames=RobotFrames([]), remark=remark)
    output.say(
        f"robot found in frame {root!r}: residual {alignment.residual_m * 1e3:.1f} mm, "
        f"yaw margin {alignment.margin:.1f}"
    )
    frames = RobotFrames(episodes, alignment.T_base_source)
    return FoundRobot(frames=frames, remark=frames.remark, alignment=alignment)


def look_closer(
    found: FoundRobot, choices: Sequence[FrameChoice], limits: DepthLimits, stride: int
) -> None:
    """Collect the robot's surface from frames that cameras standing still have to spare.

    A few of their frames are enough for the background. The robot shows another side in each
    posture, so up to two dozen postures far from each other are read for its links.
    """
    for choice in choices:
        postures = found.frames.still_postures(choice.episode, choice.spare_ns)
        if not choice.still or not postures:
            continue
        stamps, joints = np.array(list(postures)), np.array(list(postures.values()))
        wanted = frozenset(stamps[far_apart(joints, MAX_POSTURES)].tolist())
        for frame in load(choice, wanted):
            points = FrameSurface(frame, limits).points(stride)
            found.frames.collect(choice.episode, frame.stamp_ns, points)


def _aligned(choices: Sequence[FrameChoice]) -> Alignment:
    """Align by the camera that has joints; errors say what is missing."""
    choice = choices[0]
    track = posture_track(choice.episode)
    stamps = spread(np.array(sorted(choice.train_ns), dtype=np.int64), ALIGN_FRAMES)
    wanted = frozenset(stamp for stamp in stamps.tolist() if track.is_still(stamp))
    views = [
        RobotView.from_frame(frame, track.at(frame.stamp_ns), frame.T_base_depth)
        for frame in load(choice, wanted)
    ]
    return align_robot(views, load_robot(track.urdf))


def write_robot(
    run: RunFolder, found: FoundRobot, links: Mapping[str, GaussianCloud]
) -> dict[str, Any]:
    """Write ``robot/<link>.ply`` and return what ``scene.json`` says about the robot."""
    record: dict[str, Any] = {"remark": found.remark, "links": write_links(run, links)}
    if found.alignment is not None:
        record["T_base_root"] = _pose(found.frames.T_base_root)
        record["alignment"] = found.alignment.to_record()
    return {"robot": record}


def _pose(T: Float[np.ndarray, "4 4"]) -> dict[str, list[float]]:
    q, p = se3.split(T)
    return {"p_m": p.tolist(), "q_wxyz": q.tolist()}
