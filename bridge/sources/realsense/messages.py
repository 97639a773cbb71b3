"""RealSense frames and calibration as messages of an episode."""

from bridge.clock import split_ns
from bridge.episode import cdr, schema
from bridge.episode.message import StampedMessage
from bridge.episode.records import (
    CameraInfo,
    CompressedColor,
    DepthImage,
    FrameTransform,
    transforms_to_cdr,
)
from bridge.media.color import encode_jpeg
from bridge.sources.realsense.config import RealSenseConfig
from bridge.sources.realsense.frames import Calibration, ColorFrame, DepthFrame
from bridge.sources.realsense.mounts import Mount


class CameraMessages:
    """Makes the messages of one camera."""

    def __init__(self, config: RealSenseConfig, camera: str) -> None:
        """Name its topics and frames."""
        self._config = config
        self.root = f"/{config.cell}/cam/{camera}"
        self.color_frame = f"{camera}_color_optical"
        self.depth_frame = f"{camera}_depth_optical"

    def topic_and_type(self, stream: str) -> tuple[str, str]:
        """Topic and type of a stream's images."""
        raw = stream == "depth" or self._config.color == "raw"
        return f"{self.root}/{stream}/image", schema.IMAGE if raw else schema.COMPRESSED_IMAGE

    def facts(
        self, calibration: Calibration, mount: Mount | None, stamp_ns: int
    ) -> list[StampedMessage]:
        """Intrinsics of both streams, and where depth and colour are."""
        transforms = [
            FrameTransform(
                stamp_ns=stamp_ns,
                parent=self.color_frame,
                child=self.depth_frame,
                T_parent_child=calibration.T_color_depth,
            )
        ]
        if mount is not None:
            parent, T_parent_color = mount
            transforms.append(
                FrameTransform(
                    stamp_ns=stamp_ns,
                    parent=parent,
                    child=self.color_frame,
                    T_parent_child=T_parent_color,
                )
            )
        made = [("/tf_static", schema.TF_MESSAGE, transforms_to_cdr(transforms))]
        for stream, frame_id, camera in (
            ("color", self.color_frame, calibration.color_camera),
            ("depth", self.depth_frame, calibration.depth_camera),
        ):
            info = CameraInfo(stamp_ns=stamp_ns, frame_id=frame_id, camera=camera)
            made.append((f"{self.root}/{stream}/info", schema.CAMERA_INFO, info.to_cdr()))
        return [
            StampedMessage(topic=topic, type_name=type_name, data=data, stamp_ns=stamp_ns)
            for topic, type_name, data in made
        ]

    def color(self, frame: ColorFrame) -> bytes:
        """Serialise a colour image, compressed or as it is."""
        if self._config.color == "jpeg":
            return CompressedColor(
                stamp_ns=frame.stamp_ns,
                frame_id=self.color_frame,
                format="jpeg",
                data=encode_jpeg(frame.image_u8, self._config.quality, subsampling="420"),
            ).to_cdr()
        height, width, _ = frame.image_u8.shape
        sec, nanosec = split_ns(frame.stamp_ns)
        message = {
            "header": {
                "stamp": {"sec": sec, "nanosec": nanosec},
                "frame_id": self.color_frame,
            },
            "height": height,
            "width": width,
            "encoding": "rgb8",
            "step": 3 * width,
            "data": frame.image_u8.tobytes(),
        }
        return cdr.encode(schema.IMAGE, message)

    def depth(self, frame: DepthFrame) -> bytes:
        """Serialise a depth image."""
        return DepthImage(
            stamp_ns=frame.stamp_ns, frame_id=self.depth_frame, depth_mm=frame.depth_mm
        ).to_cdr()
