"""Names that drivers of cameras give their topics, and what an episode calls them."""

import re
from collections.abc import Iterable, Mapping, Sequence

from bridge.episode import schema
from bridge.episode.topics import CAMERAS, COLOR_TOPIC
from bridge.errors import UsageError

_IMAGES = {schema.IMAGE, schema.COMPRESSED_IMAGE}
_RAW = r"(?:/image(?:_(?:raw|color|rect|rect_color|rect_raw))?|/color/rect/image)"
_STREAMS = {
    "color": (r"/(?:color|rgb|left)", _RAW + "(?:/compressed)?"),
    "depth": (
        r"/(?:aligned_depth_to_color|depth_registered|depth_to_rgb|depth)",
        f"(?:{_RAW}|/depth_registered)(?:/compressedDepth)?",
    ),
}
"""Of RealSense, ZED, Azure, Orbbec, OpenNI and Kinect: the stream, and its images."""
_ALIGNED = ("aligned_depth_to_color", "depth_registered", "depth_to_rgb")


def mapped(types: Mapping[str, str], asked: Sequence[str] = ()) -> dict[str, str]:
    """Say under which name each topic goes into an episode: as asked (OLD=NEW), or of a camera."""
    names = dict(_pair(text, types) for text in asked)
    if len({*names.values()}) < len(names):
        raise UsageError(f"two topics get one name: {', '.join(asked)}. Give each its own.")
    if any(COLOR_TOPIC.search(topic) for topic in types) or asked:
        return names
    aligned = {topic for topic in types for word in _ALIGNED if word in topic}
    for topic in sorted(types, key=lambda name: (name not in aligned, name.count("/"), name)):
        for stream, (ending, image) in _STREAMS.items():
            found = re.fullmatch(f"(.*?)({ending})(?:{image}|(/camera_info))", topic)
            if found is None or (types[topic] in _IMAGES) == bool(found[3]):
                continue
            camera = re.sub(r"[^A-Za-z0-9_]+", "_", found[1].strip("/")) or "camera"
            name = f"{CAMERAS}{camera}/{stream}/{'info' if found[3] else 'image'}"
            if name not in names.values():
                names[topic] = name
            break
    return names


def _pair(text: str, topics: Iterable[str]) -> tuple[str, str]:
    old, _, new = text.partition("=")
    if old not in topics or not new.startswith("/"):
        raise UsageError(
            f"--remap {text!r} is no OLD=NEW of a topic of the bag and a new name such as "
            f"{CAMERAS}wrist/color/image. It has: {', '.join(sorted(topics))}."
        )
    return old, new
