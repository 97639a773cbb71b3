"""Follow a hand-held RGB-D camera by its own images, where nobody recorded poses.

Each frame is laid onto the last keyframe by Open3D's hybrid photometric and geometric odometry
(Park, Zhou, Koltun 2017); keyframes that see the same surface again are tied together, and the pose
graph is solved (Choi, Zhou, Koltun 2015). The gauge is the first keyframe.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from bridge.episode.streams import RgbdFrame
from bridge.geometry import se3
from bridge.terminal import Advance
from twin.scene.frames.downscaled import DownscaledDepth, colors_in_depth, downscaled_depth, meet
from twin.scene.frames.pairing import UnusableCameraError

WIDTH_PX = 320
"""Images are thinned to about this width."""
DEPTH_DIFFERENCE_M = 0.07
"""Pixels whose depths differ by more under the present guess are not the same point."""
KEY_SHIFT_M = 0.12
KEY_TURN_RAD = 0.2
"""A camera that has come this far from its keyframe gets a new one."""
MIN_OVERLAP = 0.3
MIN_AGREEMENT = 0.5
MIN_LIKENESS = 0.6
"""A pose is accepted when two images meet and agree by these shares, and their brightness
correlates: depth alone lets a plane slide along itself."""
PYRAMID = (20, 20, 10, 5)
"""Iterations per level, the coarsest first."""
LOOP_SHIFT_M = 0.6
LOOP_TURN_RAD = 0.6
"""Keyframes nearer to each other than both are tied."""
MAX_LOOPS = 30
MIN_PLACED = 0.5
"""With a smaller share of frames placed, the camera counts as lost."""


@dataclass(frozen=True, kw_only=True)
class Step:
    """One image laid onto another."""

    T_target_source: Float[np.ndarray, "4 4"]
    information: Float[np.ndarray, "6 6"]
    score: float
    """Agreement of depth times likeness of brightness."""


@dataclass(frozen=True, kw_only=True)
class Look:
    """What is kept of one frame."""

    small: DownscaledDepth
    image: Any


class Aligner:
    """Lays one RGB-D image onto another."""

    def __init__(self, max_depth_m: float) -> None:
        """Load Open3D."""
        import open3d  # noqa: PLC0415  # heavy, and only scans without poses need it

        self.max_depth_m = max_depth_m
        self.open3d: Any = open3d
        self._term = open3d.pipelines.odometry.RGBDOdometryJacobianFromHybridTerm()
        self._option = open3d.pipelines.odometry.OdometryOption(
            iteration_number_per_pyramid_level=open3d.utility.IntVector(PYRAMID),
            depth_diff_max=DEPTH_DIFFERENCE_M,
            depth_min=0.05,
            depth_max=max_depth_m,
        )

    def look(self, frame: RgbdFrame) -> Look:
        """Thin a frame; colour is looked up for each depth pixel."""
        small = downscaled_depth(frame, WIDTH_PX)
        step = round(frame.depth_camera.fx / small.camera.fx)
        colors = np.ascontiguousarray(colors_in_depth(frame, step))
        small = replace(small, grey=colors.mean(axis=2, dtype=np.float32))
        image = self.open3d.geometry.RGBDImage.create_from_color_and_depth(
            self.open3d.geometry.Image(colors),
            self.open3d.geometry.Image(np.ascontiguousarray(small.depth_m)),
            depth_scale=1.0,
            depth_trunc=self.max_depth_m,
            convert_rgb_to_intensity=True,
        )
        return Look(small=small, image=image)

    def lay(self, source: Look, target: Look, T_guess: Float[np.ndarray, "4 4"]) -> Step | None:
        """Lay one frame onto another, from a guess; None when they then disagree."""
        camera = source.small.camera
        success, T, information = self.open3d.pipelines.odometry.compute_rgbd_odometry(
            source.image,
            target.image,
            self.open3d.camera.PinholeCameraIntrinsic(
                camera.width, camera.height, *camera.to_ros()
            ),
            T_guess,
            self._term,
            self._option,
        )
        T = np.array(T)
        if not success or not np.isfinite(T).all():
            return None
        met = meet(source.small, target.small, T)
        if met.overlap < MIN_OVERLAP or met.agreement < MIN_AGREEMENT:
            return None
        if met.likeness < MIN_LIKENESS:
            return None
        score = met.agreement * met.likeness
        return Step(T_target_source=T, information=np.array(information), score=score)


SURE = 0.9
"""A frame that fits this nearly as well as the one before needs no second guess."""


class LostError(UnusableCameraError):
    """The camera cannot be followed by its images."""


@dataclass(frozen=True, kw_only=True)
class CameraPath:
    """Poses of the depth camera in the frame of the first keyframe."""

    Ts_first_depth: Mapping[int, Float[np.ndarray, "4 4"]]
    """By colour stamp [ns]; frames that could not be placed are missing."""
    quality: Mapping[str, Any]
    """Counts, and the share of depth that agrees between neighbouring keyframes."""


@dataclass(frozen=True, kw_only=True)
class Keyframe:
    """A frame others are laid onto."""

    look: Look
    T_first_key: Float[np.ndarray, "4 4"]
    from_previous: Step | None
    """How it lies to the keyframe before it."""


class _Follower:
    """Goes through the frames in time order."""

    def __init__(self, aligner: Aligner) -> None:
        self.aligner = aligner
        self.keys: list[Keyframe] = []
        self.places: dict[int, tuple[int, np.ndarray]] = {}
        """Keyframe and ``T_key_frame`` of each placed frame."""
        self._last: tuple[Look, Step] | None = None
        self._motion = np.eye(4)
        self._early: list[Look] = []

    def take(self, look: Look, *, held_out: bool) -> None:
        """Place one frame; one that is held out leaves no trace in what comes after."""
        if not self.keys:
            if held_out:
                self._early.append(look)
                return
            self._begin(look)
            return
        step = self._place(look, may_promote=not held_out)
        if step is None:
            self._motion = self._motion if held_out else np.eye(4)
            return
        self.places[look.small.stamp_ns] = (len(self.keys) - 1, step.T_target_source)
        if not held_out:
            before = np.eye(4) if self._last is None else self._last[1].T_target_source
            self._motion = se3.invert(before) @ step.T_target_source
            self._last = (look, step)
            turn = float(se3.rotation_angle_rad(step.T_target_source[:3, :3]))
            shift = float(np.linalg.norm(step.T_target_source[:3, 3]))
            if turn > KEY_TURN_RAD or shift > KEY_SHIFT_M:
                self._promote()

    def _begin(self, look: Look) -> None:
        self.keys.append(Keyframe(look=look, T_first_key=np.eye(4), from_previous=None))
        self.places[look.small.stamp_ns] = (0, np.eye(4))
        for early in self._early:
            self.take(early, held_out=True)

    def _place(self, look: Look, *, may_promote: bool) -> Step | None:
        """Lay a frame onto the keyframe, or else onto the last frame, made a keyframe."""
        last = np.eye(4) if self._last is None else self._last[1].T_target_source
        best = self._best(look, (last @ self._motion, last))
        if best is not None or not may_promote or self._last is None:
            return best
        self._promote()
        return self._best(look, (self._motion, np.eye(4)))

    def _best(self, look: Look, guesses: tuple[np.ndarray, ...]) -> Step | None:
        """The better of what several guesses lead to: with the motion so far, and without."""
        usual = 0.0 if self._last is None else SURE * self._last[1].score
        found = []
        for guess in guesses:
            step = self.aligner.lay(look, self.keys[-1].look, guess)
            if step is not None:
                found.append(step)
                if 0.0 < usual <= step.score:
                    break
        return max(found, key=lambda step: step.score) if found else None

    def _promote(self) -> None:
        """Make the last frame a keyframe."""
        if self._last is None:
            return
        look, step = self._last
        T_first_key = self.keys[-1].T_first_key @ step.T_target_source
        self.keys.append(Keyframe(look=look, T_first_key=T_first_key, from_previous=step))
        self.places[look.small.stamp_ns] = (len(self.keys) - 1, np.eye(4))
        self._last = None


def follow_camera(
    frames: Iterable[RgbdFrame],
    held_out_ns: frozenset[int],
    max_depth_m: float,
    advance: Advance,
    *,
    name: str = "this camera",
) -> CameraPath:
    """Follow a camera through its frames.

    Args:
        frames: In time order; their poses are not looked at, except how colour lies to depth.
    """
    aligner = Aligner(max_depth_m)
    follower = _Follower(aligner)
    total = 0
    for total, frame in enumerate(frames, start=1):
        follower.take(aligner.look(frame), held_out=frame.stamp_ns in held_out_ns)
        advance(total, f"{len(follower.keys)} keyframes")
    if not follower.keys or len(follower.places) < max(2, MIN_PLACED * total):
        message = (
            f"/tf has no poses for {name}, and RGB-D odometry could place only "
            f"{len(follower.places)} of its {total} frames. Record the camera's poses on /tf, or "
            "scan again slowly with textured surfaces near the camera."
        )
        raise LostError(message)
    loops = _find_loops(follower.keys, aligner)
    Ts_first_key = _solve(follower.keys, loops, aligner)
    return CameraPath(
        Ts_first_depth={
            stamp_ns: Ts_first_key[index] @ T_key_frame
            for stamp_ns, (index, T_key_frame) in sorted(follower.places.items())
        },
        quality={
            "keyframes": len(follower.keys),
            "loop_closures": len(loops),
            "agreement": round(_agreement(follower.keys, Ts_first_key), 4),
        },
    )


def _find_loops(keys: list[Keyframe], aligner: Aligner) -> list[tuple[int, int, Step]]:
    """Tie keyframes that see the same place, but do not follow each other; nearest first.

    Each with its source, its target and how the source lies to the target.
    """
    near = []
    for target in range(len(keys)):
        for source in range(target + 2, len(keys)):
            guess = se3.invert(keys[target].T_first_key) @ keys[source].T_first_key
            shift = float(np.linalg.norm(guess[:3, 3]))
            turn = float(se3.rotation_angle_rad(guess[:3, :3]))
            if shift < LOOP_SHIFT_M and turn < LOOP_TURN_RAD:
                near.append((shift + 0.5 * turn, source, target, guess))
    near.sort(key=lambda item: item[:3])
    loops = []
    for _, source, target, guess in near[:MAX_LOOPS]:
        step = aligner.lay(keys[source].look, keys[target].look, guess)
        if step is not None:
            loops.append((source, target, step))
    return loops


def _solve(
    keys: list[Keyframe], loops: list[tuple[int, int, Step]], aligner: Aligner
) -> list[Float[np.ndarray, "4 4"]]:
    """Spread what the loops say over the path; the first keyframe stays."""
    if not loops:
        return [key.T_first_key for key in keys]
    tools = aligner.open3d.pipelines.registration
    graph = tools.PoseGraph()
    graph.nodes.extend([tools.PoseGraphNode(key.T_first_key) for key in keys])
    for index, key in enumerate(keys):
        if key.from_previous is not None:
            graph.edges.append(_edge(tools, index, index - 1, key.from_previous, uncertain=False))
    for source, target, step in loops:
        graph.edges.append(_edge(tools, source, target, step, uncertain=True))
    tools.global_optimization(
        graph,
        tools.GlobalOptimizationLevenbergMarquardt(),
        tools.GlobalOptimizationConvergenceCriteria(),
        tools.GlobalOptimizationOption(
            max_correspondence_distance=DEPTH_DIFFERENCE_M,
            edge_prune_threshold=0.25,
            reference_node=0,
        ),
    )
    T_key_first = se3.invert(np.array(graph.nodes[0].pose))
    return [T_key_first @ np.array(node.pose) for node in graph.nodes]


def _edge(tools: Any, source: int, target: int, step: Step, *, uncertain: bool) -> Any:
    return tools.PoseGraphEdge(
        source, target, step.T_target_source, step.information, uncertain=uncertain
    )


def _agreement(keys: list[Keyframe], Ts_first_key: list[np.ndarray]) -> float:
    """Mean share of the depth that agrees between neighbouring keyframes."""
    met = [
        meet(
            keys[i + 1].look.small,
            keys[i].look.small,
            se3.invert(Ts_first_key[i]) @ Ts_first_key[i + 1],
        ).agreement
        for i in range(len(keys) - 1)
    ]
    return float(np.mean(met)) if met else 1.0
