"""Pairs of colour and depth images of a camera, and whether they can be used at all.

A scan holds thousands of frames: stamps are read from headers, and only frames that are wanted are
decoded.
"""

from collections.abc import Collection, Iterator

import numpy as np
from jaxtyping import Int

from bridge.episode import streams
from bridge.episode.cdr.codec import decode
from bridge.episode.cdr.messages import DepthImage, color_from_message, stamp_of
from bridge.episode.reader import Episode, RawMessage
from bridge.episode.streams import RgbdFrame
from bridge.episode.transforms import TransformTree
from bridge.errors import BridgeError
from twin.errors import TwinError

Stamped = tuple[int, RawMessage | None]
"""Source stamp [ns] of an image, and the image itself where it is wanted."""


def paired_stamps_ns(episode: Episode, camera_id: str) -> Int[np.ndarray, " num_frames"]:
    """Source stamps of the colour images that ``streams.rgbd_frames`` makes frames of, ascending.

    Colour without depth nearby is not among them, and of two colour images beside one depth image
    only that which gets it.
    """
    found = {color[0] for color, _ in _pairs(episode, camera_id, keep=False)}
    return np.array(sorted(found), dtype=np.int64)


def frames_at(
    episode: Episode, camera_id: str, tree: TransformTree, stamps_ns: Collection[int]
) -> Iterator[RgbdFrame]:
    """Yield those of ``streams.rgbd_frames`` whose colour image carries one of some stamps."""
    wanted = set(stamps_ns)
    if not wanted:
        return
    infos = {name: streams.camera_info(episode, camera_id, name) for name in ("color", "depth")}
    for (stamp, color), (depth_stamp, depth) in _pairs(episode, camera_id, keep=True):
        if stamp not in wanted or color is None or depth is None:
            continue
        wanted.remove(stamp)
        yield RgbdFrame(
            camera_id=camera_id,
            stamp_ns=stamp,
            image_u8=color_from_message(color.type_name, color.data).image_u8(),
            depth_m=DepthImage.from_message(depth.type_name, depth.data).depth_m(),
            color_camera=infos["color"].camera,
            depth_camera=infos["depth"].camera,
            T_base_color=tree.T_root_frame(infos["color"].frame_id, stamp),
            T_base_depth=tree.T_root_frame(infos["depth"].frame_id, depth_stamp),
        )
        if not wanted:
            return


def _pairs(episode: Episode, camera_id: str, *, keep: bool) -> Iterator[tuple[Stamped, Stamped]]:
    """Colour and depth that belong together, in the order in which ``rgbd_frames`` finds them."""
    color, depth = (
        streams.find_camera_topic(episode, camera_id, f"{stream}/image")
        for stream in ("color", "depth")
    )
    colors: list[Stamped] = []
    depths: list[Stamped] = []
    for message in episode.messages([each for each in (color, depth) if each]):
        stamp = stamp_of(decode(message.type_name, message.data))
        item = (stamp, message if keep else None)
        (colors if message.topic == color else depths).append(item)
        paired = _pop_pair(colors, depths)
        if paired is not None:
            yield paired


def _pop_pair(colors: list[Stamped], depths: list[Stamped]) -> tuple[Stamped, Stamped] | None:
    while colors and depths:
        gap_ns = colors[0][0] - depths[0][0]
        if abs(gap_ns) <= streams.PAIRING_TOLERANCE_NS:
            return colors.pop(0), depths.pop(0)
        (depths if gap_ns > 0 else colors).pop(0)
    return None


class UnusableCameraError(TwinError):
    """Nothing can be learnt from one camera; others may do."""


def name_of(episode: Episode, camera_id: str) -> str:
    """The camera, as messages begin with it."""
    return f"camera {camera_id} of episode {episode.info.id}"


def check_camera(episode: Episode, camera_id: str) -> None:
    """Look at the first intrinsics and the first image of colour and depth.

    Raises:
        UnusableCameraError: The lens distorts, intrinsics are missing or of another image size, or
            an image cannot be read.
    """
    for stream in ("color", "depth"):
        try:
            camera = streams.camera_info(episode, camera_id, stream).camera
            size = _first_size(episode, camera_id, stream)
        except BridgeError as error:
            message = f"{name_of(episode, camera_id)} cannot be used: {error}"
            raise UnusableCameraError(message) from error
        if size is not None and size != (camera.width, camera.height):
            message = (
                f"{name_of(episode, camera_id)} sends {stream} images of {size[0]} x {size[1]} "
                f"pixels, and {stream}/info is for {camera.width} x {camera.height}. Record it "
                "again with the intrinsics of the images that are sent."
            )
            raise UnusableCameraError(message)


def _first_size(episode: Episode, camera_id: str, stream: str) -> tuple[int, int] | None:
    """Width and height of the first image; None without any."""
    topic = streams.find_camera_topic(episode, camera_id, f"{stream}/image")
    for message in episode.messages([topic] if topic else []):
        if stream == "color":
            height, width = color_from_message(message.type_name, message.data).image_u8().shape[:2]
        else:
            height, width = DepthImage.from_message(message.type_name, message.data).depth_mm.shape
        return width, height
    return None
