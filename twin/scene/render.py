"""Draw the rebuilt scene: one image in any state of robot and objects, or a whole episode.

One process draws all frames. The scene is read once; for each frame the links and objects are
moved rigidly, and background, objects and robot are drawn together.
"""

from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from bridge.episode import streams
from bridge.episode.run_folder import RunFolder
from bridge.errors import UsageError
from bridge.geometry.camera import Camera
from bridge.media.color import encode_png
from bridge.media.depth import from_metres
from bridge.media.image_quality import as_float
from bridge.whole_file import write_whole
from twin.robot.model import load_robot
from twin.robot.posture import Posture
from twin.robot.surface import PosedSurface
from twin.scene.frames.pairing import name_of
from twin.scene.movable_scene import Drawn, Frame
from twin.scene.raster.backend import open_rasteriser
from twin.scene.raster.rasteriser import RasterConfig
from twin.scene.settings import RenderConfig
from twin.scene.shape.mesh import Mesh, first_hit
from twin.scene.standpoint import camera_of, camera_places, episode_of, sized_camera
from twin.scene.store.folder import Scene, read_scene
from twin.scene.store.library import NOT_SCANNED
from twin.scene.trial import TrialInScene, open_trial

CRF = 18
"""Quality of the video: hardly to be told from the frames."""
OTHER_FILES = (".avi", ".gif", ".h264", ".jpeg", ".jpg", ".mkv", ".mov", ".webm")
"""Files that somebody may ask for and that are not written."""


def posture_of(trial: TrialInScene, stamp_ns: int) -> tuple[Posture | None, str, str]:
    """How the robot stands: posture or None, its URDF, and where that comes from or why not."""
    track, of = trial.postures, trial.recorded.info.id
    if track is None or not trial.parts.links:
        return None, "", trial.robot
    if not track.covers(stamp_ns):
        return None, "", f"not drawn: {of} has no joints at that time: choose another --at-s."
    return track.at(stamp_ns), track.urdf, trial.robot


def render(run: RunFolder, config: RenderConfig) -> dict[str, Any]:
    """Draw one image of the scene, or a whole episode, and return what was drawn.

    A whole episode becomes a video, or one PNG a frame. Instants at which nobody recorded where
    the camera was are left out.
    """
    _check(config)
    rasteriser = open_rasteriser(RasterConfig(backend=config.backend))
    scene = read_scene(run)
    trial = open_trial(run, scene, episode_of(run, scene, config.episode))
    episode, camera_id = trial.recorded, camera_of(trial.recorded, config.camera)
    camera = sized_camera(streams.camera_info(episode, camera_id).camera, config.size)
    stamps = _stamps(trial, camera_id, config)
    frames = _frames(run, scene, trial, camera_id, stamps, config)
    agreement = ImageAgreement() if config.compare and config.is_sequence else None
    meshes = {} if agreement is None else trial.meshes(run)
    recorded = streams.color_images(episode, camera_id)
    coverage: list[float] = []
    files: list[str] = []
    with _writer(run, config, f"{episode.path.stem}.{camera_id}", stamps) as write:
        for frame in frames:
            drawn = trial.parts.drawn_as(rasteriser, camera, frame)
            image = drawn.marked_u8()
            if agreement is not None:
                before = next(item for item in recorded if item.stamp_ns == frame.stamp_ns)
                image = _beside(agreement, before.image_u8(), drawn, frame, camera, meshes)
            planes = {"": image}
            if config.depth:
                planes |= {
                    "_depth": from_metres(drawn.depth_m),
                    "_seen": drawn.seen_mask * np.uint8(255),
                }
            files = write(frame.stamp_ns - frames[0].stamp_ns, planes)
            coverage.append(float(drawn.alpha.mean()))
    return {
        "files": files,
        "scene_hash": scene.scene_hash,
        "episode": episode.info.id,
        "camera": camera_id,
        "robot": posture_of(trial, int(stamps[0]))[2],
        "frames": len(frames),
        "frames_without_pose": len(stamps) - len(frames),
        "notes": list(trial.notes),
        "not_scanned": sorted(trial.parts.not_scanned),
        "coverage_fraction": float(np.mean(coverage)),
        **({} if agreement is None else {"agreement": agreement.record()}),
    }


def _check(config: RenderConfig) -> None:
    if not config.is_sequence:
        return
    is_video = config.out is None or config.out.suffix.lower() == ".mp4"
    if config.out is not None and config.out.suffix.lower() in OTHER_FILES:
        message = f"--out {config.out}: a whole episode becomes an .mp4 file or a folder of frames."
        raise UsageError(message)
    if is_video and config.depth:
        message = "--depth goes into a folder of frames, not into a video: --out FOLDER."
        raise UsageError(message)
    if config.compare and (config.eye is not None or config.size):
        message = "--compare needs the recorded camera and size: leave out --eye and --size."
        raise UsageError(message)


def _stamps(
    trial: TrialInScene, camera_id: str, config: RenderConfig
) -> Int[np.ndarray, " num_stamps"]:
    """Instants to be drawn: of all images of a camera, or the one that is asked for."""
    episode = trial.recorded
    if not config.is_sequence:
        first_ns = streams.first_stamp_ns(episode)
        began_ns = episode.start_ns if first_ns is None else first_ns
        return np.array([began_ns + round((config.at_s or 0.0) * 1e9)])
    images = streams.color_images(episode, camera_id)
    recorded = np.array([message.stamp_ns for message in images], dtype=np.int64)
    first_ns, last_ns = episode.start_ns, episode.end_ns
    if trial.postures is not None:
        first_ns, last_ns = (int(trial.postures.arm.stamps_ns[k]) for k in (0, -1))
    stamps = recorded[(recorded >= first_ns) & (recorded <= last_ns)]
    if not len(stamps):
        message = f"camera {camera_id} recorded no image in episode {episode.info.id}."
        raise UsageError(message)
    return np.asarray(stamps)


def _frames(
    run: RunFolder,
    scene: Scene,
    trial: TrialInScene,
    camera_id: str,
    stamps_ns: Int[np.ndarray, " num_stamps"],
    config: RenderConfig,
) -> list[Frame]:
    """The instants that can be drawn, in the order of time; at least one."""
    cameras = camera_places(run, scene, trial, camera_id, stamps_ns, config)
    frames = []
    for stamp_ns, T_base_camera in zip(stamps_ns.tolist(), cameras, strict=True):
        if T_base_camera is not None:
            posture, urdf, _ = posture_of(trial, stamp_ns)
            frames.append(
                Frame(
                    stamp_ns=stamp_ns,
                    T_base_camera=T_base_camera,
                    Ts_base_object=trial.places(stamp_ns),
                    posture=posture,
                    urdf=urdf,
                )
            )
    if not frames:
        when = "at any image" if config.is_sequence else f"at --at-s {config.at_s or 0.0:g}"
        message = (
            f"nobody recorded where {name_of(trial.recorded, camera_id)} was {when}: "
            "choose another time, or say where to stand with --eye and --target."
        )
        raise UsageError(message)
    return frames


class ImageAgreement:
    """Collects squared errors over many images: whole, where seen, and by part of the scene.

    Every PSNR is of the squared error over all pixels of its kind in all images, so that an image
    in which a part is small counts little.
    """

    def __init__(self) -> None:
        """Nothing was compared yet."""
        self._squared: dict[str, float] = {}
        self._pixels: dict[str, int] = {}
        self._images = 0

    def add(
        self,
        recorded_u8: UInt8[np.ndarray, "height width 3"],
        drawn_u8: UInt8[np.ndarray, "height width 3"],
        seen_mask: Bool[np.ndarray, "height width"],
        parts: Mapping[str, Bool[np.ndarray, "height width"]],
    ) -> None:
        """Compare one more image."""
        squared = np.square(as_float(recorded_u8) - as_float(drawn_u8)).mean(axis=-1)
        whole = np.ones_like(seen_mask)
        kinds = {"whole": whole, "seen": seen_mask, "unseen": ~seen_mask, **parts}
        for kind, mask in kinds.items():
            self._squared[kind] = self._squared.get(kind, 0.0) + float(squared[mask].sum())
            self._pixels[kind] = self._pixels.get(kind, 0) + int(mask.sum())
        self._images += 1

    def record(self) -> dict[str, Any]:
        """PSNR [dB], share of the pixels and share of the squared error of each kind.

        A kind without pixels, or without any error, has no PSNR: None.
        """
        total, pixels = self._squared.get("whole", 0.0), self._pixels.get("whole", 0)
        return {
            "images": self._images,
            **{
                kind: {
                    "psnr_db": -10.0 * float(np.log10(squared / self._pixels[kind]))
                    if squared > 0 and self._pixels[kind]
                    else None,
                    "pixel_fraction": self._pixels[kind] / pixels,
                    "error_fraction": squared / total if total > 0 else 0.0,
                }
                for kind, squared in self._squared.items()
            },
        }


def _beside(
    agreement: ImageAgreement,
    recorded_u8: UInt8[np.ndarray, "height width 3"],
    drawn: Drawn,
    frame: Frame,
    camera: Camera,
    meshes: Mapping[str, Mesh],
) -> UInt8[np.ndarray, "height three_widths 3"]:
    """Measure one frame, and put recorded image, twin and difference side by side."""
    robot = None
    if frame.posture is not None:
        robot = PosedSurface(load_robot(frame.urdf), frame.posture)
    T, places = frame.T_base_camera, frame.Ts_base_object
    masks = part_masks(camera, T, robot, meshes, places, drawn.not_scanned)
    agreement.add(recorded_u8, drawn.image_u8, drawn.seen_mask, masks)
    difference = np.abs(recorded_u8.astype(np.int16) - drawn.image_u8.astype(np.int16))
    sides = [recorded_u8, drawn.marked_u8(), difference.astype(np.uint8)]
    return np.concatenate(sides, axis=1)


Write = Callable[[int, Mapping[str, np.ndarray]], list[str]]
"""Time since the first frame and its images in; out what lies there then."""


@contextmanager
def _writer(
    run: RunFolder, config: RenderConfig, name: str, stamps_ns: Int[np.ndarray, " num_stamps"]
) -> Iterator[Write]:
    """Write one image, or frames to a video or under the milliseconds since the first one."""
    name = f"{name}.mp4" if config.is_sequence else "render.png"
    out = config.out or run.results_dir / name
    if not config.is_sequence or out.suffix.lower() != ".mp4":
        (out if config.is_sequence else out.parent).mkdir(parents=True, exist_ok=True)

        def write_images(since_ns: int, planes: Mapping[str, np.ndarray]) -> list[str]:
            written = []
            for ending, pixels in planes.items():
                path = out.with_name(f"{out.stem}{ending}.png") if ending else out
                if config.is_sequence:
                    path = out / f"{since_ns // 1_000_000:07d}{ending}.png"
                write_whole(path, encode_png(pixels))
                written.append(str(path))
            return [str(out)] if config.is_sequence else written

        yield write_images
        return
    from bridge.media.video_writer import VideoWriter  # noqa: PLC0415  # the extra [video]

    rate_hz = float(1e9 / np.median(np.diff(stamps_ns))) if len(stamps_ns) > 1 else 1.0
    video: VideoWriter | None = None

    def append(since_ns: int, planes: Mapping[str, np.ndarray]) -> list[str]:
        nonlocal video
        image = planes[""]
        if video is None:
            height, width = image.shape[:2]
            fps = max(1, round(rate_hz))
            video = VideoWriter(out, fps=fps, width=width, height=height, crf=CRF)
        video.write(image, first=since_ns == 0)
        return [str(out)]

    try:
        yield append
    finally:
        if video is not None:
            video.close()


def describe_drawn(drawn: Mapping[str, Any]) -> str:
    """The files, how many frames they hold, and what a reader should know about them."""
    lines = list(drawn["files"])
    if drawn["frames"] > 1:
        lines.append(f"{drawn['frames']} frames of {drawn['episode']}, {drawn['camera']}")
    if drawn["frames_without_pose"]:
        lines.append(
            f"{drawn['frames_without_pose']} left out: nobody recorded where the camera was"
        )
    lines += [f"robot: {drawn['robot']}", *drawn["notes"]]
    if "agreement" in drawn:
        lines.append(describe_agreement(drawn["agreement"]))
    return "\n".join(lines)


def part_masks(
    camera: Camera,
    T_base_camera: Float[np.ndarray, "4 4"],
    robot: PosedSurface | None,
    meshes: Mapping[str, Mesh],
    Ts_base_object: Mapping[str, Float[np.ndarray, "4 4"]],
    not_scanned: Collection[str] = (),
) -> dict[str, Bool[np.ndarray, "height width"]]:
    """Which pixels show robot, objects and background, by the first mesh along each ray.

    Args:
        robot: Its surface as it stands then; None: it is not known.
        not_scanned: Objects that no scan saw: they are objects, and a kind of their own besides.
    """
    rays = camera.rays()
    nothing = np.full(rays.shape[:2], np.inf, dtype=np.float32)
    robot_m = nothing if robot is None else robot.depth_along(rays, T_base_camera)
    objects_m, _ = first_hit(rays, T_base_camera, meshes, Ts_base_object)
    is_robot = np.isfinite(robot_m) & (robot_m <= objects_m)
    is_object = np.isfinite(objects_m) & ~is_robot
    masks = {"robot": is_robot, "objects": is_object, "background": ~is_robot & ~is_object}
    drawn_from_task = {name: mesh for name, mesh in meshes.items() if name in not_scanned}
    if drawn_from_task:
        own_m, _ = first_hit(rays, T_base_camera, drawn_from_task, Ts_base_object)
        masks[NOT_SCANNED] = is_object & (own_m <= objects_m)
    return masks


def describe_agreement(record: Mapping[str, Any]) -> str:
    """One line for each kind of pixel."""
    lines = [f"compared with {record['images']} recorded images:"]
    for kind, found in record.items():
        if kind == "images":
            continue
        psnr = found["psnr_db"]
        text = "undefined (no pixel, or no error)" if psnr is None else f"{psnr:.2f} dB"
        lines.append(
            f"  {kind:<11}{text}, {found['pixel_fraction']:.1%} of the pixels, "
            f"{found['error_fraction']:.1%} of the squared error"
        )
    return "\n".join(lines)
