"""Files that lie: changed, cut, spliced, or claiming terabytes. One sentence, little memory."""

import io
import json
import struct
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap import records
from mcap.writer import CompressionType, Writer

from bridge.episode.check import check_episode
from bridge.episode.mcap import format as mcap_format
from bridge.episode.mcap.format import MAGIC, RECORD_HEAD
from bridge.episode.reader import Episode
from bridge.errors import GstError

ROOT = Path(__file__).resolve().parents[2]
GIGABYTE = 1 << 30


def small_file(compression: CompressionType, *, use_chunking: bool) -> bytes:
    """No CRCs: they would find every change before anything else has to."""
    stream = io.BytesIO()
    writer = Writer(
        stream, chunk_size=80, compression=compression, enable_crcs=False, use_chunking=use_chunking
    )
    writer.start(profile="ros2", library="robot-gst")
    channel = writer.register_channel("/a", "json", writer.register_schema("gst/Event", "", b"{}"))
    for n in range(5):
        writer.add_message(channel, n, b"{}", n, sequence=n)
    writer.add_attachment(1, 1, "a", "text/plain", b"attached")
    writer.add_metadata("episode", {"id": '"x"', "kind": '"trial"'})
    writer.finish()
    return stream.getvalue()


FILES = [small_file(c, use_chunking=u) for c in CompressionType for u in (True, False)]


def read_all(path: Path) -> int | None:
    """Use everything an episode offers; None when it was refused on the way."""
    try:
        episode = Episode.open(path)
        episode.topics()
        count = sum(1 for _ in episode.messages())
        episode.attachment("a")
    except GstError:
        return None
    return count


def examine(path: Path) -> None:
    count, report = read_all(path), check_episode(path)
    if not report.faults:
        assert count == report.messages


@settings(max_examples=150)
@given(
    st.sampled_from(FILES),
    st.lists(st.tuples(st.integers(0, 2000), st.integers(0, 255)), max_size=4),
    st.integers(0, 2000),
    st.integers(-40, 40),
)
def test_a_changed_file_is_read_or_refused(
    tmp_path_factory: pytest.TempPathFactory,
    data: bytes,
    changes: list[tuple[int, int]],
    at: int,
    shift: int,
) -> None:
    changed = bytearray(data)
    for position, value in changes:
        changed[position % len(data)] = value
    at %= len(data)
    if shift < 0:
        del changed[at : at - shift]
    elif shift > 20:  # a piece of the file a second time
        changed[at:at] = changed[at : at + shift]
    path = tmp_path_factory.mktemp("fuzz") / "x.mcap"
    path.write_bytes(bytes(changed))
    examine(path)


def with_footer(*data: bytes, summary: bytes = b"") -> bytes:
    first, last = map(mcap_format.encoded, (records.Header("", ""), records.DataEnd(0)))
    body = MAGIC + first + b"".join(data) + last
    fields = struct.pack("<QQI", len(body) if summary else 0, 0, 0)
    return body + summary + mcap_format.record(mcap_format.FOOTER, fields) + MAGIC


def chunk(size: int, compression: str, data: bytes) -> bytes:
    fields = struct.pack("<QQQI", 0, 0, size, 0) + mcap_format.text(compression)
    return mcap_format.record(mcap_format.CHUNK, fields, struct.pack("<Q", len(data)), data)


def liars() -> dict[str, bytes]:
    bomb = zstandard.compress(bytes(600 << 20), 1)
    empty = RECORD_HEAD.pack(mcap_format.MESSAGE, 22) + bytes([7]) + bytes(21)
    many = zstandard.compress(empty * 1_000_000)
    endless = zstandard.ZstdCompressor(write_content_size=False).compress(bytes(64 << 20))
    huge = RECORD_HEAD.pack(mcap_format.CHUNK, 1 << 62)
    index = struct.pack("<QQQQIQ", 0, 0, 8, 1 << 60, 0, 0) + mcap_format.text("")
    place = records.ChunkIndex(9, 1 << 60, "", 1, 0, 0, {}, 0, 1 << 62)
    statistics = records.Statistics(0, 0, {}, 1, 0, 0, 0, 0, 0)
    name = struct.pack("<I", 0xFFFF_FFF0)
    return {
        "a chunk of 4 EiB": with_footer(chunk(1 << 62, "zstd", zstandard.compress(b"x"))),
        "a chunk just under the limit": with_footer(chunk(GIGABYTE, "", b"")),
        "a zstd bomb": with_footer(chunk(600 << 20, "zstd", bomb)),
        "a million messages of no channel": with_footer(chunk(31_000_000, "zstd", many)),
        "a zstd bomb that says it is small": with_footer(chunk(10, "zstd", bomb)),
        "zstd without a size": with_footer(chunk(100, "zstd", endless)),
        "lz4 that is none": with_footer(chunk(1 << 29, "lz4", b"\x04\x22\x4d\x18" + bytes(40))),
        "an unknown compression": with_footer(chunk(10, "brotli", b"0123456789")),
        "a record longer than the file": with_footer(huge),
        "a text longer than its record": with_footer(
            mcap_format.record(mcap_format.METADATA, name, b"x")
        ),
        "an attachment longer than its record": with_footer(
            mcap_format.record(
                mcap_format.ATTACHMENT, bytes(16), bytes(8), struct.pack("<Q", 1 << 60), bytes(4)
            )
        ),
        "an index that points nowhere": with_footer(
            summary=mcap_format.encoded(statistics) + mcap_format.encoded(place)
        ),
        "an index that is cut": with_footer(
            summary=mcap_format.record(mcap_format.CHUNK_INDEX, index[:30])
        ),
    }


CHILD = textwrap.dedent(
    """
    import json, resource, sys
    from pathlib import Path
    from bridge.episode.check import check_episode
    from bridge.episode.reader import Episode
    from bridge.errors import GstError

    resource.setrlimit(resource.RLIMIT_AS, (1 << 30, 1 << 30))
    said = {}
    for path in sorted(Path(sys.argv[1]).glob("*.mcap")):
        try:
            said[path.stem] = ["read", sum(1 for _ in Episode.open(path).messages())]
        except GstError as error:
            said[path.stem] = ["refused", str(error)]
        said[path.stem] += [check_episode(path).exit_code]
    print(json.dumps(said))
    """
)


@pytest.mark.slow
def test_files_that_claim_terabytes_are_refused_in_little_memory(tmp_path: Path) -> None:
    lies = liars()
    for name, data in lies.items():
        (tmp_path / f"{name}.mcap").write_bytes(data)
    done = subprocess.run(
        [sys.executable, "-c", CHILD, str(tmp_path)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    said = json.loads(done.stdout)
    assert set(said) == set(lies)
    for name, (verdict, text, code) in said.items():
        assert (verdict, code) == ("refused", 1), (name, verdict, text, code)
        assert f"{name}.mcap" in text
