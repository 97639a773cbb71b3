"""Camera frames of an episode: when they were taken, and their bytes as recorded."""

import json
from bisect import bisect_left
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from bridge.episode import schema
from bridge.episode.cdr.messages import CompressedColor, RawColor, color_from_message
from bridge.episode.reader import Episode
from bridge.episode.streams import lens_of
from bridge.episode.topics import RECORDED_TOPIC, RENDERED_TOPIC
from dashboards.errors import NotHereError

RENDERED = "rendered:"
"""Before a camera's id: its images as the twin renders them."""
MEDIA_TYPES = ((b"\xff\xd8", "image/jpeg"), (b"\x89PNG\r\n\x1a\n", "image/png"))


@dataclass(frozen=True, kw_only=True)
class CameraTrack:
    """Where the colour frames of one camera lie in the file, ordered by source time."""

    camera_id: str
    topic: str
    stamps_ns: tuple[int, ...]
    log_times_ns: tuple[int, ...]

    def nearest(self, stamp_ns: int) -> int:
        """Return the index of the frame taken closest to an instant."""
        after = bisect_left(self.stamps_ns, stamp_ns)
        around = [index for index in (after - 1, after) if 0 <= index < len(self.stamps_ns)]
        return min(around, key=lambda index: abs(self.stamps_ns[index] - stamp_ns))


def camera_tracks(path: Path) -> dict[str, CameraTrack]:
    """Index the colour frames of every camera in an episode file, by camera id.

    Rendered images of camera ``wrist`` are found under ``rendered:wrist``.
    """
    status = path.stat()
    return _tracks(path, status.st_mtime_ns, status.st_size)


@lru_cache(maxsize=64)
def _tracks(path: Path, _mtime_ns: int, _size: int) -> dict[str, CameraTrack]:
    episode = Episode.open(path)
    names = {
        topic: name
        for topic in (
            *episode.topics_of_type(schema.COMPRESSED_IMAGE),
            *episode.topics_of_type(schema.IMAGE),
        )
        if (name := _camera_of(topic)) is not None
    }
    stamps: dict[str, list[tuple[int, int]]] = {topic: [] for topic in names}
    for message in episode.messages(names):
        stamps[message.topic].append((message.publish_time_ns, message.log_time_ns))
    tracks = {}
    for topic, pairs in stamps.items():
        if not pairs:
            continue
        ordered: Sequence[tuple[int, int]] = sorted(pairs)
        tracks[names[topic]] = CameraTrack(
            camera_id=names[topic],
            topic=topic,
            stamps_ns=tuple(pair[0] for pair in ordered),
            log_times_ns=tuple(pair[1] for pair in ordered),
        )
    return tracks


def _camera_of(topic: str) -> str | None:
    if match := RECORDED_TOPIC.search(topic):
        return match.group(1)
    if match := RENDERED_TOPIC.search(topic):
        return RENDERED + match.group(1)
    return None


def read_frame(path: Path, camera_id: str, stamp_ns: int) -> tuple[bytes, str]:
    """Return the image nearest to an instant and its media type.

    A compressed image without a lens is given as recorded, byte for byte; others become JPEG.

    Args:
        stamp_ns: Source time of the wanted instant [ns].
    """
    track = _track_of(path, camera_id)
    index = track.nearest(stamp_ns)
    _, color = next(_in_one_pass(path, track, index, index), (index, None))
    if color is None:
        text = f"{path.name} changed while it was read; reload the page."
        raise NotHereError(text)
    data = color.as_file()
    return data, media_type(data, path)


MAX_PACKED, MAX_PACKED_BYTES = 600, 48_000_000
"""Of the pictures that a page gets at once; a longer recording is thinned out evenly, and what is
between them is asked for one by one."""


def pack_frames(path: Path, camera_id: str) -> bytes:
    """All pictures of a camera in one answer, so that a page can go through them at once.

    The length of the header (uint32, little-endian), the header in JSON with each picture's place
    in the track, size and media type, then the files one after another.
    """
    track = _track_of(path, camera_id)
    count = len(track.stamps_ns)
    step = -(-count // MAX_PACKED)
    files: dict[int, bytes] = {}
    for index, color in _in_one_pass(path, track, 0, count - 1):
        if index in files or index % step:
            continue
        files[index] = color.as_file()
        if len(files) == 1:
            step = max(step, -(-count * len(files[index]) // MAX_PACKED_BYTES))
    head = {
        "indices": list(files),
        "sizes": [len(data) for data in files.values()],
        "types": [media_type(data, path) for data in files.values()],
    }
    text = json.dumps(head).encode()
    return len(text).to_bytes(4, "little") + text + b"".join(files.values())


def _track_of(path: Path, camera_id: str) -> CameraTrack:
    tracks = camera_tracks(path)
    if camera_id not in tracks:
        found = ", ".join(tracks) or "none"
        text = f"{path.name} has no frames of camera {camera_id!r}. Cameras: {found}."
        raise NotHereError(text)
    return tracks[camera_id]


def read_span(
    path: Path, camera_id: str, start_ns: int, end_ns: int
) -> Iterator[tuple[int, UInt8[np.ndarray, "height width 3"]]]:
    """Yield the sRGB images of a camera between two instants, in one pass through the file.

    Args:
        start_ns: Source time of the first wanted [ns].
        end_ns: Source time of the last wanted [ns].
    """
    track = _track_of(path, camera_id)
    places = [i for i, stamp in enumerate(track.stamps_ns) if start_ns <= stamp <= end_ns]
    if not places:
        return
    for index, color in _in_one_pass(path, track, places[0], places[-1]):
        yield track.stamps_ns[index], color.image_u8()


def _in_one_pass(
    path: Path, track: CameraTrack, first: int, last: int
) -> Iterator[tuple[int, CompressedColor | RawColor]]:
    """Yield the frames from one place in a track to another, with their places."""
    episode = Episode.open(path)
    lens = lens_of(episode, track.camera_id)
    log_ns = track.log_times_ns[first : last + 1]
    places = {track.stamps_ns[place]: place for place in range(first, last + 1)}
    span = {"start_ns": min(log_ns), "end_ns": max(log_ns) + 1}
    for message in episode.messages([track.topic], **span):
        place = places.get(message.publish_time_ns)
        if place is not None:
            yield place, color_from_message(message.type_name, message.data, lens)


def media_type(data: bytes, path: Path) -> str:
    """Name the image format by its first bytes; anything but JPEG and PNG is refused."""
    for magic, name in MEDIA_TYPES:
        if data.startswith(magic):
            return name
    message = f"a frame of {path.name} is neither JPEG nor PNG; the page cannot show it."
    raise NotHereError(message)


def main_camera(path: Path) -> CameraTrack:
    """Return the recorded camera that shows most: the first that is not on the wrist.

    Raises:
        NotHereError: When the recording has no picture.
    """
    tracks = camera_tracks(path)
    names = sorted(name for name in tracks if not name.startswith(RENDERED))
    if not names:
        message = f"no camera images in {path.name}."
        raise NotHereError(message)
    return tracks[min(names, key=lambda name: ("wrist" in name or "hand" in name, name))]
