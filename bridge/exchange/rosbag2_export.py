"""An episode as a rosbag2 folder, as ``ros2 bag`` and rosbags read it: MCAP and ``metadata.yaml``.

rosbag2 knows CDR messages with a ROS 2 definition and nothing else. What is anything else is left
out and listed.
"""

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mcap import records

from bridge.episode import schema
from bridge.episode.mcap.file import McapFile
from bridge.episode.mcap.messages import Selection, merged
from bridge.episode.provenance import software
from bridge.episode.reader import Episode
from bridge.episode.topics import is_latched, is_truth
from bridge.episode.writer import EpisodeWriter
from bridge.errors import UsageError
from bridge.exchange.output import new_folder, write_note
from bridge.exchange.rosbag2 import copy_attachments, schema_of

ROS_TEXTS = ("ros2msg", "ros2idl")
BAG_VERSION = 8
"""The last version in which profiles are texts, which every ROS 2 release since reads."""
_KEEP_LAST, _RELIABLE, _TRANSIENT_LOCAL = 1, 1, 1
_FOREVER = "{sec: 9223372036, nsec: 854775807}"


@dataclass(kw_only=True)
class ExportReport:
    """What was exported."""

    messages: int = 0
    topics: dict[str, int] = field(default_factory=dict)
    left_out: dict[str, str] = field(default_factory=dict)


@dataclass(kw_only=True)
class _Channel:
    """One topic with one definition as it goes into the bag."""

    topic: str
    record: schema.Schema
    profile: str
    """Quality of service, in the file as in metadata.yaml: rosbags compares them."""
    count: int = 0
    first_ns: int = 0
    last_ns: int = 0


def export_bag(
    episode: Episode,
    out: Path,
    *,
    force: bool = False,
    advance: Callable[[int, str], None] = lambda done, note: None,
) -> ExportReport:
    """Write an episode as a bag.

    Raises:
        UsageError: When nothing can go into a bag, or ``out`` is in the way.
    """
    report = ExportReport()
    channels = {
        channel.id: found
        for channel in episode.file.summary.channels.values()
        if (found := _channel(episode.file, channel, report.left_out)) is not None
    }
    if not channels:
        listed = ", ".join(report.left_out) or "it has no topics"
        raise UsageError(f"{episode.path} holds no ROS 2 messages to export ({listed}).")
    with new_folder(out, force=force) as folder:
        name = f"{out.name}_0.mcap"
        with EpisodeWriter(folder / name) as writer:
            copy_attachments([episode.file], writer)
            bag = _copy_messages(episode, writer, channels, advance)
        for (topic, _), channel in bag.items():
            report.topics[topic] = report.topics.get(topic, 0) + channel.count
        report.messages = sum(report.topics.values())
        about = "\n".join(_metadata(name, bag)) + "\n"
        (folder / "metadata.yaml").write_text(about, encoding="utf-8")
        made_by, choices = "robot-gst export rosbag2", {"left_out": report.left_out}
        write_note(folder, made_by=made_by, sources=[episode.path], choices=choices)
    return report


Bag = dict[tuple[str, str], "_Channel"]
"""What a bag holds, by topic and type."""


def _copy_messages(
    episode: Episode,
    writer: EpisodeWriter,
    channels: dict[int, "_Channel"],
    advance: Callable[[int, str], None],
) -> Bag:
    bag: Bag = {}
    topics = frozenset(channel.topic for channel in channels.values())
    for done, item in enumerate(merged([episode.file], Selection(topics)), start=1):
        channel = channels.get(item.channel.id)
        if channel is None:  # of a topic that also has messages that can go
            continue
        writer.write(
            channel.topic,
            item.data,
            schema_record=channel.record,
            log_time_ns=item.log_time_ns,
            publish_time_ns=item.publish_time_ns,
            sequence=item.sequence,
            about=(("offered_qos_profiles", channel.profile),),
        )
        counted = bag.setdefault((channel.topic, channel.record.name), channel)
        counted.count += 1
        counted.first_ns = min(counted.first_ns or item.log_time_ns, item.log_time_ns)
        counted.last_ns = max(counted.last_ns, item.log_time_ns)
        if done % 1000 == 0:
            advance(done, channel.topic)
    return bag


def _channel(file: McapFile, channel: records.Channel, left_out: dict[str, str]) -> _Channel | None:
    """What a channel is in the bag; None where it has no place in one, and why is noted."""
    if is_truth(channel.topic):
        return None
    record = schema_of(file, channel)
    if channel.message_encoding != "cdr":
        left_out[channel.topic] = f"{channel.message_encoding or 'bytes'}, not ROS 2"
        return None
    if record is None or record.schema_encoding not in ROS_TEXTS:  # no text: a type without fields
        named = record.name if record else "a type without a name"
        left_out[channel.topic] = f"no definition of {named}"
        return None
    return _Channel(topic=channel.topic, record=record, profile=_profile(channel.topic))


def _metadata(name: str, bag: Bag) -> Iterator[str]:
    """Lines of ``metadata.yaml``; texts are written as JSON, which YAML reads."""
    total = sum(channel.count for channel in bag.values())
    first_ns = min((channel.first_ns for channel in bag.values()), default=0)
    last_ns = max((channel.last_ns for channel in bag.values()), default=0)
    duration = f"duration: {{nanoseconds: {last_ns - first_ns}}}"
    starting = f"starting_time: {{nanoseconds_since_epoch: {first_ns}}}"
    yield "rosbag2_bagfile_information:"
    yield f"  version: {BAG_VERSION}"
    yield "  storage_identifier: mcap"
    yield f"  {duration}"
    yield f"  {starting}"
    yield f"  message_count: {total}"
    yield "  topics_with_message_count:"
    for (topic, type_name), channel in sorted(bag.items()):
        values: dict[str, Any] = {
            "name": topic,
            "type": type_name,
            "serialization_format": "cdr",
            "offered_qos_profiles": channel.profile,
            "type_description_hash": "",
        }
        yield "    - topic_metadata:"
        yield from (f"        {key}: {json.dumps(value)}" for key, value in values.items())
        yield f"      message_count: {channel.count}"
    yield '  compression_format: ""'
    yield '  compression_mode: ""'
    yield f"  relative_file_paths: [{json.dumps(name)}]"
    yield "  files:"
    yield f"    - path: {json.dumps(name)}"
    yield f"      {starting}"
    yield f"      {duration}"
    yield f"      message_count: {total}"
    yield f"  custom_data: {{made_by: {json.dumps('robot-gst ' + software()['version'])}}}"
    yield '  ros_distro: ""'


def _profile(topic: str) -> str:
    """The quality of service of a latched topic, so that a played bag is latched as well."""
    if not is_latched(topic):
        return ""
    lines = [
        f"- history: {_KEEP_LAST}",
        "  depth: 1",
        f"  reliability: {_RELIABLE}",
        f"  durability: {_TRANSIENT_LOCAL}",
        f"  deadline: {_FOREVER}",
        f"  lifespan: {_FOREVER}",
        "  liveliness: 1",
        f"  liveliness_lease_duration: {_FOREVER}",
        "  avoid_ros_namespace_conventions: false",
    ]
    return "\n".join(lines)
