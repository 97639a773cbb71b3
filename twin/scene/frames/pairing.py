"""Pairs of colour and depth images of a camera, and whether they can be used at all."""

import numpy as np
from jaxtyping import Int

from bridge.episode import streams
from bridge.episode.cdr.messages import DepthImage, color_from_message
from bridge.episode.reader import Episode
from bridge.errors import BridgeError
from twin.errors import TwinError


def has_depth(episode: Episode, camera_id: str) -> bool:
    """Whether depth images of a camera were recorded."""
    return streams.find_camera_topic(episode, camera_id, "depth/image") is not None


def paired_stamps_ns(episode: Episode, camera_id: str) -> Int[np.ndarray, " num_frames"]:
    """Source stamps of the colour images that ``streams.rgbd_frames`` makes frames of, ascending.

    Colour without depth nearby is not among them, and of two colour images beside one depth image
    only that which gets it. Of a camera without depth, all are.
    """
    if has_depth(episode, camera_id):
        found = {color.stamp_ns for color, _ in streams.rgbd_pairs(episode, camera_id)}
    else:
        found = {color.stamp_ns for color in streams.color_images(episode, camera_id)}
    return np.array(sorted(found), dtype=np.int64)


class UnusableCameraError(TwinError):
    """Nothing can be learnt from one camera; others may do."""


def name_of(episode: Episode, camera_id: str) -> str:
    """The camera, as messages begin with it."""
    return f"camera {camera_id} of episode {episode.info.id}"


def check_camera(episode: Episode, camera_id: str) -> None:
    """Look at the first intrinsics and the first image of colour and depth.

    Raises:
        UnusableCameraError: The lens turns back, intrinsics are missing or of another image size,
            or an image cannot be read.
    """
    for stream in ("color", "depth") if has_depth(episode, camera_id) else ("color",):
        try:
            camera = streams.camera_info(episode, camera_id, stream).camera
            topic = streams.find_camera_topic(episode, camera_id, f"{stream}/image")
            first = next(iter(episode.messages([topic])), None) if topic else None
            if first is None:
                continue
            if stream == "color":
                image = color_from_message(first.type_name, first.data).image_u8()
            else:
                image = DepthImage.from_message(first.type_name, first.data).depth_mm
        except BridgeError as error:
            message = f"{name_of(episode, camera_id)} cannot be used: {error}"
            raise UnusableCameraError(message) from error
        height, width = image.shape[:2]
        if (width, height) != (camera.width, camera.height):
            message = (
                f"{name_of(episode, camera_id)} sends {stream} images of {width} x {height} "
                f"pixels, and {stream}/info is for {camera.width} x {camera.height}. Record it "
                "again with the intrinsics of the images that are sent."
            )
            raise UnusableCameraError(message)
