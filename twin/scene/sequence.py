"""Draw a whole episode: the rebuilt scene with arm and objects where they were at each instant.

One process draws all frames. The scene is read once; for each frame the links and objects are
moved rigidly, and background, objects and robot are drawn together, as for a single image.
"""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from bridge.episode import streams
from bridge.episode.cdr.messages import CompressedColor, RawColor, color_from_message
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.episode.transforms import TransformTree
from bridge.errors import UsageError
from bridge.geometry.camera import Camera
from bridge.media.color import encode_png
from twin.robot.model import load_robot
from twin.robot.posture import Posture
from twin.robot.surface import PosedSurface
from twin.scene.frames.camera_poses import unknown_mask
from twin.scene.image_agreement import (
    ImageAgreement,
    describe_agreement,
    part_masks,
)
from twin.scene.movable_scene import Drawn, MovableScene
from twin.scene.raster.backend import CudaRasteriser, open_rasteriser
from twin.scene.raster.rasteriser import RasterConfig, Rasteriser
from twin.scene.render import (
    camera_of,
    chosen_view,
    depth_image,
    episode_of,
    poses_in_scene,
    sized_camera,
)
from twin.scene.settings import RenderConfig
from twin.scene.shape.mesh import Mesh
from twin.scene.store.folder import Scene, read_scene
from twin.scene.trial import TrialInScene, open_trial

CRF = 18
"""Quality of the video: hardly to be told from the frames."""
OTHER_FILES = (".avi", ".gif", ".h264", ".jpeg", ".jpg", ".mkv", ".mov", ".webm")
"""Files that somebody may ask for and that are not written."""


@dataclass(frozen=True, kw_only=True)
class Frame:
    """One instant as it is to be drawn."""

    stamp_ns: int
    T_base_camera: Float[np.ndarray, "4 4"]
    Ts_base_object: Mapping[str, Float[np.ndarray, "4 4"]]
    posture: Posture | None
    """None: no robot is drawn."""


def frames_of(
    run: RunFolder, scene: Scene, episode: TrialInScene, camera_id: str, config: RenderConfig
) -> Iterator[Frame]:
    """Yield the instants to be drawn, in the order of time."""
    stamps = _stamps(episode, camera_id)
    T_chosen = chosen_view(config)
    frame_id = streams.camera_info(episode.recorded, camera_id).frame_id
    tree: TransformTree | None = None
    unknown = np.zeros(len(stamps), dtype=bool)
    if T_chosen is None:
        tree = poses_in_scene(run, scene, episode.recorded, camera_id, stamps)
        unknown = unknown_mask(tree, [frame_id], stamps)
    for stamp_ns, is_unknown in zip(stamps.tolist(), unknown.tolist(), strict=True):
        if is_unknown:
            episode.unposed.append(stamp_ns)
            continue
        posture = None
        if episode.postures is not None and episode.postures.covers(stamp_ns):
            posture = episode.postures.at(stamp_ns)
        T = T_chosen
        if T is None and tree is not None:
            T = episode.registered(camera_id, tree.T_root_frame(frame_id, stamp_ns))
        if T is not None:
            yield Frame(
                stamp_ns=stamp_ns,
                T_base_camera=T,
                Ts_base_object=episode.places(stamp_ns),
                posture=posture,
            )


def _stamps(episode: TrialInScene, camera_id: str) -> np.ndarray:
    images = recorded_images(episode.recorded, camera_id)
    recorded = np.array([message.stamp_ns for message in images], dtype=np.int64)
    first_ns, last_ns = episode.recorded.start_ns, episode.recorded.end_ns
    if episode.postures is not None:
        first_ns, last_ns = (int(episode.postures.arm.stamps_ns[k]) for k in (0, -1))
    stamps = recorded[(recorded >= first_ns) & (recorded <= last_ns)]
    if not len(stamps):
        message = f"camera {camera_id} recorded no image in episode {episode.recorded.info.id}."
        raise UsageError(message)
    return np.asarray(stamps)


def recorded_images(episode: Episode, camera_id: str) -> Iterator[CompressedColor | RawColor]:
    """Colour images of a camera, in log order."""
    topic = streams.find_camera_topic(episode, camera_id, "color/image")
    for message in episode.messages([] if topic is None else [topic]):
        yield color_from_message(message.type_name, message.data)


def _rate_hz(stamps_ns: np.ndarray) -> float:
    """How many frames come each second; 1 for a single one."""
    return float(1e9 / np.median(np.diff(stamps_ns))) if len(stamps_ns) > 1 else 1.0


def render_sequence(run: RunFolder, config: RenderConfig) -> dict[str, Any]:
    """Draw a whole episode to a video or to one PNG a frame, and return what was drawn."""
    _check(config)
    rasteriser = open_rasteriser(RasterConfig(backend=config.backend))
    scene = read_scene(run)
    episode = open_trial(run, scene, episode_of(run, scene, config.episode))
    camera_id = camera_of(episode.recorded, config.camera)
    info = streams.camera_info(episode.recorded, camera_id)
    artist = Artist(
        rasteriser=rasteriser,
        parts=episode.parts,
        urdf="" if episode.postures is None else episode.postures.urdf,
        camera=sized_camera(info.camera, config.size),
    )
    out = config.out or run.results_dir / f"{episode.recorded.path.stem}.{camera_id}.mp4"
    comparison = _Comparison.start(run, episode) if config.compare else None
    recorded = recorded_images(episode.recorded, camera_id) if config.compare else iter(())
    begun_ns: int | None = None
    stamps: list[int] = []
    with _writer(out, _rate_hz(_stamps(episode, camera_id))) as write:
        for frame in frames_of(run, scene, episode, camera_id, config):
            drawn = artist.draw(frame)
            begun_ns = frame.stamp_ns if begun_ns is None else begun_ns
            image = drawn.marked_u8()
            if comparison is not None:
                before = next(item for item in recorded if item.stamp_ns == frame.stamp_ns)
                image = comparison.add(before.image_u8(), drawn, frame, artist)
            planes = {"": image} | (
                {"_depth": depth_image(drawn.depth_m), "_seen": drawn.seen_u8()}
                if config.depth
                else {}
            )
            write(frame.stamp_ns - begun_ns, planes)
            stamps.append(frame.stamp_ns)
    return {
        "files": [str(out)],
        "scene_hash": scene.scene_hash,
        "episode": episode.recorded.path.stem,
        "camera": camera_id,
        "robot": episode.robot,
        "frames": len(stamps),
        "frames_without_pose": len(episode.unposed),
        "notes": list(episode.notes),
        "not_scanned": sorted(episode.parts.not_scanned),
        **({} if comparison is None else {"agreement": comparison.agreement.record()}),
    }


def _check(config: RenderConfig) -> None:
    is_video = config.out is None or config.out.suffix.lower() == ".mp4"
    if config.out is not None and config.out.suffix.lower() in OTHER_FILES:
        message = f"--out {config.out}: a whole episode becomes an .mp4 file or a folder of frames."
        raise UsageError(message)
    if is_video and config.depth:
        message = "--depth goes into a folder of frames, not into a video: --out FOLDER."
        raise UsageError(message)
    if config.object or config.joints is not None:
        message = (
            "--object and --joints are for one image; an episode says itself where things are. "
            "Choose the image with --at-s."
        )
        raise UsageError(message)
    if config.compare and (config.eye is not None or config.size):
        message = "--compare needs the recorded camera and size: leave out --eye and --size."
        raise UsageError(message)


@dataclass(frozen=True, kw_only=True)
class Artist:
    """Draws frames of one scene through one camera."""

    rasteriser: Rasteriser | CudaRasteriser
    parts: MovableScene
    urdf: str
    camera: Camera

    def draw(self, frame: Frame) -> Drawn:
        """Draw the scene as it was at one instant."""
        cloud = self.parts.at(frame.Ts_base_object, frame.posture, self.urdf)
        return self.parts.draw(self.rasteriser, cloud, self.camera, frame.T_base_camera)


@dataclass(frozen=True, kw_only=True)
class _Comparison:
    """Recorded images beside drawn ones."""

    agreement: ImageAgreement
    meshes: Mapping[str, Mesh]
    not_scanned: frozenset[str]

    @staticmethod
    def start(run: RunFolder, episode: TrialInScene) -> "_Comparison":
        return _Comparison(
            agreement=ImageAgreement(),
            meshes=episode.meshes(run),
            not_scanned=episode.parts.not_scanned,
        )

    def add(
        self,
        recorded_u8: UInt8[np.ndarray, "height width 3"],
        drawn: Drawn,
        frame: Frame,
        artist: Artist,
    ) -> UInt8[np.ndarray, "height three_widths 3"]:
        """Measure one frame, and put recorded image, twin and difference side by side."""
        robot = None
        if frame.posture is not None:
            robot = PosedSurface(load_robot(artist.urdf), frame.posture)
        masks = part_masks(
            artist.camera,
            frame.T_base_camera,
            robot,
            self.meshes,
            frame.Ts_base_object,
            self.not_scanned,
        )
        self.agreement.add(recorded_u8, drawn.image_u8, drawn.seen_mask, masks)
        difference = np.abs(recorded_u8.astype(np.int16) - drawn.image_u8.astype(np.int16))
        sides = [recorded_u8, drawn.marked_u8(), difference.astype(np.uint8)]
        return np.concatenate(sides, axis=1)


Write = Callable[[int, Mapping[str, np.ndarray]], None]


@contextmanager
def _writer(out: Path, rate_hz: float) -> Iterator[Write]:
    """Write frames to a video, or to a folder under the milliseconds since the first."""
    if out.suffix.lower() != ".mp4":
        out.mkdir(parents=True, exist_ok=True)

        def write_images(since_ns: int, planes: Mapping[str, np.ndarray]) -> None:
            for ending, pixels in planes.items():
                name = f"{since_ns // 1_000_000:07d}{ending}.png"
                (out / name).write_bytes(encode_png(pixels))

        yield write_images
        return
    from bridge.media.video_writer import VideoWriter  # noqa: PLC0415  # the extra [video]

    video: VideoWriter | None = None

    def append(since_ns: int, planes: Mapping[str, np.ndarray]) -> None:
        nonlocal video
        image = planes[""]
        if video is None:
            height, width = image.shape[:2]
            fps = max(1, round(rate_hz))
            video = VideoWriter(out, fps=fps, width=width, height=height, crf=CRF)
        video.write(image, first=since_ns == 0)

    try:
        yield append
    finally:
        if video is not None:
            video.close()


def describe_sequence(drawn: Mapping[str, Any]) -> str:
    """The files, how many frames they hold, and what a reader should know about them."""
    lines = [*drawn["files"], f"{drawn['frames']} frames of {drawn['episode']}, {drawn['camera']}"]
    if drawn["frames_without_pose"]:
        lines.append(
            f"{drawn['frames_without_pose']} left out: nobody recorded where the camera was"
        )
    lines += [f"robot: {drawn['robot']}", *drawn["notes"]]
    if "agreement" in drawn:
        lines.append(describe_agreement(drawn["agreement"]))
    return "\n".join(lines)
