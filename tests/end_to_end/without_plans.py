"""Copy a run without its plans, verdicts and events, as another recorder would have left it."""

import shutil
import sys
from pathlib import Path

from mcap.reader import make_reader
from mcap.writer import Writer

GONE = ("gst/Plan", "gst/Verdict", "gst/Event")


def without_plans(run: Path, out: Path) -> int:
    """Write the copy and return how many messages were left out."""
    shutil.copytree(run, out, ignore=shutil.ignore_patterns("derived", "results", "*.sqlite*"))
    return sum(_strip(path) for path in sorted((out / "episodes").glob("*.mcap")))


def _strip(path: Path) -> int:
    part, left_out = path.with_suffix(".tmp"), 0
    with path.open("rb") as source, part.open("wb") as sink:
        reader, writer = make_reader(source), Writer(sink)
        header = reader.get_header()
        writer.start(profile=header.profile, library=header.library)
        schemas: dict[int, int] = {0: 0}
        channels: dict[int, int] = {}
        for schema, channel, message in reader.iter_messages(log_time_order=False):
            if schema and schema.name.startswith(GONE):
                left_out += 1
                continue
            if schema and schema.id not in schemas:
                schemas[schema.id] = writer.register_schema(
                    schema.name, schema.encoding, schema.data
                )
            if channel.id not in channels:
                channels[channel.id] = writer.register_channel(
                    channel.topic,
                    channel.message_encoding,
                    schemas[channel.schema_id],
                    channel.metadata,
                )
            writer.add_message(
                channels[channel.id],
                message.log_time,
                message.data,
                message.publish_time,
                message.sequence,
            )
        for item in reader.iter_attachments():
            writer.add_attachment(
                item.create_time, item.log_time, item.name, item.media_type, item.data
            )
        for record in reader.iter_metadata():
            writer.add_metadata(record.name, record.metadata)
        writer.finish()
    part.replace(path)
    return left_out


if __name__ == "__main__":
    print(f"{without_plans(Path(sys.argv[1]), Path(sys.argv[2]))} messages left out")
