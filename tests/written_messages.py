"""What cameras and robots send, written into an episode as a recorder would."""

import numpy as np

from bridge.episode import schema
from bridge.episode.cdr import codec
from bridge.episode.cdr import messages as ros
from bridge.episode.streams import RgbdFrame
from bridge.episode.writer import EpisodeWriter
from bridge.media.color import encode_jpeg

Sent = ros.CameraInfo | ros.CompressedColor | ros.DepthImage | ros.JointSample | ros.PoseSample
KINDS = {
    ros.CameraInfo: schema.CAMERA_INFO,
    ros.CompressedColor: schema.COMPRESSED_IMAGE,
    ros.DepthImage: schema.IMAGE,
    ros.JointSample: schema.JOINT_STATE,
    ros.PoseSample: schema.POSE_STAMPED,
}
STAMP = {"sec": 1_700_000_000, "nanosec": 123_456_789}
STAMP_NS = 1_700_000_000_123_456_789


def raw_image(pixels: np.ndarray, encoding: str, **fields: object) -> bytes:
    """A sensor_msgs/Image; ``fields`` replace what would be true."""
    height, width = pixels.shape[:2]
    message = {
        "header": {"stamp": STAMP, "frame_id": "camera"},
        "height": height,
        "width": width,
        "encoding": encoding,
        "is_bigendian": 0,
        "step": pixels[0].nbytes if height else 0,
        "data": pixels.tobytes(),
        **fields,
    }
    return codec.encode(schema.IMAGE, message)


def put(writer: EpisodeWriter, topic: str, record: Sent, stamp_ns: int) -> None:
    writer.write(topic, record.to_cdr(), type_name=KINDS[type(record)], log_time_ns=stamp_ns)


def put_calibration(
    writer: EpisodeWriter, frame: RgbdFrame, topic: str, root: str | None = "base_link"
) -> None:
    """Lenses of a camera that stands still, and where it stands if anybody knows."""
    names = {stream: f"{frame.camera_id}_{stream}_optical" for stream in ("color", "depth")}
    for stream, camera in (("color", frame.color_camera), ("depth", frame.depth_camera)):
        info = ros.CameraInfo(stamp_ns=0, frame_id=names[stream], camera=camera)
        put(writer, f"{topic}/{stream}/info", info, 0)
    if root is not None:
        tf = [
            ros.FrameTransform(stamp_ns=0, parent=root, child=names[stream], T_parent_child=T)
            for stream, T in (("color", frame.T_base_color), ("depth", frame.T_base_depth))
        ]
        data = ros.transforms_to_cdr(tf)
        writer.write("/tf_static", data, type_name=schema.TF_MESSAGE, log_time_ns=0)


def depth_image(stamp_ns: int, frame_id: str, depth_m: np.ndarray) -> ros.DepthImage:
    """In whole millimetres."""
    depth_mm = np.rint(depth_m * 1e3).astype(np.uint16)
    return ros.DepthImage(stamp_ns=stamp_ns, frame_id=frame_id, depth_mm=depth_mm)


def put_frame(writer: EpisodeWriter, frame: RgbdFrame, topic: str, stamp_ns: int) -> None:
    """Colour and depth of one instant."""
    jpeg, name = encode_jpeg(frame.image_u8), f"{frame.camera_id}_color_optical"
    color = ros.CompressedColor(stamp_ns=stamp_ns, frame_id=name, format="jpeg", data=jpeg)
    put(writer, f"{topic}/color/image", color, stamp_ns)
    depth = depth_image(stamp_ns, f"{frame.camera_id}_depth_optical", frame.depth_m)
    put(writer, f"{topic}/depth/image", depth, stamp_ns)
