"""H.264 beside the pictures: one ``.../preview`` topic for each colour stream, for people only."""

from dataclasses import replace

import numpy as np

from bridge.episode import schema
from bridge.episode.cdr import MalformedMessageError
from bridge.episode.records import CompressedColor
from bridge.episode.transcode import COLOR_LAYOUTS, image_header, pixel_rows
from bridge.episode.video import video_message
from bridge.media.color import UnreadableImageError, decode_color
from bridge.media.video import H264Encoder, VideoEncodingError
from bridge.wire.session import WireSample

RATE_HZ = 30.0
"""What the encoder plans with; the true rate may differ."""
_ORDER = {"BGR": [2, 1, 0], "RGBA": [0, 1, 2], "BGRA": [2, 1, 0], "GRAY": [0, 0, 0]}


class VideoStreams:
    """One encoder for each colour stream; each is used by its stream's thread alone."""

    def __init__(self) -> None:
        """Check that videos can be made at all.

        Raises:
            MissingDependencyError: When PyAV is not installed.
        """
        H264Encoder(64, 64, RATE_HZ)
        self._encoders: dict[str, tuple[tuple[int, ...], H264Encoder]] = {}

    def frame(self, sample: WireSample) -> WireSample | None:
        """Return the video frame that goes with a colour image; None when it cannot be one."""
        try:
            pixels, stamp_ns, frame_id = _pixels(sample)
            size, encoder = self._encoders.get(sample.topic, ((), None))
            if encoder is None or size != pixels.shape:
                encoder = H264Encoder(pixels.shape[1], pixels.shape[0], RATE_HZ)
                self._encoders[sample.topic] = (pixels.shape, encoder)
            data = encoder.encode(pixels, stamp_ns)
        except (MalformedMessageError, UnreadableImageError, VideoEncodingError):
            return None
        return replace(
            sample,
            topic=preview_topic(sample.topic),
            type_name=schema.COMPRESSED_VIDEO,
            message_encoding="protobuf",
            type_hash="",
            data=video_message(stamp_ns, frame_id, data),
        )


def preview_topic(topic: str) -> str:
    """Name the video of an image topic: ``.../color/image`` has ``.../color/preview``."""
    return topic.removesuffix("/image") + "/preview"


def _pixels(sample: WireSample) -> tuple[np.ndarray, int, str]:
    if sample.type_name == schema.COMPRESSED_IMAGE:
        image = CompressedColor.from_cdr(sample.data)
        return decode_color(image.data), image.stamp_ns, image.frame_id
    header = image_header(sample.data)
    layout, channels = COLOR_LAYOUTS[header.encoding]
    rows = pixel_rows(sample.data, header, channels)
    pixels = rows.reshape(header.height, header.width, channels)
    if layout in _ORDER:
        pixels = pixels[..., _ORDER[layout]]
    return pixels, header.stamp_ns, header.frame_id
