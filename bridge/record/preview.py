"""Small pictures of the cameras on ``rec/<recorder>/preview/<camera>``, while someone looks."""

import re
import time
from collections.abc import Callable

from bridge.episode import schema
from bridge.episode.cdr import MalformedMessageError
from bridge.episode.records import CompressedColor
from bridge.episode.transcode import COLOR_LAYOUTS, image_header, pixel_rows
from bridge.media.color import UnreadableImageError, decode_color, encode_jpeg
from bridge.record.shedding import Shed
from bridge.wire.errors import WireError
from bridge.wire.publisher import WirePublisher
from bridge.wire.qos import Qos
from bridge.wire.session import WireSample, WireSession

WIDTH = 320
QUALITY = 70
MAX_PREVIEWS = 64
_CAMERA = re.compile(r"/cam/([^/]+)/color/image$")


class Previews:
    """Makes previews on the encoders' threads; every image of every stream passes here."""

    def __init__(
        self, session: WireSession, recorder: str, rate_hz: float, shed: Callable[[], Shed]
    ) -> None:
        """Publish nothing yet.

        Args:
            session: Where to publish.
            recorder: Name of the recorder.
            rate_hz: At most this many a second for each camera; 0 makes none.
            shed: Says how far shedding has gone; previews go first.
        """
        self._session = session
        self._recorder = recorder
        self._period_s = 1 / rate_hz if rate_hz else None
        self._shed = shed
        self._publishers: dict[str, WirePublisher] = {}
        self._names: set[str] = set()
        self._watched: frozenset[str] = frozenset()
        self._next_s: dict[str, float] = {}

    def look(self, topics: list[str]) -> frozenset[str]:
        """Return which image topics somebody watches; called about once a second."""
        if self._period_s is None:
            return self._watched
        for topic in topics[:MAX_PREVIEWS]:
            if topic not in self._publishers and "/depth/" not in topic:
                name = f"/rec/{self._recorder}/preview/{self._name(topic)}"
                try:
                    publisher = self._session.publisher(
                        name, schema.COMPRESSED_IMAGE, qos=Qos.PREVIEW
                    )
                except WireError:  # a name that is no key cannot be watched either
                    continue
                self._publishers[topic] = publisher
        self._watched = frozenset(
            topic for topic, publisher in self._publishers.items() if publisher.has_subscribers()
        )
        return self._watched

    def _name(self, topic: str) -> str:
        found = _CAMERA.search(topic)
        name = found[1] if found else ""
        if not name or name in self._names:  # two cells may call their cameras the same
            name = topic.strip("/").replace("/", "_")
        self._names.add(name)
        return name

    def show(self, sample: WireSample, kind: str) -> None:
        """Send a small copy of an image, if somebody looks and it is time for one."""
        topic = sample.topic
        if topic not in self._watched or kind == "depth" or self._shed() >= Shed.PREVIEWS:
            return
        now_s = time.monotonic()
        if now_s < self._next_s.get(topic, 0.0):
            return
        self._next_s[topic] = now_s + (self._period_s or 0.0)
        try:
            picture = small_picture(sample)
        except (MalformedMessageError, UnreadableImageError, ValueError):
            return
        if picture is not None:
            self._publishers[topic].put(picture.to_cdr(), source_ns=picture.stamp_ns)


def small_picture(sample: WireSample) -> CompressedColor | None:
    """Make a JPEG about ``WIDTH`` pixels wide of a colour image, or None of anything else.

    Raises:
        MalformedMessageError: The message contradicts itself.
        UnreadableImageError: The picture in it is broken.
    """
    if sample.type_name in ("", schema.COMPRESSED_IMAGE):
        original = CompressedColor.from_cdr(sample.data)
        pixels, layout = decode_color(original.data), "RGB"
        stamp_ns, frame_id = original.stamp_ns, original.frame_id
    else:
        header = image_header(sample.data)
        if header.encoding not in COLOR_LAYOUTS:
            return None
        layout, channels = COLOR_LAYOUTS[header.encoding]
        rows = pixel_rows(sample.data, header, channels)
        pixels = rows.reshape(header.height, header.width, channels)
        stamp_ns, frame_id = header.stamp_ns, header.frame_id
    step = -(-pixels.shape[1] // WIDTH)
    data = encode_jpeg(pixels[::step, ::step], QUALITY, layout=layout)
    return CompressedColor(stamp_ns=stamp_ns, frame_id=frame_id, format="jpeg", data=data)
