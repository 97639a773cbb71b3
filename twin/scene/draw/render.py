"""Draw the rebuilt scene from a recorded or a given camera pose."""

from typing import Any

import numpy as np
from jaxtyping import Float, Float32, UInt16

from bridge.episode import streams
from bridge.episode.reader import Episode
from bridge.episode.run_folder import RunFolder
from bridge.episode.transforms import TransformTree
from bridge.errors import BridgeError, UsageError
from bridge.geometry import se3
from bridge.geometry.camera import Camera
from bridge.media.color import encode_png
from bridge.task.robot import BASE_FRAME
from twin.scene.draw.compose import carried_camera, compose
from twin.scene.frames.base import base_tree
from twin.scene.frames.camera_poses import calibrated_tree_at
from twin.scene.frames.stated import unknown_mask
from twin.scene.frames.usable import name_of
from twin.scene.raster.backend import open_rasteriser
from twin.scene.raster.rasteriser import RasterConfig
from twin.scene.settings import RenderConfig
from twin.scene.store.calibration import read_calibration
from twin.scene.store.folder import Scene, read_scene

UP = np.array([0.0, 0.0, 1.0])
"""The root frame's z axis points up (table top at z = 0)."""


def render(run: RunFolder, config: RenderConfig) -> dict[str, Any]:
    """Write one PNG of the scene and return what was drawn.

    Raises:
        UsageError: When the episode, the camera or an object is unknown (lists those that exist),
            joints are given for a robot that the scene does not have, or nothing says where the
            camera was in the scene at that time.
        MissingDependencyError: When the backend cuda was asked for and cannot run here.
    """
    rasteriser = open_rasteriser(RasterConfig(backend=config.backend))
    scene = read_scene(run)
    episode = _episode(run, scene, config.episode)
    camera_id = _camera_id(episode, config.camera)
    stamp_ns = _stamp_ns(episode, config.at_s)
    composed = compose(run, scene, episode, stamp_ns, config)
    camera, T_base_camera = _view_of(run, scene, episode, camera_id, stamp_ns, config)
    view = rasteriser.view(composed.cloud, camera, T_base_camera)
    path = config.out or run.results_dir / "render.png"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(encode_png(view.image_u8()))
    written = [str(path)]
    if config.depth:
        depth_path = path.with_name(f"{path.stem}_depth{path.suffix}")
        depth_path.write_bytes(encode_png(_millimetres(view.depth_m)))
        written.append(str(depth_path))
    return {
        "files": written,
        "scene_hash": scene.scene_hash,
        "episode": episode.info.id,
        "camera": camera_id,
        "robot": composed.robot,
        "coverage_fraction": float(view.alpha.mean()),
    }


def _millimetres(depth_m: Float32[np.ndarray, "height width"]) -> UInt16[np.ndarray, "_ _"]:
    """Whole millimetres; what is farther away than they can say is as far as they can."""
    largest = np.iinfo(np.uint16).max
    return np.clip(np.rint(depth_m * 1e3), 0, largest).astype(np.uint16)


def _episode(run: RunFolder, scene: Scene, wanted: str) -> Episode:
    name = wanted or scene.record["sources"][0]["id"]
    episodes: dict[str, Episode] = {}
    for path in run.episodes():
        try:
            episode = Episode.open(path)
        except BridgeError:
            if path.stem == name:
                raise
        else:
            episodes[episode.info.id] = episode
    if name not in episodes:
        message = f"no episode {name!r} in {run.path}. There are: {', '.join(episodes) or 'none'}."
        raise UsageError(message)
    return episodes[name]


def _stamp_ns(episode: Episode, at_s: float) -> int:
    first_ns = streams.first_stamp_ns(episode)
    return (episode.start_ns if first_ns is None else first_ns) + round(at_s * 1e9)


def _camera_id(episode: Episode, wanted: str) -> str:
    ids = streams.camera_ids(episode)
    if not ids or (wanted and wanted not in ids):
        found = ", ".join(ids) or "none"
        message = f"no camera {wanted!r} in episode {episode.info.id}. There are: {found}."
        raise UsageError(message)
    return wanted or ids[0]


def _view_of(
    run: RunFolder,
    scene: Scene,
    episode: Episode,
    camera_id: str,
    stamp_ns: int,
    config: RenderConfig,
) -> tuple[Camera, Float[np.ndarray, "4 4"]]:
    info = streams.camera_info(episode, camera_id)
    if (config.eye is None) != (config.target is None):
        message = "--eye and --target belong together: where to stand, and what to look at."
        raise UsageError(message)
    if config.eye is not None and config.target is not None:
        eye, target = np.array(config.eye), np.array(config.target)
        if np.linalg.norm(np.cross(target - eye, UP)) < 1e-6:
            message = "--eye is straight above or below --target; move it a little sideways."
            raise UsageError(message)
        return info.camera, se3.look_at(eye, target, UP)
    tree = _tree_of(run, scene, episode, camera_id, stamp_ns)
    is_known = info.frame_id in tree.frames()
    root = tree.root_of(info.frame_id) if is_known else None
    if root != scene.record.get("frame", root) or root is None:
        message = (
            f"nothing says where {name_of(episode, camera_id)} was in the scene's frame "
            f"{scene.record.get('frame')!r}: say where to stand with --eye and --target."
        )
        raise UsageError(message)
    if config.joints is not None and root == BASE_FRAME:
        T_base_camera = carried_camera(episode, info.frame_id, np.array(config.joints), tree)
        if T_base_camera is not None:
            return info.camera, T_base_camera
    if unknown_mask(tree, [info.frame_id], np.array([stamp_ns]))[0]:
        message = (
            f"nobody recorded where {name_of(episode, camera_id)} was at --at-s {config.at_s:g}: "
            "choose another time, or say where to stand with --eye and --target."
        )
        raise UsageError(message)
    return info.camera, tree.T_root_frame(info.frame_id, stamp_ns)


def _tree_of(
    run: RunFolder, scene: Scene, episode: Episode, camera_id: str, stamp_ns: int
) -> TransformTree:
    """Poses of a camera, from where the scene has its own."""
    known = scene.record.get("cameras", [])
    if not any((item["id"], item["poses_from"]) == (camera_id, "hand-eye") for item in known):
        return base_tree(episode)
    calibration = read_calibration(run)
    place = None if calibration is None else calibration.cameras.get(camera_id)
    if place is None:
        return base_tree(episode)
    return calibrated_tree_at(episode, camera_id, place, np.array([stamp_ns]))
