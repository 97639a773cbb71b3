"""Chunks on their way to a slow or refusing disk."""

import threading
from collections.abc import Sequence
from typing import Any

import pytest
from mcap import records

from bridge.episode.chunk_queue import ChunkQueue
from bridge.episode.mcap.data_section import DataSection, EncodedChunk


class Disk(DataSection):
    """Writes one call at a time, each only when it is let go."""

    def __init__(self) -> None:
        """Nothing is let go yet."""
        self.begun, self.let_go = threading.Semaphore(0), threading.Semaphore(0)
        self.written: list[list[str]] = []
        self.error: OSError | None = None

    def add_chunks(self, chunks: Sequence[EncodedChunk]) -> None:
        self.begun.release()
        assert self.let_go.acquire(timeout=10.0)
        if self.error is not None:
            raise self.error
        self.written.append([chunk.entry.compression for chunk in chunks])


def chunk(name: str) -> EncodedChunk:
    """100 bytes; its compression is its name."""
    entry = records.ChunkIndex(100, 0, name, 0, 0, 0, {}, 0, 0)
    return EncodedChunk(buffers=[], entry=entry, index={})


@pytest.fixture
def queue() -> Any:
    disk = Disk()
    made: Any = ChunkQueue(disk, monotonic=lambda: 0.0)
    yield disk, made
    disk.error = None
    disk.let_go.release(9)
    made.end()


def test_small_messages_wait_for_the_write_under_way_alone(queue: Any) -> None:
    disk, made = queue
    made.add(chunk("image 1"), is_small=False, since_s=0.0)
    assert disk.begun.acquire(timeout=10.0)
    for name in ("image 2", "image 3"):
        made.add(chunk(name), is_small=False, since_s=0.0)
    for name in ("joints 1", "joints 2"):
        made.add(chunk(name), is_small=True, since_s=1.0)
    assert made.oldest_s() == 1.0
    assert (made.small_bytes, made.bulk_bytes) == (200, 300)
    disk.let_go.release()
    assert disk.begun.acquire(timeout=10.0)
    made.add(chunk("joints 3"), is_small=True, since_s=2.0)
    disk.let_go.release(9)
    made.drain()
    assert disk.written == [
        ["image 1"],
        ["joints 1", "joints 2", "image 2"],
        ["joints 3", "image 3"],
    ]
    assert (made.small_bytes, made.bulk_bytes, made.oldest_s()) == (0, 0, None)


def test_what_the_disk_refused_is_told_once_kept_and_tried_again(queue: Any) -> None:
    disk, made = queue
    disk.error = OSError("full")
    made.add(chunk("joints"), is_small=True, since_s=0.0)
    disk.let_go.release()
    with pytest.raises(OSError, match="full"):
        made.drain()
    assert (made.small_bytes, disk.written) == (100, [])
    disk.error = None
    disk.let_go.release()
    made.drain()
    assert disk.written == [["joints"]]


def test_small_messages_are_saved_where_the_disk_has_no_room_for_an_image(queue: Any) -> None:
    disk, made = queue
    disk.error = OSError("full")
    made.add(chunk("joints 1"), is_small=True, since_s=0.0)
    assert disk.begun.acquire(timeout=10.0)
    made.add(chunk("joints 2"), is_small=True, since_s=0.0)
    made.add(chunk("image"), is_small=False, since_s=0.0)
    disk.let_go.release()
    with pytest.raises(OSError, match="full"):
        made.drain()
    disk.error = None
    disk.let_go.release(9)
    made.drain()
    assert disk.written == [["joints 1", "joints 2"], ["image"]]
